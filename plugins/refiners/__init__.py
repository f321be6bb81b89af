"""Cluster refiners: clean the point clusters of one frame."""
