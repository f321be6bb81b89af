"""Formulas as MathML, which browsers render natively. MathJax, the default of Sphinx, requires network access.

docutils translates from LaTeX and reports unknown commands.
"""

from __future__ import annotations

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

log = logging.getLogger(__name__)


def visit_inline(writer: HTML5Translator, node: nodes.math) -> None:
    """Write an inline formula as MathML."""
    writer.body.append(_translated(node))
    raise nodes.SkipNode


def visit_block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """Write a display formula as MathML."""
    writer.body.append(f'<div class="math">\n{_translated(node, as_block=True)}\n</div>\n')
    raise nodes.SkipNode


def _translated(node: nodes.math | nodes.math_block, as_block: bool = False) -> str:
    try:
        return str(tex2mathml(node.astext(), as_block=as_block))
    except MathError as error:
        log.warning(
            "formula: expected LaTeX supported by docutils, got %s: %s",
            node.astext(),
            error,
            location=node,
            type="mathml",
        )
        return ""


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
