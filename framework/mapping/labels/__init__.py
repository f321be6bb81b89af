"""Class and instance evidence of voxels."""
