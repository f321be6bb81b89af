"""HTML pages from Jinja2 templates.

Values are escaped, and pages load nothing from the network.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from framework.errors import DataError
from framework.files.atomic_write import atomic_write
from framework.runtime.plain_output import plain

ASSETS = files("framework.reporting") / "assets"
STYLE = "report.css"
SCRIPTS = ("three.min.js", "viewer.js", "table.js", "edits.js", "editing.js", "page.js")
POLICY = (
    "default-src 'none'; img-src data:; style-src '{style}'; script-src '{script}'; base-uri 'none'; form-action 'none'"
)


def page(template: str, title: str, context: Mapping[str, Any], data: Mapping[str, Any], maps: Sequence[str]) -> str:
    """Return an HTML page.

    The content security policy of the page allows only the scripts in assets/ and no network access.

    Args:
        template: File in templates/ that extends page.html.
        title: Title of the page.
        context: Variables of the template.
        data: Data for the scripts, written as JSON.
        maps: Maps as base64-encoded, gzip-compressed GLB files.
    """
    style, *scripts = [(ASSETS / name).read_text(encoding="utf-8") for name in (STYLE, *SCRIPTS)]
    script = "\n".join(scripts)
    if "</script" in script.lower() or "</style" in style.lower():
        raise DataError(f"{ASSETS}: expected no </script in *.js and no </style in {STYLE}, got one; write <\\/ for </")
    environment = Environment(
        loader=PackageLoader("framework.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_plain,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":"), "sort_keys": True}
    policy = POLICY.format(style=_hash(style), script=_hash(script))
    shared = {"title": title, "policy": policy, "style": style, "script": script, "data": _plain(data), "maps": maps}
    return environment.get_template(template).render(**context, **shared)


def _plain(value: Any) -> Any:
    """Return a value with the control characters of its texts escaped, such as those that reverse the reading order."""
    if isinstance(value, Mapping):
        return {_plain(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return plain(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def write_page(path: Path, page: str) -> None:
    """Write an HTML page. Invalid Unicode in names is escaped."""
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace")
