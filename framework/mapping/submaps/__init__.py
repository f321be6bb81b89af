"""Submaps: hidden parts of a map, their motion and their fusion."""
