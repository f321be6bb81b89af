"""Viewers of a run in progress."""
