"""File formats and file access."""
