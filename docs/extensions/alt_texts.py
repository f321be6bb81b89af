"""Warnings for images without an alternative text, which screen readers read aloud. With `-W`, they fail the build."""

from __future__ import annotations

import re

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging

log = logging.getLogger(__name__)

_WITHOUT_ALT = re.compile(r"<img\b(?![^>]*\balt\s*=\s*(?:\"[^\"]|'[^']))[^>]*>", re.IGNORECASE)


def check(app: Sphinx, page: nodes.document) -> None:
    """Log a warning for each image on a page without an alternative text."""
    for node in page.findall(lambda node: isinstance(node, nodes.image | nodes.raw)):
        if isinstance(node, nodes.image):
            found = [] if str(node.get("alt", "")).strip() else [str(node["uri"])]
        else:
            found = _WITHOUT_ALT.findall(node.astext())
        for image in found:
            log.warning("%s: expected an alternative text, got none", image, location=node, type="alt_text")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.connect("doctree-read", check)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
