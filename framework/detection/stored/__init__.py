"""Stored detections."""
