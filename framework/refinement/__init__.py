"""Lifting of masks to point clusters, and algorithms of the cluster refiners."""
