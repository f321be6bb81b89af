"""Furniture of synthetic scenes."""
