"""Reading of image sequences."""
