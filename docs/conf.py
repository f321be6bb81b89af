"""Sphinx configuration of the documentation. Build it with `make docs` or `sphinx-build docs DIR`."""

from __future__ import annotations

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]  # Sphinx extensions in docs/, and the package of this checkout

from framework import __version__  # noqa: E402

project = "InstanceMap"
author = "The InstanceMap authors"
release = version = __version__
copyright = f"{author}, Apache-2.0"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "extensions.alt_texts",
    "extensions.api_names",
    "extensions.arguments",
    "extensions.docstrings",
    "extensions.mathml",
    "extensions.options",
    "extensions.project_files",
]
exclude_patterns = ["extensions", "_build"]

html_theme = "furo"
html_title = f"InstanceMap {release}"
html_baseurl = os.environ.get("READTHEDOCS_CANONICAL_URL", "")  # of the default version, for search engines
html_static_path = ["static"]
html_css_files = ["pages.css"]
html_math_renderer = "mathml"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

smartquotes = False  # "" means an empty string in these pages
default_role = "literal"  # for names in single backticks in docstrings
toc_object_entries_show_parents = "hide"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_type_aliases = {
    name: name for name in ("Array", "Bool", "Float32", "Float64", "FrameReader", "Int32", "Int64", "UInt16", "UInt8")
}

nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!(framework|plugins|instancemap)\.).*"),  # names of other libraries: no inventories are downloaded
    ("py:class", r"framework\.(mapping\..*|registry\.Plugin)"),  # types without a page
]
