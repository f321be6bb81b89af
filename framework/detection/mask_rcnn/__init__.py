"""Mask R-CNN: the network, and readers of published weights."""
