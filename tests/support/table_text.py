"""Tables in Markdown text."""

from __future__ import annotations


def grids(text: str) -> list[list[str]]:
    """Return the lines of each table in a text, without padding."""
    blocks = [block.splitlines() for block in text.split("\n\n") if block.startswith("|")]
    return [[" ".join(line.split()) for line in block] for block in blocks]
