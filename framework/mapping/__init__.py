"""The voxel-hashed map: storage, integration, evidence, association, ray casting, meshing."""
