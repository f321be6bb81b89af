"""Pose trackers, which estimate the camera pose of each frame."""
