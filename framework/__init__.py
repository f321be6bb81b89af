"""InstanceMap: incremental instance-oriented semantic 3D mapping from RGB-D video."""

__version__ = "0.1.0"
