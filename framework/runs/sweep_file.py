"""Reading of multirun.yaml, the config of the last sweep in a folder."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.validation import checked_rows
from framework.errors import ConfigError, first_line
from framework.runs.provenance import OF_SPEED, WITHOUT_EFFECT
from framework.runs.stored_runs import read_yaml

# references to keys of the same config, such as ${sequences.all}
_INTERNAL_REFERENCE = re.compile(r"\$\{[\w.]+\}|\$\{all_of:\$\{[\w.]+\}\}")

WITHOUT_CHANGES = {"experiment", "launcher", *WITHOUT_EFFECT} - {*OF_SPEED, "sequences"}
"""Keys and groups that affect neither the results nor the speed of a run."""

SWEEP = "multirun.yaml"  # written by Hydra's sweeper
MAX_VALUES = 1000  # maximum number of values of a key; a range may have more
MAX_RUNS = 100_000  # maximum number of combinations of the values of all keys


def read_sweep(directory: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Read the config of the last sweep in `directory`; {} = no sweep. Apply `overrides` to its table and figure.

    Raises DataError if the file cannot be read, and ConfigError for an invalid override.
    """
    sweep = read_yaml(directory / SWEEP) if (directory / SWEEP).exists() else {}
    for text in overrides:
        try:
            override = OverridesParser.create().parse_override(text)
        except HydraException as error:
            raise ConfigError(f"{text}: expected KEY=VALUE, got an error ({first_line(error)})") from error
        if override.is_sweep_override() or override.is_delete():
            raise ConfigError(f"{text}: expected one value, got a sweep or a deletion; set one value")
        block, _, key = override.key_or_group.partition(".")
        node = OmegaConf.create({} if sweep.get(block) is None else sweep[block])
        OmegaConf.update(node, key, override.value(), force_add=True)
        sweep[block] = OmegaConf.to_container(node, resolve=False)
    return sweep


def requested_runs(sweep: Mapping[str, Any], keys: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the values of `keys` in each job of a sweep.

    The result is empty if a key is not set by the sweep, or if its values depend on other settings.
    """
    overrides = {override.key_or_group: override for override in _overrides(sweep)}
    if not all(key in overrides for key in keys):
        return []
    try:
        values = [_values(overrides[key]) for key in keys]
    except HydraException:  # glob(*) depends on the config groups
        return []
    plain = not any("${" in value for column in values for value in column)
    return list(itertools.islice(itertools.product(*values), MAX_RUNS)) if plain else []


def asked_keys(sweep: Mapping[str, Any]) -> set[str] | None:
    """Return the keys and groups that the overrides of a sweep set, or None without a sweep."""
    return {override.key_or_group for override in _overrides(sweep)} if sweep else None


def command_line(sweep: Mapping[str, Any]) -> list[str]:
    """Return the overrides on the command line of a sweep that affect results or speed."""
    found = []
    for text in _below(sweep, "overrides", "task", list):
        with suppress(HydraException):
            key = OverridesParser.create().parse_override(str(text)).key_or_group
            if key.partition(".")[0] not in WITHOUT_CHANGES:
                found.append(str(text))
    return found


def sweep_rows(sweep: Mapping[str, Any]) -> dict[str, list[str]]:
    """Return the resolved overrides of each row of an experiment, by name.

    Raises:
        ConfigError: The rows are invalid.
    """
    rows = checked_rows(sweep.get("rows"))
    try:
        resolved = OmegaConf.to_container(_without_hydra(sweep).rows, resolve=True) if rows else {}
    except OmegaConfBaseException:  # ${hydra:...}, or a missing key
        return rows
    return checked_rows(resolved)


def _overrides(sweep: Mapping[str, Any]) -> list[Override]:
    """Return the overrides of the experiment, followed by those of the command line, which take precedence."""
    found = []
    for text in [*_params(sweep), *_below(sweep, "overrides", "task", list)]:
        with suppress(HydraException):  # ${all_of:${rows}} is not a value
            found.append(OverridesParser.create().parse_override(str(text)))
    return found


def _params(sweep: Mapping[str, Any]) -> Iterator[str]:
    """Yield the parameters of the sweeper as overrides, with resolved references."""
    params = _below(sweep, "sweeper", "params", dict)
    node = OmegaConf.merge(_without_hydra(sweep), {"params": _without_external_references(params)}).params
    for key in params:
        with suppress(OmegaConfBaseException):  # ${hydra:...}, or a missing key
            yield f"{key}={node[key]}"


def _without_hydra(sweep: Mapping[str, Any]) -> DictConfig:
    """Return the config of a sweep without the key `hydra` and without external references."""
    return OmegaConf.create(
        {key: _without_external_references(value) for key, value in sweep.items() if key != "hydra"}
    )


def _without_external_references(node: Any) -> Any:
    """Replace references to values outside the config, such as ${oc.env:...}, with "???"."""
    if isinstance(node, Mapping):
        return {key: _without_external_references(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_without_external_references(value) for value in node]
    return "???" if isinstance(node, str) and "${" in _INTERNAL_REFERENCE.sub("", node) else node


def _below(sweep: Mapping[str, Any], part: str, name: str, kind: type) -> Any:
    """Return the value of `hydra.<part>.<name>`, or an empty value if it is missing or not of type `kind`."""
    node: Any = sweep
    for key in ("hydra", part, name):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node if isinstance(node, kind) else kind()


def _values(override: Override) -> list[str]:
    """Return the values of an override as text."""
    if not override.is_sweep_override():
        return [str(override.value())]
    parser = OverridesParser.create()
    texts = itertools.islice(override.sweep_string_iterator(), MAX_VALUES)
    return [str(parser.parse_override(f"x={text}").value()) for text in texts]
