"""Figures of runs, refinements and recording checks."""
