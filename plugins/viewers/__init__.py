"""Viewers: what is seen of a run while it goes on."""
