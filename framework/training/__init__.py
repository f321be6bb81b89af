"""Training of detectors on synthetic scenes."""
