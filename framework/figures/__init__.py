"""Figures of runs, refinements and checked recordings."""
