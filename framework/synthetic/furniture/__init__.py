"""Furniture and furniture groups of synthetic scenes."""
