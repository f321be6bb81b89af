"""Training of detectors on rendered rooms."""
