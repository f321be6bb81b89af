"""Composition and validation of Hydra configs."""
