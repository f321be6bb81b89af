"""`python -m framework plugins [STAGE [NAME]]`: what is registered for each stage, with documentation and parameters.

The options come from Hydra's own search path, so those of installed third-party packages are listed like any other.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.resources
import inspect
import re
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf

from framework.commands.command_line import arguments, one_line_errors
from framework.configs import config_directory, one_line
from framework.errors import ConfigError
from framework.registry import GROUPS, composition, find_class, parameter_fields, plugin_fields

_COMMENTED_KEY = re.compile(r"^(?P<key>\w+):[^#\n]*#[ ]*(?P<comment>.*\S)\s*$", re.MULTILINE)
_HEAD = re.compile(r"\A# (?!@)(?P<comment>.*\S)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Parameter:
    """One field of a plugin, with what its option's YAML says about it."""

    name: str
    type: str
    default: str
    comment: str


@dataclass(frozen=True)
class Option:
    """One choosable option of a stage: a YAML file that registers a class."""

    stage: str
    name: str
    target: str
    provider: str  # who put it on Hydra's search path: main, or the third-party package
    documentation: str  # the class's first line, and what an option that inherits changes; why it cannot be used, if so
    parameters: tuple[Parameter, ...]


def registered(stage: str, only: str | None = None) -> list[Option]:
    """The options of a config group, by name, or the one that is asked for."""
    with config_directory():
        loader = GlobalHydra.instance().config_loader()
        return [_option(loader, stage, name) for name in loader.get_group_options(stage) if only in (None, name)]


def _option(loader: Any, stage: str, name: str) -> Option:
    own = loader.repository.load_config(f"{stage}/{name}")
    target = str(own.config.get("_target_"))
    try:
        inherited = composition(loader, stage, name)  # and the option's own file
        files = {path: loader.repository.load_config(path) for path, package in inherited.items() if package == stage}
        given = OmegaConf.to_container(OmegaConf.merge(*(file.config for file in files.values())), resolve=False)
        assert isinstance(given, dict)
        target = str(given.get("_target_"))
        plugin_class = find_class(GROUPS[stage], target)
    except (ConfigError, HydraException) as error:
        return Option(stage, name, target, own.provider, f"cannot be used: {one_line(error)}", ())
    nested = {
        name: ", ".join(package.rpartition(".")[2] for package in inherited.values() if f"{stage}.{name}." in package)
        for name in plugin_fields(plugin_class)
    }
    texts = [_text(file.path, f"{path}.yaml") for path, file in files.items()]
    comments = {match["key"]: match["comment"] for text in texts for match in _COMMENTED_KEY.finditer(text)}
    parameters = tuple(
        Parameter(
            name=field.name,
            type=field.type if isinstance(field.type, str) else field.type.__name__,
            default=nested.get(field.name) or str(given.get(field.name, _default(field))),
            comment=comments.get(field.name, ""),
        )
        for field, _ in parameter_fields(plugin_class).values()
    )
    documentation = (inspect.getdoc(plugin_class) or "").partition("\n\n")[0].replace("\n", " ")
    change = _HEAD.match(_text(own.path, f"{stage}/{name}.yaml"))
    if change and len(files) > 1:
        documentation += f" Here: {change['comment']}."
    return Option(stage, name, target, own.provider, documentation, parameters)


def _default(field: dataclasses.Field[Any]) -> object:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return "???" if field.default is dataclasses.MISSING else field.default


def _text(source: str, name: str) -> str:
    """The YAML as it was written: Hydra's configs have lost the comments."""
    scheme, _, root = source.partition("://")
    if scheme == "pkg":
        package, _, folder = root.replace("/", ".").partition(".")
        return importlib.resources.files(package).joinpath(*folder.split("."), *name.split("/")).read_text()
    return Path(root, name).read_text() if scheme == "file" else ""


def describe(option: Option) -> str:
    """An option as indented text: name and documentation, then a line for each parameter."""
    origin = "" if option.provider == "main" else f"  [from {option.provider}]"
    lines = [
        f"  {option.name}{origin}",
        textwrap.fill(option.documentation, 112, initial_indent=" " * 6, subsequent_indent=" " * 6),
    ]
    heads = [f"{parameter.name}: {parameter.type} = {parameter.default}" for parameter in option.parameters]
    width = min(48, max(map(len, heads), default=0))
    for head, parameter in zip(heads, option.parameters, strict=True):
        lines.append(f"      {head:<{width}}  {'# ' if parameter.comment else ''}{parameter.comment}".rstrip())
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Lists the registered plugins.")
    parser.add_argument("stage", nargs="?", choices=GROUPS, help="only this stage")
    parser.add_argument("name", nargs="?", help="only this option")
    asked = arguments(parser)
    with one_line_errors():
        for stage in [asked.stage] if asked.stage else GROUPS:
            options = registered(stage, asked.name)
            if asked.name and not options:
                raise ConfigError(f"there is no {stage}={asked.name}")
            print(f"{stage} ({GROUPS[stage].__name__}): choose with {stage}=NAME, set with {stage}.PARAMETER=VALUE\n")
            print("\n\n".join(map(describe, options)) or "  (none)", end="\n\n")
