"""Instances of the map and their association."""
