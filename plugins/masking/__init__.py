"""Masking of frames before tracking."""
