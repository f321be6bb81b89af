"""Label evidence of the voxels."""
