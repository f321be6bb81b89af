"""Pictures of surfaces: a rasterizer, light, and the overview of a map."""
