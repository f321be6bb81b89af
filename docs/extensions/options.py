"""Directives of the configuration reference, such as `{options} detector` and `{overview} detector`.

Names, types, defaults and comments come from the dataclasses and the YAML files, as in `instancemap plugins`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from functools import cache
from typing import NamedTuple

import yaml
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from framework.__main__ import COMMANDS
from framework.commands.installation.plugins import Option, registered
from framework.config.composition import composed
from framework.files.search_paths import CONF
from framework.importing.formats import FORMATS

_SETTING = re.compile(r"(  )?(\w+):(?: +(\S.*?))?(?: +# (.*))?")  # line of a setting; indented in a group of settings
VARIANT = " Here: "  # precedes the difference of a variant from its class in `Option.documentation`


@cache
def options_of_stage(stage: str) -> list[Option]:
    """Return the options of a stage. Two pages contain them."""
    return registered(stage)


class Row(NamedTuple):
    """A line of a table of parameters."""

    name: str
    type: str
    default: str
    meaning: str


class Options(SphinxDirective):
    """Directive for the options of a stage: one section per option, with documentation and parameters."""

    required_arguments = 1  # the stage

    def run(self) -> list[nodes.Node]:
        stage = self.arguments[0]
        return [self.option(option) for option in options_of_stage(stage)]

    def option(self, option: Option) -> nodes.section:
        section = nodes.section(ids=[_anchor(option)], names=[option.name])
        section += nodes.title("", "", nodes.literal("", f"{option.stage}={option.name}"))
        section += paragraph(option.documentation)
        section += nodes.paragraph("", "", nodes.literal("", option.target), classes=["target"])
        rows = [Row(f"{option.stage}.{it.name}", it.type, it.default, it.comment) for it in option.parameters]
        section += table(rows) if rows else paragraph("No parameters.")
        return section


class Overview(SphinxDirective):
    """Directive for a table of the options of a stage, with links to their parameters."""

    required_arguments = 1  # the stage

    def run(self) -> list[nodes.Node]:
        stage = self.arguments[0]
        page = self.env.app.builder.get_relative_uri(self.env.docname, f"configuration/{stage}")
        rows = [self._row(option, page) for option in options_of_stage(stage)]
        return [table_of(("Option", "Description"), rows, (35, 65))]

    def _row(self, option: Option, page: str) -> nodes.row:
        name = nodes.literal("", f"{option.stage}={option.name}")
        link = nodes.reference("", "", name, refuri=f"{page}#{_anchor(option)}", internal=True)
        description = option.documentation.rpartition(VARIANT)[2]  # of a variant: its difference from the class
        return nodes.row("", nodes.entry("", nodes.paragraph("", "", link)), nodes.entry("", paragraph(description)))


class Settings(SphinxDirective):
    """Directive for the settings of a main config, such as `seed`, with the comments of its YAML."""

    required_arguments = 1  # the config's name

    def run(self) -> list[nodes.Node]:
        return [table(settings((CONF / f"{self.arguments[0]}.yaml").read_text()))]


def settings(text: str) -> Iterator[Row]:
    """Yield a row for each setting of a main config, such as `evaluation.names`, without Hydra's settings."""
    group = ""
    for match in filter(None, map(_SETTING.fullmatch, text.splitlines())):
        indented, key, value, comment = match.groups()
        group = group if indented else key
        if group in ("defaults", "hydra") or not value:
            continue
        found = yaml.safe_load(value)
        yield Row(f"{group}.{key}" if indented else key, _type(found), yaml_value(found), comment or "")


class Files(SphinxDirective):
    """Directive for the choices of a config group without plugins, with first comments and rows of experiments."""

    required_arguments = 1  # the group

    def run(self) -> list[nodes.Node]:
        group = self.arguments[0]
        return [
            definitions(
                (f"{group}={path.stem}", _head(path.read_text()) + _rows(group, path.stem))
                for path in sorted((CONF / group).iterdir())
            )
        ]


class Commands(SphinxDirective):
    """Directive for the commands of `instancemap` with their descriptions."""

    def run(self) -> list[nodes.Node]:
        return [definitions(COMMANDS.items())]


class Recordings(SphinxDirective):
    """Directive for the formats of `instancemap import`."""

    def run(self) -> list[nodes.Node]:
        return [definitions((kind.name, kind.needs) for kind in FORMATS)]


def _head(text: str) -> str:
    """Return the comment at the top of a YAML file, without Hydra's `# @package`."""
    lines = [line for line in text.splitlines() if not line.startswith("# @")]
    head = []
    for line in lines:
        if not line.startswith("#"):
            break
        head.append(line.removeprefix("#").strip())
    return " ".join(head)


def _rows(group: str, name: str) -> str:
    """Return a sentence with the rows of an experiment, or nothing for other groups."""
    if group != "experiment":
        return ""
    return f" Rows: {', '.join(f'`{row}`' for row in composed(f'experiment={name}', 'row=any').rows)}."


def _type(value: object) -> str:
    return "" if value is None else type(value).__name__


def yaml_value(value: object) -> str:
    """Return a value in command-line syntax."""
    return str(yaml.safe_dump(value, default_flow_style=True)).partition("\n")[0]


def paragraph(text: str) -> nodes.paragraph:
    """Return a paragraph of parsed Markdown."""
    return nodes.paragraph("", "", *inline(text))


def inline(text: str) -> Iterator[nodes.Node]:
    """Yield the nodes of a text; words in single or double backticks are code."""
    for k, part in enumerate(re.split(r"`+", text)):
        if part:
            yield nodes.literal("", part) if k % 2 else nodes.Text(part)


def definitions(items: Iterable[tuple[str, str]]) -> nodes.definition_list:
    """Return a definition list."""
    found = nodes.definition_list()
    for term, meaning in items:
        found += nodes.definition_list_item(
            "", nodes.term("", "", nodes.literal("", term)), nodes.definition("", paragraph(meaning))
        )
    return found


def table(rows: Iterable[Row]) -> nodes.table:
    """Return a table with one row per parameter: name, type and default on the left, description on the right."""
    return table_of(("Parameter", "Meaning"), map(_row, rows), (45, 55))


def table_of(titles: tuple[str, str], rows: Iterable[nodes.row], widths: tuple[int, int]) -> nodes.table:
    """Return a table with two columns of the given relative widths."""
    group = nodes.tgroup("", *(nodes.colspec(colwidth=width) for width in widths), cols=2)
    group += nodes.thead("", nodes.row("", *(nodes.entry("", paragraph(title)) for title in titles)))
    group += nodes.tbody("", *rows)
    return nodes.table("", group, classes=["parameters"])


def _anchor(option: Option) -> str:
    """Return the id of the section of an option on the page of its stage."""
    return f"{option.stage}-{option.name}".replace("_", "-")


def _row(row: Row) -> nodes.row:
    kind = [nodes.Text(f"{row.type}{' = ' if row.type else '= '}"), nodes.literal("", row.default or '""')]
    lines = nodes.line_block("", nodes.line("", "", nodes.literal("", row.name)), nodes.line("", "", *kind))
    return nodes.row("", nodes.entry("", lines), nodes.entry("", paragraph(row.meaning)))


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the extension with Sphinx."""
    app.add_directive("options", Options)
    app.add_directive("overview", Overview)
    app.add_directive("settings", Settings)
    app.add_directive("files", Files)
    app.add_directive("commands", Commands)
    app.add_directive("recordings", Recordings)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
