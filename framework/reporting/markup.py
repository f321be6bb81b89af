"""HTML of a page: whatever comes from a record is escaped, and nothing is loaded from anywhere."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from framework.errors import DataError

ASSETS = files("framework.reporting") / "assets"
STYLE = "report.css"
SCRIPTS = ("three.min.js", "viewer.js", "table.js", "page.js")
POLICY = (
    "default-src 'none'; img-src data:; style-src '{style}'; script-src '{script}'; base-uri 'none'; form-action 'none'"
)


def page(title: str, body: str, data: Mapping[str, Any], maps: Sequence[str]) -> str:
    """The whole file. Its policy lets no script run but ours, and nothing reach the network.

    Args:
        body: markup.
        data: for the scripts, as JSON.
        maps: GLB, gzip, base64.
    """
    style = asset(STYLE)
    script = "\n".join(asset(name) for name in SCRIPTS)
    if "</script" in script.lower() or "</style" in style.lower():
        raise DataError(f"{ASSETS}: a script or style would end the element that it is in")
    return Template(asset("page.html")).substitute(
        title=escape(title),
        policy=POLICY.format(style=_hash(style), script=_hash(script)),
        style=style,
        body=body,
        data=json_text(data),
        maps="\n".join(f'<script type="text/plain" id="map-{k}">{content}</script>' for k, content in enumerate(maps)),
        script=script,
    )


def asset(name: str) -> str:
    """The text of a file that comes with the project."""
    return (ASSETS / name).read_text(encoding="utf-8")


def json_text(content: Any) -> str:
    """JSON that ends no element of HTML and begins no comment."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"), sort_keys=True)
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def tag(name: str, *children: str, **attributes: object) -> str:
    """One element; children are markup, attributes are escaped. `class_` is `class`, `data_id` is `data-id`.

    An attribute that is True stands without a value, one that is None or False is left out.
    """
    named = []
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        word = key.rstrip("_").replace("_", "-")
        named.append(f" {word}" if value is True else f' {word}="{escape(str(value))}"')
    return f"<{name}{''.join(named)}>{''.join(children)}</{name}>"


def words(text: object) -> str:
    """Text as markup."""
    return escape(str(text))


def figure(value: str, unit: str, label: str, note: str = "") -> str:
    """One of the figures at the head of a page."""
    return tag(
        "div",
        tag("dt", words(label)),
        tag("dd", words(value), tag("span", words(unit), class_="unit") if unit else ""),
        tag("dd", words(note), class_="note") if note else "",
        class_="figure",
    )


def section(anchor: str, title: str, *children: str, lead: str = "") -> str:
    """A part of the page with a heading."""
    head = tag("h2", words(title), id=f"{anchor}-title")
    return tag(
        "section",
        tag("header", head, tag("p", words(lead)) if lead else ""),
        *children,
        id=anchor,
        aria_labelledby=f"{anchor}-title",
    )


def table(
    heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int] = (), **attributes: object
) -> str:
    """A plain table; heads are text, cells are markup, `numbers` are the columns that are aligned as such."""

    def kind(k: int) -> str | None:
        return "number" if k in numbers else None

    head = tag("tr", *(tag("th", words(text), scope="col", class_=kind(k)) for k, text in enumerate(heads)))
    body = [tag("tr", *(tag("td", cell, class_=kind(k)) for k, cell in enumerate(row))) for row in rows]
    return tag("div", tag("table", tag("thead", head), tag("tbody", *body), **attributes), class_="scroll")


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
