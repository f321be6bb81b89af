"""Cluster refiners, which clean the point clusters of one frame."""
