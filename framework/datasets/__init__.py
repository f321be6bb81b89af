"""Sequences that feed the pipeline: one file per format."""
