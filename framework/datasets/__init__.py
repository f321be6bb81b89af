"""Sequence readers, one module per format."""
