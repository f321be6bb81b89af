"""Run directories: writing and reading."""
