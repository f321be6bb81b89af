"""Synthetic buildings of several rooms."""
