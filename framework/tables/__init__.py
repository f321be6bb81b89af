"""Run records become tables: Markdown, LaTeX, CSV."""
