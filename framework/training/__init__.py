"""Training of detectors and of the learned association on synthetic scenes."""
