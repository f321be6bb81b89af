"""Maps of baseline systems."""
