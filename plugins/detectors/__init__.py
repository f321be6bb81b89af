"""Detectors of object instances in images."""
