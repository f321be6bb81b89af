"""Relative links in the documentation, valid on code hosts and in the built pages.

Some project files are also documentation pages: a page of one line in `docs/` links to each file. Folders have no
pages: a link to a folder is replaced by its text.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
PROJECT = DOCS.parent
PAGES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "data/desk/README.md": "desk.md",
    "examples/README.md": "tutorials/examples.md",
    "framework/mapping/instances/learned_association.md": "results/learned_association.md",
    "plugins/detectors/mask_rcnn_rooms.md": "guides/mask_rcnn_rooms.md",
    "plugins/detectors/maskrcnn2go.md": "guides/maskrcnn2go.md",
}
"""Pages of project files, by file."""

_FOLDER = re.compile(r"\[(?P<words>[^\]]*)\]\((?!\w+:|#)(?P<path>[^)#\s]+)\)")
_LINK = re.compile(r"(?<=\]\()(?!\w+:|#)(?P<path>[^)#\s]+)(?P<anchor>#[^)\s]*)?(?=\))")


def show(app: Sphinx, name: str, source: list[str]) -> None:
    """Replace the source by the text of the page or of its project file, with links relative to the page."""
    page = DOCS / f"{name}.md"
    shown = {DOCS / place: PROJECT / path for path, place in PAGES.items()}.get(page, page)
    text = source[0] if shown == page else shown.read_text()

    def relinked(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(shown.parent / link["path"]))
        if target.is_relative_to(PROJECT):
            target = DOCS / PAGES.get(str(target.relative_to(PROJECT)), target)
        return os.path.relpath(target, page.parent) + (link["anchor"] or "")

    def without_folders(link: re.Match[str]) -> str:
        return link["words"] if (shown.parent / link["path"]).is_dir() else link[0]

    source[0] = _LINK.sub(relinked, _FOLDER.sub(without_folders, text))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.connect("source-read", show)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
