"""Masks and bounding boxes."""
