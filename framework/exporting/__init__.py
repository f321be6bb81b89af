"""Export of a stored run: meshes, scenes for simulators, floor plans and a scene graph."""
