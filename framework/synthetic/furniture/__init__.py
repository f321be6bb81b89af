"""Furniture and furniture groups."""
