"""Back ends, which correct the map when the camera returns to a place."""
