"""Fields of dataclasses in the API reference, with their comments: shapes, units, bounds.

The code documents fields by plain comments, which autodoc does not read. Array types keep their names from the code.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import io
import re
import textwrap
import tokenize
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.rst import escape


def comments(source: str) -> dict[str, str]:
    """Return the comments of the annotated names of a class: on their lines, or else on the line above."""
    tokens = [
        token for token in tokenize.generate_tokens(io.StringIO(source).readline) if token.type == tokenize.COMMENT
    ]
    said = {token.start[0]: token.string.lstrip("#: ").strip() for token in tokens}
    above = {token.start[0] + 1: said[token.start[0]] for token in tokens if token.line.lstrip().startswith("#")}
    [found] = ast.parse(source).body
    assert isinstance(found, ast.ClassDef)
    return {
        line.target.id: " ".join(said[k] for k in range(line.lineno, (line.end_lineno or line.lineno) + 1) if k in said)
        or above.get(line.lineno, "")
        for line in found.body
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
    }


def add_fields(app: Sphinx, what: str, name: str, of: Any, options: Any, lines: list[str]) -> None:
    """Append the fields of a dataclass to its docstring."""
    if not isinstance(of, type) or not dataclasses.is_dataclass(of):
        return
    said: dict[str, str] = {}
    for base in reversed(of.__mro__):  # the last declaration of a field applies
        if dataclasses.is_dataclass(base):
            said |= comments(textwrap.dedent(inspect.getsource(base)))
    fields = [field for field in dataclasses.fields(of) if not field.name.startswith("_")]
    lines.append("")
    for field in fields:
        lines.append(f":var {field.name}: {escape(said[field.name])}")
        lines.append(f":vartype {field.name}: {field.type}")
    lines.append("")


def name_arrays(
    app: Sphinx, what: str, name: str, of: Any, options: Any, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Replace Sphinx's `TypeAliasForwardRef('Float32')` of optional arrays by `Float32`."""
    plain = [text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text) for text in (signature, returned)]
    return plain[0], plain[1]


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.connect("autodoc-process-docstring", add_fields)
    app.connect("autodoc-process-signature", name_arrays)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
