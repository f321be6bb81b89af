"""Tests for the requested runs of a sweep, which are read from multirun.yaml."""

from __future__ import annotations

from typing import Any

import pytest

from framework.errors import ConfigError
from framework.runs.sweep_file import asked_keys, command_line, requested_runs, sweep_rows


def sweep(params: Any, task: Any) -> dict[str, Any]:
    return {"hydra": {"sweeper": {"params": params}, "overrides": {"task": task}}}


def test_requested_runs_command_line_overrides_experiment() -> None:
    asked = sweep({"row": "${all_of:${rows}}", "dataset.scene": "011,016", "seed": 0}, ["seed=0,1", "launcher=joblib"])
    expected = [("0", "011"), ("0", "016"), ("1", "011"), ("1", "016")]
    assert requested_runs(asked, ["seed", "dataset.scene"]) == expected


def test_sweep_rows_resolves_interpolations() -> None:
    config = {"rows": {"third": ["dataset.stop=${sequences.in_progress}"], "whole": []}, "hydra": {"x": "${hydra:y}"}}
    assert sweep_rows(config | {"sequences": {"in_progress": 80}}) == {"third": ["dataset.stop=80"], "whole": []}
    assert sweep_rows(config) == config["rows"], "expected unchanged unresolved values"
    assert sweep_rows({}) == {}
    with pytest.raises(ConfigError, match="rows: expected a mapping of names to overrides"):
        sweep_rows({"rows": ["a"]})


def test_sweep_file_does_not_resolve_environment_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SECRET", "hunter2")
    config = {"rows": {"a": ["x=${oc.env:SECRET}"], "b": ["x=${c}"]}, "c": "${oc.env:SECRET}"}
    assert "hunter2" not in repr(sweep_rows(config))
    asked = config | sweep({"seed": "${oc.env:SECRET}", "other": "${c}"}, [])
    assert requested_runs(asked, ["seed"]) == requested_runs(asked, ["other"]) == []


def test_requested_runs_resolves_sequence_interpolation() -> None:
    asked = {"sequences": {"all": "a,b"}} | sweep({"dataset.scene": "${sequences.all}", "seed": 0, "x": "${y}"}, [])
    assert requested_runs(asked, ["seed", "dataset.scene"]) == [("0", "a"), ("0", "b")]


@pytest.mark.parametrize(
    ("override", "values"),
    [
        ("seed=7", ["7"]),
        ("seed=range(0,3)", ["0", "1", "2"]),
        ("seed=choice(3,1)", ["3", "1"]),
        ("seed='a b',c", ["a b", "c"]),
        ("seed=0.01,1e-3", ["0.01", "0.001"]),
    ],
)
def test_requested_runs_expands_hydra_override_values(override: str, values: list[str]) -> None:
    assert requested_runs(sweep({}, [override]), ["seed"]) == [(value,) for value in values]


def test_requested_runs_limits_large_ranges() -> None:
    assert len(requested_runs(sweep({}, ["seed=range(0,100000000)"]), ["seed"])) == 1000
    both = sweep({}, ["seed=range(0,100000000)", "frames=range(0,100000000)"])
    assert len(requested_runs(both, ["seed", "frames"])) == 100_000


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"hydra": None},
        {"hydra": {"sweeper": [], "overrides": {"task": "seed=1"}}},
        sweep(None, None),
        sweep({"seed": "${x}"}, []),
        sweep({"other": {"a": 1}}, [{"seed": 1}, "", "="]),
        sweep({}, ["seed=glob(*)"]),
        sweep({}, ["other=1,2"]),
    ],
)
def test_requested_runs_unresolvable_sweep_is_empty(config: dict[str, Any]) -> None:
    assert requested_runs(config, ["seed"]) == []


def test_command_line_omits_settings_without_effect() -> None:
    chosen = [
        "experiment=x",
        "row=a,b",
        "table.columns=[fps]",
        "+table.where.dataset=desk",
        "viewer=rerun",
        "debug=true",
    ]
    kept = ["dataset.stride=3", "seed=0,1", "threads=1", "sequences=replica", "~preset"]
    assert command_line(sweep({"seed": "0"}, [*chosen, *kept])) == kept
    assert command_line({}) == []


def test_asked_keys_are_those_of_sweeper_and_command_line() -> None:
    asked = sweep({"row": "a,b", "dataset.scene": "011"}, ["refiner=x,y", "+fuser.new=1", "seed=0"])
    assert asked_keys(asked) == {"row", "dataset.scene", "refiner", "fuser.new", "seed"}
    assert asked_keys({}) is None
