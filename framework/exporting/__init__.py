"""Export of stored runs to 3D formats, floor plans and scene graphs."""
