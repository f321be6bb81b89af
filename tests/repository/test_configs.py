"""Tests that every option of every config group composes and builds."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.errors import ConfigError, DataError
from framework.figures.figure_choice import FigureChoice
from framework.files.search_paths import CONF
from framework.interfaces import RGBDSequence
from framework.registry import (
    GROUPS,
    STAGES,
    find_class,
    holds_one,
    parameter_fields,
    parameters,
    plugin_fields,
)
from framework.runs.provenance import WITHOUT_EFFECT
from framework.tables.table_choice import TableChoice
from framework.training.trainer import Schedule
from tests.support import registered

pytestmark = pytest.mark.integration


@pytest.mark.parametrize(("stage", "name"), registered.OPTIONS)
def test_option_composes_and_builds(stage: str, name: str, ready: Callable[..., object]) -> None:
    assert isinstance(ready(stage, name), GROUPS[stage])


REQUIRED = {  # the first required parameter, keyed by option
    key: asked[0]
    for key, option in registered.OPTION.items()
    if (asked := [parameter.name for parameter in option.parameters if parameter.default == "???"])
}


@pytest.mark.parametrize(("stage", "name"), REQUIRED)
def test_option_missing_required_parameter_or_file_raises(stage: str, name: str) -> None:
    key = f"{stage}.{REQUIRED[stage, name]}"
    with pytest.raises(ConfigError, match=rf"expected a value for .*, got none; set .*{key}"):
        registered.built(stage, name)
    with pytest.raises(DataError, match="/nowhere"):
        registered.built(stage, name, f"{key}=/nowhere")


@pytest.mark.parametrize(("stage", "name"), registered.OPTIONS)
def test_option_yaml_lists_all_parameters_with_comments(stage: str, name: str) -> None:
    option = registered.OPTION[stage, name]
    assert option.documentation
    assert not option.documentation.startswith("unusable"), option.documentation
    node = registered.composed(stage, name)[stage]
    assert {parameter.name for parameter in option.parameters} == set(node) - {"_target_"}
    assert not [parameter.name for parameter in option.parameters if not parameter.comment]


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default value, or "???" (OmegaConf's marker of a missing value)."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return "???" if field.default is dataclasses.MISSING else field.default


@pytest.mark.parametrize(("stage", "name"), registered.OPTIONS)
def test_option_yaml_values_equal_class_defaults(stage: str, name: str) -> None:
    """Variants may have other values. Required parameters have no default in the file or in the class."""
    path = CONF / stage / f"{name}.yaml"
    own = OmegaConf.load(path)
    is_variant = "_target_" not in own  # a variant of the option that it inherits
    assert not is_variant or re.match(r"# (?!@)\S", path.read_text()), "expected a comment on the variant in line 1"
    node = registered.composed(stage, name)[stage]
    plugin_class = find_class(GROUPS[stage], node["_target_"])
    links = plugin_fields(plugin_class)
    for key in links:
        one = holds_one(plugin_class, key)
        shown = next(
            parameter.default for parameter in registered.OPTION[stage, name].parameters if parameter.name == key
        )
        for link in [shown] if one else node[key]:
            found = node[key] if one else node[key][link]
            assert found == registered.composed(stage, link)[stage], "expected the link to equal the option of its name"
    fields = [field for name, (field, _) in parameter_fields(plugin_class).items() if name not in links]
    asked = [field.name for field in fields if OmegaConf.is_missing(node, field.name)]
    answered = set(own) if is_variant else set()  # desk sets the path of its frames
    assert asked == [field.name for field in fields if default_of(field) == "???" and field.name not in answered]
    typed = parameters(stage, plugin_class, OmegaConf.merge(node, dict.fromkeys(asked, "given by the user")))
    differing = {
        field.name: f"{value!r} and not {default!r}"
        for field in fields
        for value, default in [(typed[field.name], default_of(field))]
        if field.name not in asked and (type(value), value) != (type(default), default)
    }
    assert set(differing) == (set(own) - {"defaults"} if is_variant else set()), differing
    of_the_run = {key for key in node if OmegaConf.is_interpolation(node, key)}
    assert of_the_run <= {"seed", "device"}, "expected references only to seed and device, which each run sets"


def test_schedule_and_table_yaml_equal_class_defaults() -> None:
    schedule = OmegaConf.load(CONF / "train_detector.yaml").schedule
    assert Schedule(**schedule) == Schedule()
    assert set(schedule) == {field.name for field in dataclasses.fields(Schedule)} - {"seed", "budget"}
    table = OmegaConf.load(CONF / "parts" / "experiment.yaml").table
    assert TableChoice.of(table) == TableChoice(columns=list(table.columns))
    assert set(table) == {field.name for field in dataclasses.fields(TableChoice)}


@pytest.mark.parametrize("name", registered.names("dataset", RGBDSequence))
def test_recorded_datasets_have_frame_range_parameters(name: str) -> None:
    assert {"start", "stop", "stride", "frame_fraction"} <= set(registered.composed("dataset", name).dataset)


def test_main_config_lists_experiment_last_in_defaults() -> None:
    defaults = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").defaults)
    assert isinstance(defaults, list)
    assert defaults[0] == "_self_"
    after_the_stages = ["dataset", "viewer", "launcher", "preset", "experiment"]  # that may override the stages
    stages = [stage for stage in STAGES if stage not in after_the_stages]
    assert [next(iter(entry)) for entry in defaults[1:]] == stages + after_the_stages
    assert defaults[-1] == {"experiment": None}


def test_sweep_run_names_exclude_keys_without_effect() -> None:
    """Otherwise skip_completed=true would not find runs with other values of these keys."""
    main = OmegaConf.load(CONF / "config.yaml")
    left_out = set(OmegaConf.select(main, "hydra.job.config.override_dirname.exclude_keys"))
    shown = {
        f"viewer.{key}" for name in registered.names("viewer") for key in registered.composed("viewer", name).viewer
    }
    for name, choice in (("table", TableChoice), ("figure", FigureChoice)):
        shown |= {f"{name}.{field.name}" for field in dataclasses.fields(choice)}
    shown |= {"evaluation.label_space", "evaluation.names", "evaluation.doubled_instances"}
    assert shown - {"viewer._target_"} == {key for key in left_out if "." in key}
    tells_runs_apart, no_key_of_the_config = {"hydra", "row", "rows", "sequences"}, {"experiment", "launcher", "out"}
    whole = {key for key in left_out if "." not in key}
    assert set(WITHOUT_EFFECT) - tells_runs_apart == whole - no_key_of_the_config
