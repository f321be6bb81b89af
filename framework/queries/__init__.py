"""Queries of a map."""
