"""A stored run as files of other programs: meshes, scenes for simulators, floor plans, a scene graph."""
