"""The voxel-hashed TSDF."""
