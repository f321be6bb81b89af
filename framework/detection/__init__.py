"""Numerical code shared by detectors: box arithmetic, non-maximum suppression, RoIAlign and masks."""
