"""Rendering of surfaces: rasterizer, lighting, viewpoints and the overview image of a map."""
