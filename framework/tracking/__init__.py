"""Frame-to-model camera tracking: image pyramids and the alignment of a frame to a view of the map."""
