"""Tests for rows, means and paired differences."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from framework.runs.run_rows import Mean, RunRow, dependent_keys, rows_of
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


def test_row_values_skip_undefined_metrics() -> None:
    expected = row("a", seed0=0.4, seed1=None, seed2="many", seed3=True, seed4=math.nan, seed5=1, seed6=10**400)
    assert expected.values(AP) == {("0",): 0.4, ("5",): 1.0}
    assert expected.mean("no.such.key").count == 0


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
    """A parameter that only one of the refiners has does not split the rows."""
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
    """The trackers differ, although no row overrides the tracker."""
    records = [
        record({"row": "a", "seed": 0}, tracker="icp", fuser="bayes"),
        record({"row": "b", "seed": 0}, tracker="given", fuser="count"),
    ]
    changes = {"a": [], "b": ["+fuser=count", "fuser@fuser.inner=x", "fuser.voxel=1"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a, tracker=icp", "b, tracker=given"]
    changes["b"].append("tracker=given")
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a", "b"]


def test_row_names_include_undeclared_parameter_differences() -> None:
    """A parameter differs, although no row overrides the parameter."""
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


def test_dependent_keys_list_parameters_that_vary_with_seed() -> None:
    records = [
        record({"seed": seed, "dataset": {"seed": seed, "stride": seed, "start": 1}, "fuser": {"voxel": 1}})
        for seed in (1, 2)
    ]
    assert dependent_keys(records, ["seed"]) == ["dataset.stride"]
    assert dependent_keys(records[:1], ["seed"]) == []


def test_row_names_include_dataset_root_differences() -> None:
    records = [record({"row": row, "seed": 0, "dataset": {"root": f"/{row}", "stride": 1}}) for row in "ab"]
    changes = {"a": [], "b": ["dataset.stride=2"]}
    assert [row.name for row in rows_of(records, ["seed"], changes)] == ["a, dataset.root=/a", "b, dataset.root=/b"]


def test_row_names_include_folder_of_datasets_that_rows_override() -> None:
    """Rows on different data must not be compared."""
    records = [record({"row": row, "seed": 0, "dataset": {"root": f"/{row}"}}, dataset=row) for row in "ab"]
    changes = {"a": [], "b": ["dataset=b"]}
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


def of_two_datasets() -> list[Record]:
    """Return runs of two rows on two datasets. Each dataset has its own detector and annotation."""
    data = (("desk", {"root": "/d", "scene": "a"}, "net"), ("rooms", {"kind": "STUDIO"}, "simulated"))
    found = [
        record({"seed": 0, "dataset": node, "detector": {"name": net}}, dataset=name, detector=net, refiner=refiner)
        for refiner in ("chain", "identity")
        for name, node, net in data
    ]
    return [replace(one, metrics={**one.metrics, "annotation_release": one.choices["dataset"]}) for one in found]


def test_rows_average_over_datasets() -> None:
    """The parameters and the detector of a run depend on the dataset."""
    records = of_two_datasets()
    asked = {"dataset", "refiner"}
    rows = rows_of(records, ["seed", "dataset"], asked=asked)
    runs = [("0", "desk"), ("0", "rooms")]
    assert {row.name: list(row.records) for row in rows} == {"refiner=chain": runs, "refiner=identity": runs}
    assert dependent_keys(records, ["seed", "dataset"], asked) == ["annotation", "detector"]


@pytest.mark.parametrize("asked", [None, {"dataset", "refiner", "detector"}])
def test_rows_of_unknown_or_swept_detectors_are_split(asked: set[str] | None) -> None:
    rows = rows_of(of_two_datasets(), ["seed", "dataset"], asked=asked)
    assert [list(row.records) for row in rows] == [[("0", "desk")]] * 2 + [[("0", "rooms")]] * 2


def test_rows_average_over_annotations_of_datasets() -> None:
    records = [
        Record(Path(), {"choice.dataset": name, "annotation_release": name}, {"seed": 0}, 0.0) for name in ("a", "b")
    ]
    assert len(rows_of(records, ["dataset"])) == 1
    assert len(rows_of(records, ["seed"])) == 2


def test_rows_split_by_parameter_that_varies_within_dataset() -> None:
    records = [record({"seed": 0, "dataset": {"stride": stride}}, dataset=name) for name in "ab" for stride in (1, 2)]
    found = names(records, over=("dataset",))
    assert found == {"dataset.stride=1": [("a",), ("b",)], "dataset.stride=2": [("a",), ("b",)]}


def test_rows_share_data_of_equal_sequence_and_ground_truth() -> None:
    def of(scene: str, truth: str = "t", stride: int = 1) -> RunRow:
        config = {"dataset": {"scene": scene, "stride": stride}}
        one = record(config, dataset="scenenn")
        return RunRow("", {("0",): Record(one.directory, {**one.metrics, "truth_sha256": truth}, config, 0.0)})

    assert of("011").shares_data(of("011", stride=4))
    assert not of("011").shares_data(of("016"))
    assert not of("011").shares_data(of("011", truth="u"))
    assert not of("011").shares_data(RunRow("", {("1",): record({})}))


def imported(name: str, config: dict[str, Any]) -> Record:
    """Return the record of an imported map, whose stages are "external"."""
    mapped = record({"row": name, **config}, dataset="desk", detector="external", tracker="external", fuser="external")
    return replace(mapped, metrics=mapped.metrics | {"pose_source": "external"})


def test_imported_map_is_named_row_next_to_unnamed_runs() -> None:
    ours = [record({"seed": seed}, dataset="desk", detector="mask_rcnn", tracker="icp") for seed in (0, 1)]
    assert names([*ours, imported("Kimera", {"seed": 0})]) == {"InstanceMap": [("0",), ("1",)], "Kimera": [("0",)]}
    other = record({"seed": 0}, dataset="desk", detector="yolo", tracker="icp")
    assert list(names([*ours, other, imported("Kimera", {"seed": 0})])) == [
        "detector=mask_rcnn",
        "detector=yolo",
        "Kimera",
    ]


def test_imported_map_does_not_split_experiment_rows() -> None:
    choices = {"dataset": "desk", "detector": "mask_rcnn", "tracker": "icp", "fuser": "tsdf"}
    ours = [record({"row": row, "seed": 0, "dataset": {"root": "data"}}, **choices) for row in ("chain", "identity")]
    other = imported("Kimera", {"seed": 0, "dataset": {"root": "data"}})
    assert list(names([*ours, other], "chain", "identity")) == ["chain", "identity", "Kimera"]
