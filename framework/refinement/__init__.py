"""Lifting of masks to point clusters, and the algorithms of the cluster refiners."""
