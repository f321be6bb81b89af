"""`instancemap plugins [STAGE [NAME]]`: list the plugins of each stage with documentation and parameters.

The list includes options of installed packages (entry point `instancemap.configs`) and options in the folders of
--config-dir.
"""

from __future__ import annotations

import argparse
import atexit
import dataclasses
import gc
import inspect
import re
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.commands.command_line import arguments, one_line_errors
from framework.config.composition import config_loader, one_line
from framework.config.hydra_api import CachingConfigRepository
from framework.errors import ConfigError, DataError
from framework.registry import GROUPS, check_option, composition, find_class, holds_one, parameter_fields, plugin_fields
from framework.vocabulary.label_spaces import SPACES

COMMENTED_KEY = re.compile(r"^(?P<key>\w+):[^#\n]*#[ ]*(?P<comment>.*\S)\s*$", re.MULTILINE)
_HEAD = re.compile(r"\A# (?!@)(?P<comment>.*\S)\s*$", re.MULTILINE)


@dataclass(frozen=True)
class Parameter:
    """A parameter of a plugin, with its comment in the YAML file of the option."""

    name: str
    type: str
    default: str
    comment: str


@dataclass(frozen=True)
class Option:
    """An option of a stage, i.e. a YAML file that registers a class."""

    stage: str
    name: str
    target: str
    provider: str  # of the file in Hydra's search path: main, command-line (--config-dir) or a third-party package
    # first paragraph of the class docstring and the change of a variant, or the error of an unusable option
    documentation: str
    parameters: tuple[Parameter, ...]


def registered(*stages: str, only: str | None = None) -> list[Option]:
    """Return the options of config groups. With `only`, return only the options of this name."""
    with config_loader() as loader:
        files = CachingConfigRepository(loader.repository)  # shared, because the options have most configs in common
        return [
            _option(files, stage, name)
            for stage in stages
            for name in loader.get_group_options(stage)
            if only in (None, name)
        ]


def options_of(stage: str) -> list[str]:
    """Return the names of all options of a stage, including unusable options."""
    with config_loader() as loader:
        return list(loader.get_group_options(stage))


def _option(files: CachingConfigRepository, stage: str, name: str) -> Option:
    source = next(source for source in files.get_sources() if source.is_config(f"{stage}/{name}"))
    target = ""
    try:
        own: Any = files.load_config(f"{stage}/{name}")
        target = str(own.config.get("_target_"))
        made_of = composition(files, stage, name)  # package of the option's file and of each included file, by path
        texts, configs = [], []
        for path in (path for path, package in made_of.items() if package == stage):
            part: Any = files.load_config(path)
            texts.append(_text(part.path, f"{path}.yaml"))
            configs.append(part.config)
        node: Any = OmegaConf.merge(*configs)
        target = str(node.get("_target_"))
        plugin_class = find_class(GROUPS[stage], target)
        check_option(f"{stage} {target}", plugin_class, node)
    except (ConfigError, DataError, HydraException, OmegaConfBaseException, OSError, ValueError) as error:
        return Option(stage, name, target, source.provider, f"unusable: {one_line(error)}", ())
    given: Any = OmegaConf.to_container(node, resolve=False)
    nested = {name: _nested(made_of, f"{stage}.{name}", plugin_class) for name in plugin_fields(plugin_class)}
    comments = {match["key"]: match["comment"] for text in texts for match in COMMENTED_KEY.finditer(text)}
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
    if change and len(texts) > 1:
        documentation += f" Here: {change['comment']}."
    return Option(stage, name, target, source.provider, documentation, parameters)


def _nested(made_of: Mapping[str, str], place: str, plugin_class: type) -> str:
    """Return the names of the options in a plugin field such as detector.detector, separated by commas."""
    if holds_one(plugin_class, place.rpartition(".")[2]):
        own = [path for path, package in made_of.items() if package == place]
        return own[-1].rpartition("/")[2] if own else ""  # after the inherited options
    packages = (package for package in made_of.values() if f"{place}." in package)
    return ", ".join(dict.fromkeys(package.rpartition(".")[2] for package in packages))


def _default(field: dataclasses.Field[Any]) -> object:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return "???" if field.default is dataclasses.MISSING else field.default


def _text(source: str, name: str) -> str:
    """Return the text of a YAML file in a config source, or "" for the configs of Hydra."""
    scheme, _, root = source.partition("://")
    return Path(root, name).read_text() if scheme == "file" else ""


def describe(option: Option) -> str:
    """Return an option as indented text, with one line for each parameter."""
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
    """Run the command `instancemap plugins`."""
    parser = argparse.ArgumentParser(description="List the plugins of each stage and their parameters.")
    stages_listed = f"stage to list: {', '.join(GROUPS)}; default: all stages"
    parser.add_argument("stage", metavar="STAGE", nargs="?", choices=GROUPS, help=stages_listed)
    parser.add_argument("name", metavar="NAME", nargs="?", help="plugin to list; default: all plugins of the stage")
    parsed = arguments(parser)
    with one_line_errors():
        stages = [parsed.stage] if parsed.stage else list(GROUPS)
        # garbage collection of torch's objects would add a fifth to the run time of the command, here and at exit
        atexit.register(gc.freeze)
        gc.disable()
        options = registered(*stages, only=parsed.name)
        gc.enable()
        if parsed.name and not options:
            there = ", ".join(options_of(parsed.stage))
            raise ConfigError(f"{parsed.stage}: expected one of {there}, got {parsed.name}")
        for stage in stages:
            print(f"{stage} ({GROUPS[stage].__name__}): choose with {stage}=NAME, set with {stage}.PARAMETER=VALUE\n")
            described = [describe(option) for option in options if option.stage == stage]
            print("\n\n".join(described) or "  (none)", end="\n\n")
            if stage == "detector":
                spaces = ", ".join(f"{name} ({len(classes)} classes)" for name, classes in SPACES.items())
                print(f"  Label spaces: {spaces}, or a text file with one name per line\n")
