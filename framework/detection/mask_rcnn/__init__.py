"""Mask R-CNN: the network, and the files in which others publish its weights."""
