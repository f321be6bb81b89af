"""Noise models of depth sensors."""
