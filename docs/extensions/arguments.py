"""Directives for arguments: `{arguments} edit` and `{fields} framework.tables.table_choice.TableChoice table`.

The texts come from the argument parser of the command, as in `--help`, and from the comments of the dataclass fields.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from typing import NoReturn
from unittest import mock

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from extensions.docstrings import comments
from extensions.options import Row, paragraph, table, table_of, yaml_value
from framework.__main__ import module_of

IN_YAML = {"None": "null", "True": "true", "False": "false"}


class BuiltParserError(Exception):
    """The parser of a command, raised to leave its `main`."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__(parser.prog)
        self.parser = parser


def parser_of(command: str) -> argparse.ArgumentParser:
    """Return the argument parser of a command, such as `edit`."""

    def stop(parser: argparse.ArgumentParser, _words: list[str]) -> NoReturn:
        raise BuiltParserError(parser)

    main = import_module(module_of(command)).main
    with (
        mock.patch.object(argparse.ArgumentParser, "parse_intermixed_args", stop),
        mock.patch.object(sys, "argv", ["instancemap"]),
    ):
        try:
            main()
        except BuiltParserError as built:
            return built.parser
    raise ValueError(f"{command}: expected a command with an argument parser, got none")


def argument_rows(command: str) -> Iterator[tuple[str, str]]:
    """Yield the arguments of a command and their help texts, without --help and --config-dir."""
    for action in parser_of(command)._actions:
        if {"--help", "--config-dir"} & {*action.option_strings} or action.help in (None, argparse.SUPPRESS):
            continue
        metavar = action.metavar or ("|".join(map(str, action.choices)) if action.choices else "")
        names = [metavar] if isinstance(metavar, str) else list(metavar)
        if action.nargs == "+":
            names[-1] += " ..."
        yield " ".join(filter(None, [*action.option_strings, *names])), str(action.help)


class Arguments(SphinxDirective):
    """Directive for the arguments of a command."""

    required_arguments = 1  # the command

    def run(self) -> list[nodes.Node]:
        rows = [
            nodes.row("", *(nodes.entry("", cell) for cell in (_literal(name), paragraph(text))))
            for name, text in argument_rows(self.arguments[0])
        ]
        return [table_of(("Argument", "Meaning"), rows, (40, 60))]


class Fields(SphinxDirective):
    """Directive for the settings of a block of an experiment, from the dataclass that describes the block."""

    required_arguments = 2  # the dataclass and the name of the block

    def run(self) -> list[nodes.Node]:
        module, _, name = self.arguments[0].rpartition(".")
        return [table(field_rows(getattr(import_module(module), name), self.arguments[1]))]


def field_rows(of: type, block: str) -> list[Row]:
    """Return the rows of the fields of a dataclass, with values as on the command line."""
    meanings = comments(inspect.getsource(of))
    rows = []
    for field in dataclasses.fields(of):
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        meaning = re.sub(r"\b(None|True|False)\b", lambda found: IN_YAML[found[0]], meanings[field.name])
        rows.append(Row(f"{block}.{field.name}", str(field.type), yaml_value(default), meaning))
    return rows


def _literal(text: str) -> nodes.paragraph:
    return nodes.paragraph("", "", nodes.literal("", text))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.add_directive("arguments", Arguments)
    app.add_directive("fields", Fields)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
