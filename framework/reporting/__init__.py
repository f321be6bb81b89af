"""Self-contained HTML reports with an interactive map, its objects and their evaluation."""
