"""Tables of runs: Markdown, LaTeX and CSV."""
