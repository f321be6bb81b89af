"""Import of maps from other systems: labeled meshes, point clouds and instance masks."""
