"""Masks and boxes."""
