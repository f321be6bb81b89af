"""Synthetic RGB-D sequences of furnished rooms."""
