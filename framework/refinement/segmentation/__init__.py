"""Geometric segmentation of depth images."""
