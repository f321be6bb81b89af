"""Cluster refiners, which improve the point clusters of a frame."""
