"""The numerical pieces that detectors share: box arithmetic, non-maximum suppression, RoIAlign and masks."""
