"""ScanNet's files."""
