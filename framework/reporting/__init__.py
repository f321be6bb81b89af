"""Reports: self-contained HTML pages with an interactive map, its objects, and their evaluation."""
