"""ScanNet file formats."""
