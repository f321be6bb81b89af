"""Map fusers: associate clusters with instances and integrate the frame."""
