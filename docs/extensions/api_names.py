"""Lists of names in the API reference: a block `{api} MODULE` with the names of classes, functions and errors.

`NAME(METHOD)` shows only this method of a class, and `NAME()` shows no methods.
"""

from __future__ import annotations

import inspect
import re
from importlib import import_module

from sphinx.application import Sphinx

BLOCK = re.compile(r"```\{api\} (?P<module>[\w.]+)\n(?P<names>.*?)```", re.DOTALL)
NAME = re.compile(r"(?P<name>[\w.]+)(\((?P<method>\w*)\))?")


def directive(module: str, name: str, method: str | None) -> list[str]:
    """Return the directive of autodoc for a name, as lines."""
    of = getattr(import_module(module), name)
    if not inspect.isclass(of):
        return [f".. autofunction:: {module}.{name}", ""]
    if issubclass(of, BaseException):
        return [f".. autoexception:: {module}.{name}", ""]
    members = [] if method == "" else [f"   :members: {method or ''}".rstrip()]
    return [f".. autoclass:: {module}.{name}", *members, ""]


def expand(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the lists of names on a page by directives of autodoc."""

    def directives(block: re.Match[str]) -> str:
        module = block["module"]
        lines = [f".. currentmodule:: {module}", ""]
        for found in NAME.finditer(block["names"]):
            lines += directive(module, found["name"], found["method"])
        return "\n".join(["```{eval-rst}", *lines, "```"])

    source[0] = BLOCK.sub(directives, source[0])


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.connect("source-read", expand)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
