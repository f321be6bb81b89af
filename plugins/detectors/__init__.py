"""Detectors: object instances in one image."""
