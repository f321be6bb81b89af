"""Camera tracking: image pyramids, alignment of frames to the map, and relocalization."""
