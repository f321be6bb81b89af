"""Tests that no text for readers contains a phrase of private_phrases.txt."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PHRASES = [
    line
    for line in Path(__file__).with_name("private_phrases.txt").read_text("utf-8").splitlines()
    if line and not line.startswith("#")
]
PATTERN = re.compile("|".join(PHRASES), re.IGNORECASE)
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "CODE_OF_CONDUCT.md")
PYTHON = ("framework", "plugins", "examples", "instancemap.py")
CONFIGS = ("conf", "examples")


def files(roots: tuple[str, ...], *patterns: str) -> list[Path]:
    """Return the files of these folders or files."""
    found = []
    for root in (CHECKOUT / name for name in roots):
        found += [root] if root.is_file() else [path for pattern in patterns for path in root.rglob(pattern)]
    return sorted(found)


def python_texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield the comments and strings of a module, including docstrings, with their lines."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def phrases_in(path: Path) -> list[str]:
    """Return the private phrases of a file, with their positions."""
    source = path.read_text("utf-8")
    texts = python_texts(source) if path.suffix == ".py" else enumerate(source.splitlines(), 1)
    return [f"{path.name}:{line}: {found[0]}" for line, text in texts for found in PATTERN.finditer(text)]


@pytest.mark.parametrize("page", PAGES)
def test_page_has_no_private_phrase(page: str) -> None:
    assert not phrases_in(CHECKOUT / page)


def test_python_texts_have_no_private_phrase() -> None:
    assert not [found for path in files(PYTHON, "*.py") for found in phrases_in(path)]


def test_configs_have_no_private_phrase() -> None:
    assert not [found for path in files(CONFIGS, "*.yaml", "*.yml", "*.toml") for found in phrases_in(path)]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("page.md", "The result is the same to the byte.\n"),
        ("docstring.py", '"""Compute the map anew."""\n'),
        ("comment.py", "x = 1  # a rival of Open3D\n"),
        ("message.py", 'raise ValueError("seed: nobody told the seed")\n'),
        ("option.yaml", "voxel_size: 0.01 # m, as told\n"),
    ],
)
def test_phrases_in_finds_planted_phrase(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    assert phrases_in(tmp_path / name)
