"""Components shared by detectors."""
