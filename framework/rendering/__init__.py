"""Rendering of surfaces: rasterizer, lighting, viewpoints, and the overview of a map."""
