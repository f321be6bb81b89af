"""Tests for output without control characters."""

from __future__ import annotations

import io
import logging
import sys
import unicodedata

import pytest

from framework.runtime.plain_output import PlainRecord, PlainStream, plain, plain_line

HIDDEN = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}  # categories of control, invisible and invalid characters


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\x1b[2J\x1b]0;title\x07", r"\x1b[2J\x1b]0;title\x07"),
        ("a\u202egpj.exe\u2066", r"a\u202egpj.exe\u2066"),
        ("\ud800\u200b\x85\u2028\r\x9b31m", r"\ud800\u200b\x85\u2028\r\x9b31m"),
        ("café 日本 😀 ±1\u00a0m\n\tend", "café 日本 😀 ±1\u00a0m\n\tend"),
    ],
)
def test_plain_escapes_only_hidden_characters(text: str, expected: str) -> None:
    assert plain(text) == expected
    assert plain(plain(text)) == plain(text)


def test_plain_leaves_no_hidden_character() -> None:
    for code in range(sys.maxunicode + 1):
        character = chr(code)
        hidden = unicodedata.category(character) in HIDDEN and character not in "\n\t"
        assert (plain(character) != character) == hidden


def test_plain_line_is_one_line() -> None:
    assert plain_line("a\r\n# b\u2028c\x1c\x1b d") == r"a # b c \x1b d"


def test_plain_stream_escapes_written_text() -> None:
    stream = io.StringIO()
    print("class \x1b[8mhidden\r", file=PlainStream(stream))
    PlainStream(stream).writelines(["\x07", "end\n"])
    assert stream.getvalue() == "class \\x1b[8mhidden\\r\n\\x07end\n"


def test_plain_stream_keeps_progress_and_colors() -> None:
    stream = io.StringIO()
    shown = PlainStream(stream, keeps_progress=True)
    progress = "\r 50%|#####\x1b[A\r\x1b[K\x1b[32mINFO\x1b[0m done\n"
    assert shown.write(progress) == len(progress)
    shown.write("\x1b]0;title\x07\x1b[2J")
    assert stream.getvalue() == progress + r"\x1b]0;title\x07\x1b[2J"


def test_plain_record_escapes_arguments() -> None:
    record = PlainRecord("name", logging.INFO, "file", 1, "mapping %s", ("\x1b[31mroom",), None)
    assert logging.Formatter("%(message)s").format(record) == r"mapping \x1b[31mroom"
