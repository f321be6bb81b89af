"""Cluster refiners, which clean, split or merge the point clusters of one frame."""
