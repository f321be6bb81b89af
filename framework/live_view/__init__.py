"""Live view of a run: a drawing thread, and drawing with rerun."""
