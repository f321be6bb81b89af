"""Commands and code in README.md, CONTRIBUTING.md and docs/, by language and without duplicates."""

from __future__ import annotations

import re
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
DOCS = CHECKOUT / "docs"
PAGES = {
    str(path.relative_to(CHECKOUT)): path.read_text()
    for path in [CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
}
"""Text of each page by its path in the checkout."""


def blocks(language: str, page: str | None = None) -> list[str]:
    """Return the distinct code blocks of a language on one page or, by default, on all pages."""
    texts = PAGES.values() if page is None else [PAGES[page]]
    return list(
        dict.fromkeys(code for text in texts for code in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL))
    )


def block(language: str, containing: str) -> str:
    """Return the only code block of a language that contains this text."""
    [found] = [code for code in blocks(language) if containing in code]
    return found


LINES = list(
    dict.fromkeys(
        re.sub(r"^instancemap ", "python -m framework ", line)
        for code in blocks("console")
        for line in code.splitlines()
    )
)
"""Every line of the console blocks, with `python -m framework` instead of `instancemap`."""
