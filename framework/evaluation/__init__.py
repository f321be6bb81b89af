"""Metrics of maps and trajectories."""
