"""Text and path values in overrides KEY=VALUE, which Hydra would reject or convert to numbers.

Hydra parses every value by its own grammar: it rejects `dataset.root=Küche` and reads `dataset.scene=2024_01_05` as a
number. The value of a text or path parameter is therefore quoted before Hydra parses it. Commas separate values only in
a sweep. Values in quotes, interpolations such as ${oc.env:HOME}, and null for an optional parameter keep their meaning.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum, auto
from functools import cache, cached_property, lru_cache
from itertools import zip_longest
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString, ValueType
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from framework.config.composition import added_config_dirs, config_loader
from framework.config.hydra_api import version_base
from framework.config.renamed_keys import replace_in_overrides
from framework.config.validation import checked_rows, without_interpolation

SELECTING = (
    "dataset",
    "detector",
    "masking",
    "tracker",
    "refiner",
    "fuser",
    "backend",
    "viewer",
    "experiment",
    "preset",
)
"""Config groups that select the plugins of a run."""

OF_HYDRA = ("hydra", "now")  # resolvers that Hydra registers when it starts an application


class TextKind(Enum):
    """Kind of a parameter with text as its value."""

    NONE = auto()  # no text: Hydra parses the value
    TEXT = auto()
    OPTIONAL_TEXT = auto()  # null = None
    PATH = auto()  # unlike for TEXT, numbers are also invalid if they are not converted to text
    OPTIONAL_PATH = auto()
    LIST = auto()  # list of strings
    CONDITION = auto()  # values of any type, compared as text

    @classmethod
    def of(cls, kind: Any) -> TextKind:
        """Return the kind of a parameter from its type."""
        parts = set(get_args(kind)) if isinstance(kind, UnionType) or get_origin(kind) is Union else {kind}
        optional = NoneType in parts
        parts.discard(NoneType)
        if get_origin(kind) is list and get_args(kind) == (str,):
            return cls.LIST
        if Path in parts and parts <= {Path, str}:
            return cls.OPTIONAL_PATH if optional else cls.PATH
        if parts == {str}:
            return cls.OPTIONAL_TEXT if optional else cls.TEXT
        return cls.NONE


KEYS: Mapping[str, TextKind] = {
    **dict.fromkeys(("resume_from", "localize_in", "depth_distortion_from"), TextKind.OPTIONAL_PATH),
    **dict.fromkeys(("detection_cache_dir", "out"), TextKind.OPTIONAL_PATH),
    **dict.fromkeys(("network.start_from", "pictures.folder"), TextKind.OPTIONAL_PATH),  # of train-detector
    **dict.fromkeys(("hydra.run.dir", "hydra.sweep.dir"), TextKind.PATH),
    **dict.fromkeys(("evaluation.label_space", "table.base"), TextKind.OPTIONAL_TEXT),
    **dict.fromkeys(("table.caption", "table.label", "figure.file_name"), TextKind.TEXT),
}
"""Kinds of the keys that are not parameters of plugins."""


KindOf = Callable[[DictConfig, str], TextKind | None]
"""Function of a config and a dotted key: the kind of the parameter of a plugin, or None for an unknown key."""


def literal(overrides: Sequence[str], kind_of: KindOf, multirun: bool = False) -> list[str]:
    """Return overrides of the main config with quoted text values and without deprecated keys.

    A key that only the options of a swept group have gets the prefix ++, because Hydra first composes the config of a
    sweep with the default option.

    Args:
        overrides: Overrides as typed, KEY=VALUE.
        kind_of: `text_kind` of the registry.
        multirun: True if commas separate values. In an experiment, they always do.

    Raises:
        HydraException: A group has no such option.
    """
    overrides = replace_in_overrides(overrides)
    if all(_is_plain(override) for override in overrides):
        return [*overrides]
    choices = _Choices(overrides, kind_of, multirun)
    quoted = [_quoted(override, choices.kind, choices.sweeps, choices.interpolates) for override in overrides]
    return [f"++{override}" if choices.adds(override.partition("=")[0]) else override for override in quoted]


def literal_in_block(block: str, kinds: Mapping[str, Any], overrides: Sequence[str]) -> list[str]:
    """Return overrides BLOCK.KEY=VALUE with quoted text values.

    Args:
        block: Config key, such as `table`.
        kinds: Types by KEY, such as those of TableChoice.
        overrides: Overrides as typed.
    """

    def kind(key: str) -> TextKind:
        name, _, more = key.removeprefix(f"{block}.").partition(".")
        if more:  # a condition, or the name of a row
            return TextKind.CONDITION if name == "where" else TextKind.TEXT
        return TextKind.of(kinds.get(name))

    return [_quoted(override, kind, False, lambda _: True) for override in overrides]


def value_in(config: DictConfig, override: str, kind_of: KindOf) -> tuple[str, Any]:
    """Return the key and the value of an override of a composed config, with a literal value for text parameters.

    `kind_of` is `text_kind` of the registry.

    Raises:
        HydraException: The override is not KEY=VALUE.
    """

    def kind(key: str) -> TextKind:
        return KEYS.get(key) or kind_of(config, key) or TextKind.NONE

    word = _quoted(override, kind, False, lambda _: True)
    with version_base("1.3"):
        parsed = OverridesParser.create().parse_override(word)
        return parsed.key_or_group, parsed.value()


def typed(key: str, value: object) -> str:
    """Return the override KEY=VALUE with a literal text value, as typed in a shell.

    The value is also literal if it has quotes or `${`.
    """
    text = str(value)
    if re.match(r"\s*['\"]", text) or "${" in text or text == "null":
        text = _in_quotes(without_interpolation(text))
    return shlex.quote(f"{key}={text}")


class _Choices:
    """The plugins that overrides select."""

    def __init__(self, overrides: Sequence[str], kind_of: KindOf, multirun: bool) -> None:
        self._kind_of = kind_of
        self._groups: dict[str, list[str]] = {}  # options of each group
        for override in overrides:
            key, equals, value = override.partition("=")
            if equals and key in SELECTING:
                self._groups[key] = value.split(",")
        # commas also separate values in an experiment, whose config sets the mode of Hydra
        self.sweeps = multirun or OmegaConf.select(self._base, "hydra.mode") is RunMode.MULTIRUN
        self.kind = cache(self._kind)

    @cached_property
    def _base(self) -> DictConfig:
        return _composed(*(f"{group}={options[0]}" for group, options in self._groups.items()))

    def _configs(self) -> Iterator[DictConfig]:
        """Yield the configs of the selected options: the first options, the other options, and the rows."""
        yield self._base
        if not self.sweeps:
            return
        for options in zip_longest(*self._groups.values()):
            chosen = zip(self._groups.items(), options, strict=True)
            yield _composed(*(f"{group}={option or all_[0]}" for (group, all_), option in chosen))
        base = [f"{group}={options[0]}" for group, options in self._groups.items()]
        for row in checked_rows(self._base.get("rows")).values():
            yield _composed(*base, *(word for word in row if word.partition("=")[0] in SELECTING))

    def _kind(self, key: str) -> TextKind:
        if key in KEYS:
            return KEYS[key]
        if key.partition(".")[0] not in SELECTING or "." not in key:
            return TextKind.NONE
        return next(filter(None, (self._kind_of(config, key) for config in self._configs())), TextKind.NONE)

    def adds(self, key: str) -> bool:
        """Return True if options of a swept group have a key that the default option lacks."""
        if not self.sweeps or "." not in key or len(self._groups.get(key.partition(".")[0], ())) < 2:
            return False
        return not _has(_composed(), key) and any(_has(config, key) for config in self._configs())

    def interpolates(self, value: str) -> bool:
        """Return True if all references in a value are to existing keys or resolvers."""
        for name, colon in re.findall(r"\$\{([^:}]*)(:?)", value):
            is_resolver = name in OF_HYDRA or OmegaConf.has_resolver(name)
            if not (is_resolver if colon else OmegaConf.select(self._base, name) is not None):
                return False
        return True


def _has(config: DictConfig, key: str) -> bool:
    parent, _, name = key.rpartition(".")
    node = OmegaConf.select(config, parent)
    return isinstance(node, DictConfig) and name in [*node]  # `name in node` would be False for a value ???


def _composed(*words: str) -> DictConfig:
    """Return the config of options, including the node `hydra`."""
    return _composed_with(words, added_config_dirs())


@lru_cache(maxsize=32)
def _composed_with(words: tuple[str, ...], folders: tuple[Path, ...]) -> DictConfig:
    with config_loader() as loader:
        return loader.load_configuration("config", [*words], RunMode.RUN, from_shell=False)


def _quoted(override: str, kind: Callable[[str], TextKind], sweeps: bool, interpolates: Callable[[str], bool]) -> str:
    key, equals, value = override.partition("=")
    if not equals or key.startswith(("~", "-")) or _is_plain(override):
        return override
    kind_of_key = kind(key.lstrip("+"))
    sweeps = sweeps and not key.lstrip("+").startswith(("table.", "figure."))  # one table for all jobs
    if kind_of_key is TextKind.NONE:
        return override
    parsed = _parsed(override)
    if sweeps and parsed is not None and parsed.is_sweep_override() and parsed.value_type in _FUNCTIONS:
        return override  # choice(), range(), glob() and so on
    values = _split(value) if sweeps else [value]
    return f"{key}={','.join(_literal_value(one, kind_of_key, interpolates) for one in values)}"


_FUNCTIONS = (ValueType.CHOICE_SWEEP, ValueType.GLOB_CHOICE_SWEEP, ValueType.RANGE_SWEEP, ValueType.INTERVAL_SWEEP)


def _literal_value(value: str, kind: TextKind, interpolates: Callable[[str], bool]) -> str:
    parsed = _parsed(f"key={value}")
    found = None if parsed is None or parsed.is_sweep_override() else parsed._value
    listed = kind in (TextKind.LIST, TextKind.CONDITION) and value.startswith("[") and value.endswith("]")
    if isinstance(found, QuotedString) or not value:
        return value
    if kind is TextKind.CONDITION:
        forms = [form for one in (_split(value[1:-1]) if listed else [value]) for form in _forms(one)]
        return forms[0] if len(forms) == 1 and not listed else f"[{','.join(forms)}]"
    if listed and parsed is None:  # Hydra cannot parse the elements
        return f"[{','.join(_literal_value(one, TextKind.TEXT, interpolates) for one in _split(value[1:-1]))}]"
    if kind is TextKind.LIST:
        return value
    if kind in (TextKind.OPTIONAL_TEXT, TextKind.OPTIONAL_PATH) and value == "null":
        return value
    if kind in (TextKind.TEXT, TextKind.OPTIONAL_TEXT) and type(found) in (int, float) and str(found) == value:
        return value  # converted to the same text
    if found == value and ("${" not in value or interpolates(value)):
        return value
    literal_text = value if "${" not in value or interpolates(value) else without_interpolation(value)
    return _in_quotes(literal_text)


def _forms(value: str) -> list[str]:
    """Return a value of a condition as Hydra reads it and, if that is another text, also as typed."""
    parsed = _parsed(f"key={value}")
    if parsed is None or parsed.is_sweep_override():
        return [_in_quotes(value)]
    is_text = isinstance(parsed._value, QuotedString) or str(parsed._value) == value
    return [value] if is_text else [value, _in_quotes(value)]


def _is_plain(override: str) -> bool:
    """Return True if Hydra reads the value of an override as the same text."""
    parsed = _parsed(override)
    return (
        parsed is not None
        and not parsed.is_sweep_override()
        and isinstance(parsed._value, str)
        and parsed._value == override.partition("=")[2]
        and "${" not in parsed._value
    )


def _parsed(override: str) -> Override | None:
    """Return a parsed override, or None if Hydra cannot parse it."""
    try:
        with version_base("1.3"):
            return OverridesParser.create().parse_override(override)
    except HydraException:
        return None


def _split(text: str) -> list[str]:
    """Split a text at the commas outside of quotes and brackets. A backslash before a comma is removed."""
    parts = re.findall(r"(?:\\,|'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\"|\[[^\[\]]*\]|[^,])+", text)
    return [part.strip().replace("\\,", ",") for part in parts]


def _in_quotes(text: str) -> str:
    return str(QuotedString(text, Quote.single).with_quotes())
