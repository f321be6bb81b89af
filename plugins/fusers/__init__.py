"""Map fusers, which integrate each frame and associate its clusters with instances."""
