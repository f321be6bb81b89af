"""Map fusers, which associate clusters with instances and integrate the frame."""
