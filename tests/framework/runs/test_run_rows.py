"""Tests of rows, means and paired differences, compared with manual results."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from framework.runs.run_rows import Mean, RunRow, following, rows_of
from framework.runs.stored_runs import Record

AP = "instances.ap50"


def record(config: dict[str, Any], ap: object = 0.5, written: float = 0.0, **choices: str) -> Record:
    metrics = {AP: ap, "pose_source": "tracked", **{f"choice.{stage}": name for stage, name in choices.items()}}
    return Record(Path("somewhere"), metrics, config, written)


def row(name: str, **figures: object) -> RunRow:
    return RunRow(name, {(run.removeprefix("seed"),): record({}, figure) for run, figure in figures.items()})


def names(records: list[Record], *order: str, over: tuple[str, ...] = ("seed",)) -> dict[str, list[tuple[str, ...]]]:
    return {row.name: list(row.records) for row in rows_of(records, over, dict.fromkeys(order, ()))}


def test_mean_has_sample_deviation_and_standard_error() -> None:
    mean = Mean.of([1.0, 2.0, 6.0])
    assert (mean.value, mean.count) == (3.0, 3)
    assert mean.deviation == pytest.approx(math.sqrt((4 + 1 + 9) / 2))
    assert mean.error == pytest.approx(mean.deviation / math.sqrt(3))


def test_mean_of_fewer_than_two_values_has_nan_deviation() -> None:
    one, none = Mean.of([4.0]), Mean.of([])
    assert (one.value, one.count, none.count) == (4.0, 1, 0)
    assert all(map(math.isnan, (one.deviation, one.error, none.value, none.deviation, none.error)))


def test_row_differences_are_paired() -> None:
    """Rooms differ by 0.5 and rows by 0.1, so only paired differences are significant."""
    base, other = row("a", seed0=0.1, seed1=0.6, seed2=0.9), row("b", seed0=0.2, seed1=0.7, seed3=0.0)
    difference = Mean.of(other.differences(base, AP).values())
    assert difference.count == 2
    assert difference.value == pytest.approx(0.1)
    assert difference.error == pytest.approx(0, abs=1e-12)
    assert other.mean(AP).value == pytest.approx(0.3)


def test_row_values_skip_undefined_metrics() -> None:
    expected = row("a", seed0=0.4, seed1=None, seed2="many", seed3=True, seed4=math.nan, seed5=1, seed6=10**400)
    assert expected.values(AP) == {("0",): 0.4, ("5",): 1.0}
    assert expected.mean("no.such.key").count == 0
    assert expected.differences(row("b", seed0=None), AP) == {}


def test_rows_keep_experiment_order_and_sort_seeds() -> None:
    records = [record({"row": name, "seed": seed}) for name in ("b", "a") for seed in (10, 9, 1)]
    runs = [("1",), ("9",), ("10",)]
    assert names(records, "b", "none", "a") == {"b": runs, "a": runs}
    assert list(names(records, "b", "none", "a")) == ["b", "a"]


def test_rows_ignore_parameters_equal_to_seed() -> None:
    records = [
        record({"seed": seed, "dataset": {"seed": seed}, "detector": {"seed": seed, "shift": 1.5}}) for seed in range(3)
    ]
    assert names(records) == {"all runs": [("0",), ("1",), ("2",)]}


def test_rows_split_by_parameter_independent_of_seed() -> None:
    records = [record({"seed": seed, "dataset": {"start": start}}) for seed in (0, 1) for start in (0, 1)]
    runs = [("0",), ("1",)]
    assert names(records) == {"dataset.start=0": runs, "dataset.start=1": runs}


def test_rows_without_experiment_are_named_by_choices() -> None:
    """Parameters that only one of two refiners has do not split rows."""
    parameters: dict[str, dict[str, Any]] = {"kmeans": {"centers": 5}, "gmm": {"steps": 8, "floor": 0.1}}
    records = [
        record({"seed": seed, "refiner": node}, refiner=name, fuser="bayes")
        for name, node in parameters.items()
        for seed in (0, 1)
    ]
    records.append(record({"seed": 0, "refiner": {"steps": 9, "floor": 0.1}}, refiner="gmm", fuser="bayes"))
    assert names(records) == {
        "refiner=gmm, refiner.steps=8": [("0",), ("1",)],
        "refiner=gmm, refiner.steps=9": [("0",)],
        "refiner=kmeans": [("0",), ("1",)],
    }


def test_rows_split_by_command_line_overrides() -> None:
    records = [record({"row": name, "seed": 0, "fuser": {"voxel": voxel}}) for name in "ba" for voxel in (0.02, 0.05)]
    split = [f"{name}, fuser.voxel={voxel}" for name in "ba" for voxel in (0.02, 0.05)]
    assert list(names(records, "b", "a")) == split


def test_row_names_include_undeclared_choice_differences() -> None:
    """The rows differ in the tracker, which no row overrides, so their names include it."""
    records = [
        record({"row": "a", "seed": 0}, tracker="icp", fuser="bayes"),
        record({"row": "b", "seed": 0}, tracker="given", fuser="count"),
    ]
    changes = {"a": [], "b": ["+fuser=count", "fuser@fuser.inner=x", "fuser.voxel=1"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a, tracker=icp", "b, tracker=given"]
    changes["b"].append("tracker=given")
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a", "b"]


def test_row_names_include_undeclared_parameter_differences() -> None:
    """The rows differ in a parameter that no row overrides, so their names include it."""
    frames = {"a": 8, "b": 16}
    records = [
        record({"row": row, "seed": 0, "dataset": {"frames": count}, "fuser": {"voxel": count, "inner": {"x": count}}})
        for row, count in frames.items()
    ]
    changes = {"a": [], "b": ["fuser.voxel=16", "part@fuser.inner=y"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a, dataset.frames=8", "b, dataset.frames=16"]
    changes["b"].append("dataset=other")
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a", "b"]
    assert [row.name for row in rows_of(records, ["seed"])] == ["a", "b"], (
        "expected the names of the rows, whose overrides are unknown"
    )


def test_rows_without_experiment_are_split_by_scene() -> None:
    records = [
        record({"seed": 0, "dataset": {"scene": scene}}, refiner=name)
        for name, scene in (("chain", "011"), ("identity", "016"))
    ]
    assert list(names(records)) == ["refiner=chain, dataset.scene=011", "refiner=identity, dataset.scene=016"]


def test_rows_accept_numeric_names() -> None:
    records = [record({"row": row, "seed": 0}) for row in (0, 20)]
    assert list(names(records, "0", "20")) == ["0", "20"]


def test_following_lists_parameters_that_vary_with_seed() -> None:
    records = [
        record({"seed": seed, "dataset": {"seed": seed, "stride": seed, "start": 1}, "fuser": {"voxel": 1}})
        for seed in (1, 2)
    ]
    assert following(records, ["seed"]) == ["dataset.stride"]
    assert following(records[:1], ["seed"]) == []


def test_row_names_include_dataset_root_differences() -> None:
    records = [record({"row": row, "seed": 0, "dataset": {"root": f"/{row}", "stride": 1}}) for row in "ab"]
    changes = {"a": [], "b": ["dataset.stride=2"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a, dataset.root=/a", "b, dataset.root=/b"]


def test_row_poses_describe_pose_source() -> None:
    given = record({}, tracker="ground_truth")
    given = Record(given.directory, {**given.metrics, "pose_source": "ground_truth"}, {}, 0.0)
    assert RunRow("a", {("0",): given}).poses == "ground truth"
    tracked = {(str(seed),): record({}, tracker=name) for seed, name in enumerate(("pnp", "icp", "icp"))}
    assert RunRow("b", tracked).poses == "tracked (icp/pnp)"


def test_rows_average_over_any_parameter() -> None:
    records = [record({"seed": seed, "dataset": {"scene": scene}}) for seed in (0, 1) for scene in "xy"]
    assert names(records, over=("dataset.scene",)) == {"seed=0": [("x",), ("y",)], "seed=1": [("x",), ("y",)]}
    assert len(names(records, over=("dataset.scene", "seed"))["all runs"]) == 4


@pytest.mark.parametrize("backwards", [False, True])
def test_rows_use_latest_outputs_of_run(backwards: bool) -> None:
    records = [record({"seed": 0}, ap, written) for ap, written in ((0.1, 1.0), (0.9, 2.0))]
    [one] = rows_of(records[::-1] if backwards else records, ["seed"])
    assert one.mean(AP).value == 0.9


def test_rows_ignore_table_and_debug_settings() -> None:
    records = [record({"seed": seed, "debug": bool(seed), "table": {"base": str(seed)}}) for seed in (0, 1)]
    assert list(names(records)) == ["all runs"]


def test_rows_of_presets_have_distinct_names() -> None:
    records = [
        record({"row": "default", "seed": 0, "tracker": {"scale": 0.5}}, tracker="icp", refiner="chain", fuser="tsdf"),
        record({"row": "paper", "seed": 0, "tracker": {"scale": 1}}, tracker="paper", refiner="tree", fuser="tsdf"),
    ]
    changes = {"default": ["preset=default"], "paper": ["preset=paper"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["default", "paper"]
