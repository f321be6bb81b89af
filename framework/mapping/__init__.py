"""Voxel map with object instances: storage, integration, label evidence, association, ray casting and meshing."""
