"""Mask R-CNN network and readers of published weights."""
