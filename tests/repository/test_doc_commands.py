"""Tests that every command and script in README.md, CONTRIBUTING.md and docs/ is tested."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
import sys
import tomllib
from importlib.util import find_spec
from typing import Any

import pytest

from framework import __main__ as main
from tests.repository.test_readme import BENCHMARKS, COMMANDS, OWN_DATA, OWN_PLUGIN, RUNNABLE
from tests.support.doc_pages import CHECKOUT, LINES, PAGES, block, blocks

pytestmark = pytest.mark.integration

EXECUTED = [
    "class ColorBlobs",
    'load_runs("outputs/ablation_refiner',
]  # executed in test_readme.py
CONTRACT = block("python", "class TestMyRefiner")
PARSED = [line for line in LINES if line.startswith("python -m framework ") and line.split()[3] in main.COMMANDS]


OURS = ("python", "instancemap", "make", "pip", "docker")


RUN_ELSEWHERE = {"python -m framework doctor"}  # executed in test_doctor.py


class ParsedError(Exception):
    """Error that is raised instead of running a command."""


@pytest.mark.parametrize("command", [line for line in PARSED if line not in {*COMMANDS, *RUNNABLE, *RUN_ELSEWHERE}])
def test_documented_command_line_is_parsed(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parse = argparse.ArgumentParser.parse_intermixed_args

    def parse_and_stop(parser: argparse.ArgumentParser, words: list[str]) -> None:
        parse(parser, words)
        raise ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_intermixed_args", parse_and_stop)
    monkeypatch.setattr(sys, "argv", ["instancemap", *shlex.split(command)[4:]])
    with pytest.raises(ParsedError):
        importlib.import_module(main.module_of(command.split()[3])).main()


def test_documented_commands_and_scripts_are_all_tested() -> None:
    """Commands of other programs such as viewers are excluded."""
    make = re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(), re.MULTILINE)
    looked_at = {*COMMANDS, *RUNNABLE, *PARSED, *BENCHMARKS, *(f"make {target}" for target in make), OWN_PLUGIN}
    shown_in = (CHECKOUT / "docker" / "Dockerfile").read_text()
    looked_at |= {
        "pip install .",
        *(
            line for line in LINES if re.match("python docs/(results/(ranks|steps)|gallery/picture).py ", line)
        ),  # test_ranks.py, test_steps.py, test_gallery.py
        *(line for line in LINES if (name := re.match(r"python -m (tests\.[\w.]+)", line)) and find_spec(name[1])),
        *(line for line in LINES if line.startswith("docker ") and f"#   {line}\n" in shown_in),
    }
    assert not [line for line in LINES if line.split()[0] in OURS and line not in looked_at]
    scripts = {
        CONTRACT,
        *OWN_DATA,
        *blocks("python", "README.md"),  # test_new_plugin.py
        *blocks("python", "docs/python.md"),
        *blocks("python", "docs/tutorials/research_project.md"),  # test_research_workflow.py
        *(block("python", words) for words in EXECUTED),
    }
    assert not set(blocks("python")) - scripts


def test_documented_extras_exist() -> None:
    extras = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    lists = [found for text in PAGES.values() for found in re.findall(r"instancemap\[([\w,-]+)\]", text)]
    named = {extra for extras_of_command in lists for extra in extras_of_command.split(",")}
    assert len(named) > 8
    assert not named - set(extras)


def test_documented_contract_inherits_tests() -> None:
    names: dict[str, Any] = {"__name__": "my_package"}
    exec(CONTRACT, names)
    inherited = {name for name in dir(names["TestMyRefiner"]) if name.startswith("test_")}
    assert {"test_option_lists_every_parameter_with_comment", "test_refiner_is_repeatable"} <= inherited
