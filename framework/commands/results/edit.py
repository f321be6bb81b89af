"""`instancemap edit RUN`: merge, split, rename and delete instances of a stored run."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from framework.commands.command_line import arguments, one_line_errors


class _Append(argparse.Action):
    """Append the option and its values to a list that is common to several options."""

    def __call__(
        self, _parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, _option: str | None = None
    ) -> None:
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), (self.option_strings[0], values)])


def main() -> None:
    """Run the command `instancemap edit`."""
    parser = argparse.ArgumentParser(
        description="Merge, split, rename and delete instances of a stored run, and write a new run directory with the "
        "edited map. Options may be repeated and are applied in the given order."
    )
    add = parser.add_argument
    add("run", metavar="RUN", type=Path, help="run directory")

    def add_edit(option: str, metavar: str | tuple[str, ...], nargs: str | int | None, text: str) -> None:
        add(option, metavar=metavar, nargs=nargs, action=_Append, dest="edits", default=[], help=text)

    add_edit("--merge", "ID", "+", "merge instances into the first one")
    parts = "split an instance by its connected parts (default) or its dominant plane; the largest part keeps the id"
    add_edit("--split", ("ID", "parts|plane"), "+", parts)
    add_edit("--rename", ("ID", "NAME"), 2, "set the class of an instance, with probability 1; new classes are allowed")
    add_edit("--delete", "ID", "+", "change instances to background")
    add_edit("--edits", "FILE", None, "apply the edits in a JSON file, such as edits.json of an edited run")
    add("--out", metavar="DIR", type=Path, help="new run directory; default: RUN_edited, next to RUN")
    preview = "write only the preview image, to OUT.png; without edits, show and list the instances with their ids"
    add("--preview", action="store_true", help=preview)
    parsed = arguments(parser)
    if not parsed.edits and not parsed.preview:
        parser.error("expected at least one of --merge, --split, --rename, --delete and --edits, got none")
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    with one_line_errors():
        from framework.editing.edited_run import PREVIEW, EditedRun, default_directory  # slow import
        from framework.editing.edits import Edit, edit_of, read_edits
        from framework.editing.opened_run import check_empty

        def edits_of_option(option: str, values: Any) -> Sequence[Edit]:
            if option == "--edits":
                return read_edits(Path(values))
            operation = option.removeprefix("--")
            return [edit_of(option, operation, [_number(values[0]), *_rest(operation, values[1:])])]

        edits = [edit for option, values in parsed.edits for edit in edits_of_option(option, values)]
        out = parsed.out or default_directory(parsed.run)
        if not parsed.preview:
            check_empty(out)  # before the slow steps
        edited = EditedRun.of(parsed.run, edits)
        print("\n".join(edited.changes or edited.before.names.values()))
        if parsed.preview:
            image = out.with_name(f"{out.name}.png")
            edited.write_preview(image)
            print(image)
            return
        edited.write(out)
        print(out)
        print(out / PREVIEW)


def _number(word: str) -> int | str:
    return int(word) if word.isascii() and word.isdecimal() and len(word) < 20 else word


def _rest(operation: str, words: Sequence[str]) -> list[int | str]:
    return [*words] if operation in ("rename", "split") else [_number(word) for word in words]
