"""Pose graph of submaps: division of the trajectory, detection of loops, optimization."""
