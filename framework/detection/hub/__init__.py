"""Detectors from the Hugging Face hub."""
