"""Pose trackers: the camera pose, frame by frame."""
