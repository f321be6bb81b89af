"""Camera calibration of datasets."""
