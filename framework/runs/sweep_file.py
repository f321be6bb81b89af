"""Hydra's record of a sweep: which runs it was last asked for."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from framework.config.validation import checked_rows

_OF_ITSELF = re.compile(r"\$\{[\w.]+\}|\$\{all_of:\$\{[\w.]+\}\}")  # what our experiments write

SWEEP = "multirun.yaml"  # Hydra's sweeper leaves the experiment's config under this name
MOST_VALUES = 1000  # of a key; a range may claim any number
MOST_RUNS = 100_000  # of all keys together


def asked_runs(sweep: Mapping[str, Any], keys: Sequence[str]) -> list[tuple[str, ...]]:
    """The values of `keys` in each job that the sweep was asked for, without a job begun yet; `sweep` is its config.

    Empty where the config does not say so in plain words, such as a value for each of them.
    """
    asked = {override.key_or_group: override for override in _overrides(sweep)}
    if not all(key in asked for key in keys):
        return []
    try:
        values = [_values(asked[key]) for key in keys]
    except HydraException:  # glob(*), which means nothing without the config groups
        return []
    plain = not any("${" in value for column in values for value in column)
    return list(itertools.islice(itertools.product(*values), MOST_RUNS)) if plain else []


def sweep_rows(sweep: Mapping[str, Any]) -> dict[str, list[str]]:
    """The overrides of each of the experiment's rows, by name, as they were when it ran: without ${...}.

    Raises ConfigError when `rows` is something else.
    """
    rows = checked_rows(sweep.get("rows"))
    try:
        resolved = OmegaConf.to_container(_without_hydra(sweep).rows, resolve=True) if rows else {}
    except OmegaConfBaseException:  # ${hydra:...}, or what is not there
        return rows
    return checked_rows(resolved)


def _overrides(sweep: Mapping[str, Any]) -> list[Override]:
    """Those of the experiment's config first: the ones of the command line win."""
    found = []
    for text in [*_params(sweep), *_below(sweep, "overrides", "task", list)]:
        try:
            found.append(OverridesParser.create().parse_override(str(text)))
        except HydraException:  # ${all_of:${rows}}, which is no text of the command line
            continue
    return found


def _params(sweep: Mapping[str, Any]) -> Iterator[str]:
    """What the experiment's config itself asks for, as overrides: ${sequences.all} is what stands there."""
    params = _below(sweep, "sweeper", "params", dict)
    node = OmegaConf.merge(_without_hydra(sweep), {"params": _of_itself(params)}).params
    for key in params:
        try:
            yield f"{key}={node[key]}"
        except OmegaConfBaseException:  # ${hydra:...}, or what is not there
            continue


def _without_hydra(sweep: Mapping[str, Any]) -> DictConfig:
    """The sweep's own config, in which ${...} may stand for its other keys and for nothing else."""
    return OmegaConf.create({key: _of_itself(value) for key, value in sweep.items() if key != "hydra"})


def _of_itself(node: Any) -> Any:
    """With "???", which cannot be resolved, for what asks for more: ${oc.env:...} would tell of this machine."""
    if isinstance(node, Mapping):
        return {key: _of_itself(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_of_itself(value) for value in node]
    return "???" if isinstance(node, str) and "${" in _OF_ITSELF.sub("", node) else node


def _below(sweep: Mapping[str, Any], part: str, name: str, kind: type) -> Any:
    """`hydra.PART.NAME`, which a file that others have written may hold in another form."""
    node: Any = sweep
    for key in ("hydra", part, name):
        node = node.get(key) if isinstance(node, Mapping) else None
    return node if isinstance(node, kind) else kind()


def _values(override: Override) -> list[str]:
    """What the key becomes, as `str` writes it."""
    if not override.is_sweep_override():
        return [str(override.value())]
    parser = OverridesParser.create()
    texts = itertools.islice(override.sweep_string_iterator(), MOST_VALUES)
    return [str(parser.parse_override(f"x={text}").value()) for text in texts]
