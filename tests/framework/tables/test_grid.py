"""Tests for table cells in Markdown."""

from __future__ import annotations

import math

import pytest

from framework.tables.grid import TextTable, decimals, figure, markdown_grid, markdown_page, markdown_text

GRID = TextTable(
    heads=["scene", "a_b", "x"],
    body=[["011", "y|z", "0.5 ± 0.1"], ["", "50%", "–"]],
    label_columns=2,
    bold=frozenset({(0, 2)}),
    groups=frozenset({1}),
)


def test_markdown_grid_is_padded_and_aligned() -> None:
    assert markdown_grid(GRID).splitlines() == [
        "| scene | a_b  |             x |",
        "| ----- | ---- | ------------: |",
        "| 011   | y\\|z | **0.5 ± 0.1** |",
        "|       | 50%  |             – |",
    ]


def test_grid_replaces_line_breaks_in_cells() -> None:
    grid = TextTable(["row", "x"], [["a\nb", "1"]])
    assert "| a b | 1 |" in markdown_grid(grid)


def test_grid_decimals_depend_on_largest_value() -> None:
    assert [decimals([value, 0.1, math.nan]) for value in (-1.9, 2.0, 199.0, 200.0)] == [3, 2, 1, 0]
    assert decimals([math.nan]) == 3


def test_grid_value_includes_known_spread_and_sign() -> None:
    assert figure(0.25, 0.0625, 2) == "0.25 ± 0.06"
    assert figure(0.25, math.nan, 3, signed=True) == "+0.250"
    assert figure(-1e-9, math.nan, 3, signed=True) == "+0.000"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[click](javascript:x)", r"[click\](javascript:x)"),
        ("[a][b] [a]: http://x", r"[a\][b] [a\]: http://x"),
        ("<img src=x> <!-- a < b & c &lt;", "&lt;img src=x> &lt;!-- a < b & c &amp;lt;"),
        ("**best** __best__ *x* ~~x~~", r"\*\*best\*\* \_\_best\_\_ \*x\* \~\~x\~\~"),
        ("a\\|b `c`", r"a\\\|b \`c\`"),
        ("\x1b[2J\u202e", r"\\x1b[2J\\u202e"),
        ("refiner=gmm_em ± 0.1 * in [0, 1]", "refiner=gmm_em ± 0.1 * in [0, 1]"),
    ],
)
def test_markdown_text_has_no_markup(text: str, expected: str) -> None:
    assert markdown_text(text) == expected


def test_markdown_page_escapes_title_and_notes() -> None:
    page = markdown_page("a\n# <b>", [GRID], ["x\n\n# [y](z)"])
    assert page.splitlines()[0] == "# a # &lt;b>"
    assert page.splitlines()[-1] == r"- x # [y\](z)"
