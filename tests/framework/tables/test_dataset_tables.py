"""Tests for tables of sweeps over datasets and detectors, without an experiment."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf
from scipy.stats import ttest_1samp

from framework.errors import ConfigError, DataError
from framework.runs.data_frame import load_runs
from framework.runs.provenance import config_hash
from framework.tables.comparison import ComparisonTable
from framework.tables.experiment_tables import write_tables
from framework.tables.statistics import PairedValues
from tests.support.table_text import grids

pytestmark = pytest.mark.integration

AP50, TIME = "instances.ap50", "stage_ms.fusion.median"
TASK = ["dataset=desk,rooms,scan", "refiner=chain,identity", "seed=0,1"]


def run(
    root: Path,
    dataset: str,
    refiner: str,
    seed: int,
    ap: float | None,
    detector: str = "net",
    row: str | None = None,
    **more: Any,
) -> None:
    """Write a run directory. The ground truth depends on the dataset and the seed."""
    directory = root / f"dataset={dataset},detector={detector},refiner={refiner},seed={seed}"
    directory.mkdir(parents=True)
    data = {"root": f"/{dataset}", "scene": f"{dataset} 1", "seed": seed}
    config: dict[str, Any] = {
        "seed": seed,
        "dataset": data,
        "refiner": {"kind": refiner},
        "detector": {"kind": detector},
    }
    config |= {"row": row} if row else {}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    chosen = {"dataset": dataset, "detector": detector, "refiner": refiner}
    metrics = {
        **{f"choice.{group}": option for group, option in chosen.items()},
        **{"sequence": f"{dataset} 1", "pose_source": "ground_truth", AP50: ap, "truth_sha256": f"{dataset}{seed}"},
        **{"config_hash": config_hash(config), "git_commit": "1234567890", "git_dirty": False, TIME: 10.0},
        **{"environment.cpus": 2, "environment.processor": "Z80", **more},
    }
    (directory / "metrics.json").write_text(json.dumps(metrics))


def table(root: Path, task: Sequence[str] = TASK, **choice: Any) -> None:
    """Write the config of a sweep with a table."""
    sweep = {"hydra": {"overrides": {"task": list(task)}}} | ({"table": choice} if choice else {})
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(sweep)))


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Return the folder of runs of two refiners on three datasets with two seeds. `scan` has no ground truth."""
    root = tmp_path / "sweep"
    for seed in (0, 1):
        run(root, "desk", "chain", seed, 0.5 + 0.1 * seed, **{TIME: 9.0})
        run(root, "desk", "identity", seed, 0.4, **{TIME: 12.0})
        run(root, "rooms", "chain", seed, 0.8)
        run(root, "rooms", "identity", seed, 0.6)
        for refiner in ("chain", "identity"):
            run(root, "scan", refiner, seed, None)
    table(root)
    return root


def test_sweep_differences_are_within_dataset(sweep: Path) -> None:
    text = write_tables(sweep)
    _, second = grids(text)
    assert second == [
        "| minus refiner=chain | pairs | AP50 | fusion (ms) |",
        "| ------------------------------- | ----: | -------------: | ----------: |",
        "| dataset=desk, refiner=identity | 2 | -0.150 ± 0.050 | +3.00 |",
        "| dataset=rooms, refiner=identity | 2 | -0.200 | +0.00 |",
        "| dataset=scan, refiner=identity | 2 | – | +0.00 |",
    ]
    assert "Rows without a matching base row" not in text


def test_sweep_of_single_rows_per_dataset_has_no_differences(sweep: Path) -> None:
    table(sweep, where={"refiner": "chain"})
    text = write_tables(sweep)
    assert len(grids(text)) == 1
    assert "- No differences: no two rows have the same data." in text
    assert "- Only runs with refiner=chain." in text
    assert load_runs(sweep).shape[0] == 12
    assert (sweep / "table.csv").read_text().count("\n") == 1 + 6


@pytest.mark.parametrize("base", ["refiner=identity", "dataset=desk, refiner=identity"])
def test_sweep_base_is_row_with_same_other_values(sweep: Path, base: str) -> None:
    table(sweep, base=base)
    _, second = grids(write_tables(sweep))
    assert second[0].startswith(f"| minus {base} |")
    compared = [line.split(" | ")[0] for line in second[2:]]
    datasets = ("desk", "rooms", "scan") if base == "refiner=identity" else ("desk",)
    assert compared == [f"| dataset={dataset}, refiner=chain" for dataset in datasets]
    assert second[2].split(" | ")[1:3] == ["2", "+0.150 ± 0.050"]


def test_sweep_base_keeps_other_options(sweep: Path) -> None:
    for refiner, ap in (("chain", 0.9), ("identity", 0.3)):
        run(sweep, "desk", refiner, 0, ap, detector="other")
    table(sweep, base="refiner=chain", where={"dataset": "desk"})
    _, second = grids(write_tables(sweep))
    assert [line.split(" | ")[:3] for line in second[2:]] == [
        ["| detector=net, refiner=identity", "2", "-0.150 ± 0.050"],
        ["| detector=other, refiner=identity", "1", "-0.600"],
    ]


def test_table_averages_over_datasets(sweep: Path) -> None:
    table(sweep, average_over=["seed", "dataset"], where={"dataset": ["desk", "rooms"]}, columns=[AP50])
    text = write_tables(sweep)
    first, second = grids(text)
    assert first[2] == "| refiner=chain | 4 | 0.675 ± 0.150 | ground_truth |"  # 0.5, 0.6, 0.8, 0.8
    assert second[2] == "| refiner=identity | 2 | -0.175 ± 0.025 |"  # the differences are -0.15 (desk) and -0.2 (rooms)
    assert "- Only runs with dataset=desk,rooms." in text
    assert "- Differences are paired by seed, dataset: mean ± standard error over dataset, after averaging" in text
    assert "Missing" not in text


def test_table_pairs_by_key_without_common_seeds(sweep: Path) -> None:
    """Rows with different seeds are compared by dataset. The values are means over the seeds of each row."""
    for dataset, ap in (("desk", 0.2), ("rooms", 0.4)):
        for seed in (5, 6):
            run(sweep, dataset, "other", seed, ap + 0.1 * (seed - 5), **{"truth_sha256": "x"})
    over = {"average_over": ["seed", "dataset"], "columns": [AP50], "base": "refiner=chain"}
    over |= {"where": {"dataset": ["desk", "rooms"]}}
    table(sweep, **over)
    comparison = ComparisonTable.below(sweep)
    chain, identity, other = comparison.rows
    assert comparison.pairs(other, chain, AP50) == {}
    assert comparison.pairs(identity, chain, AP50) == {
        ("desk",): PairedValues(0.4, 0.55),
        ("rooms",): PairedValues(0.6, 0.8),
    }
    table(sweep, **over, pair_by=["dataset"])
    comparison = ComparisonTable.below(sweep)
    chain, identity, other = comparison.rows
    pairs = comparison.pairs(other, chain, AP50)
    assert {unit: tuple(pair) for unit, pair in pairs.items()} == {
        ("desk",): pytest.approx((0.25, 0.55)),
        ("rooms",): pytest.approx((0.45, 0.8)),
    }
    _, second = grids(write_tables(sweep))
    assert second[2:] == ["| refiner=identity | 2 | -0.175 ± 0.025 |", "| refiner=other | 2 | -0.325 ± 0.025 |"]


def test_table_statistics_have_units_of_pairs(sweep: Path) -> None:
    """If pairs are formed by dataset, the columns, differences and tests are also by dataset."""
    run(sweep, "hall", "chain", 0, 0.7)
    for dataset, ap in (("desk", 0.2), ("rooms", 0.4), ("hall", 0.3)):
        for seed in (5, 6):
            run(sweep, dataset, "other", seed, ap + 0.1 * (seed - 5))
    choice = {"columns_by": "dataset", "columns": [AP50], "base": "refiner=chain"}
    choice |= {"where": {"dataset": ["desk", "rooms", "hall"]}}
    table(sweep, **choice)
    assert len(grids(write_tables(sweep))) == 2
    table(sweep, **choice, pair_by=["dataset"])
    text = write_tables(sweep)
    _, second, third = grids(text)
    # chain: 0.55, 0.7, 0.8; other: 0.25, 0.35, 0.45
    assert second[0] == "| refiner=chain minus | poses | annotation | desk | hall | rooms | mean | pairs |"
    assert second[3] == "| refiner=other | ground truth | – | +0.300 | +0.350 | +0.350 | +0.333 ± 0.017 * | 3 |"
    p = ttest_1samp([0.3, 0.35, 0.35], 0).pvalue
    assert third[2].startswith(f"| AP50 | refiner=other | 3 | +0.333 | – | {p:.3f} | {p:.3f} | 0.250 |")
    assert "refiner=chain compared with refiner=other, ground truth: higher in 3 of 3 sequences, lower in 0." in text


def test_table_pairs_by_seed_have_same_datasets(sweep: Path) -> None:
    for seed in (0, 1):
        run(sweep, "rooms", "other", seed, 0.1)
    over = {"average_over": ["seed", "dataset"], "pair_by": ["seed"], "columns": [AP50]}
    table(sweep, **over, where={"dataset": ["desk", "rooms"]})
    text = write_tables(sweep)
    _, second = grids(text)
    assert [line.split(" | ")[:2] for line in second[2:]] == [["| refiner=identity", "2"]]
    assert "- Rows without a matching base row (refiner=chain): refiner=other." in text


def test_table_groups_have_digits_and_best_value_of_each_column(sweep: Path) -> None:
    """The number of decimals is chosen for each column. For times, the lowest value is best."""
    for path in sweep.glob("*/metrics.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"map.bytes": 5e6}))
    table(sweep, group_by="dataset", columns=[AP50, TIME, "map.bytes"])
    text = write_tables(sweep)
    first, *_ = grids(text)
    assert first[0] == "| dataset | system | poses | annotation | AP50 | fusion (ms) | map (bytes) |"
    assert [line.split(" | ")[4:] for line in first[2:]] == [
        ["**0.550 ± 0.071**", "**9.00**", "5000000 |"],
        ["0.400", "12.00", "5000000 |"],
        ["**0.800**", "10.00", "5000000 |"],
        ["0.600", "10.00", "5000000 |"],
        ["–", "10.00", "5000000 |"],
        ["–", "10.00", "5000000 |"],
        ["**0.675 ± 0.035**", "**9.67**", "5000000 |"],
        ["0.500", "10.67", "5000000 |"],
    ]
    assert "Bold: highest AP50; lowest fusion (ms), map (bytes) for the same poses and number of runs" in text


def test_table_columns_are_detectors(sweep: Path) -> None:
    for refiner, ap in (("chain", 0.9), ("identity", 0.3)):
        run(sweep, "desk", refiner, 0, ap, detector="other")
    table(sweep, columns_by="detector", where={"dataset": "desk"})
    first, _ = grids(write_tables(sweep))
    assert first[0] == "| system | poses | annotation | net | other | mean |"
    assert first[2].startswith("| refiner=chain | ground truth | – | **0.550 ± 0.071** | **0.900** | **0.725")


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """Return the folder of an experiment with two rows on two datasets with two detectors each."""
    for dataset, ap in (("desk", 0.5), ("rooms", 0.7)):
        for detector, more in (("net", 0.0), ("other", 0.1)):
            run(tmp_path, dataset, "chain", 0, ap + more, detector, row="base")
            run(tmp_path, dataset, "mine", 0, ap + 2 * more, detector, row="mine")
    task = ["experiment=x", "dataset=desk,rooms", "detector=net,other"]
    sweep = {"hydra": {"overrides": {"task": task}}, "rows": {"base": ["refiner=chain"], "mine": ["refiner=mine"]}}
    (tmp_path / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(sweep)))
    return tmp_path


def set_table(root: Path, **choice: Any) -> None:
    sweep = OmegaConf.load(root / "multirun.yaml")
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml({**sweep, "table": {"columns": [AP50], **choice}}))


def test_experiment_columns_are_datasets_and_rows_have_detectors(experiment: Path) -> None:
    set_table(experiment, columns_by="dataset")
    first, second = grids(write_tables(experiment))
    assert [line.split(" | ")[0] for line in first[2:]] == [
        "| base, detector=net",
        "| mine, detector=net",
        "| base, detector=other",
        "| mine, detector=other",
    ]
    assert [line.split(" | ")[0::3] for line in second[2:]] == [
        ["| mine, detector=net", "+0.000", "2 |"],
        ["| mine, detector=other", "-0.100", "2 |"],
    ]


def test_experiment_averages_over_datasets_and_detectors(experiment: Path) -> None:
    set_table(experiment, average_over=["seed", "detector", "dataset"], pair_by=["dataset"])
    text = write_tables(experiment)
    first, second = grids(text)
    assert first[2] == "| base | 4 | 0.650 ± 0.129 | ground_truth |"  # 0.5, 0.6, 0.7, 0.8
    assert second[2] == "| mine | 2 | +0.050 |"
    assert "- Differences are paired by dataset: mean ± standard error over dataset, after averaging the runs" in text


def test_table_of_nested_keys_lists_no_impossible_runs(sweep: Path) -> None:
    """Each scene belongs to one dataset. Other combinations must not be listed as missing."""
    table(sweep, average_over=["seed", "dataset.scene"], group_by="dataset", columns=[AP50])
    text = write_tables(sweep)
    assert "Missing" not in text
    assert " of " not in "".join(grids(text)[0])


def test_table_notes_report_identical_runs_and_rows(sweep: Path) -> None:
    for seed in (0, 1):
        run(sweep, "rooms", "copy", seed, 0.8, **{TIME: 11.0 + seed})
    text = write_tables(sweep)
    assert "Identical runs: the results do not depend on seed in dataset=desk, refiner=identity; dataset=rooms" in text
    assert "refiner=chain; " not in text.partition("Identical runs")[2].partition("dataset=rooms")[0]
    assert (
        "Identical rows: the results of dataset=rooms, refiner=copy equal those of dataset=rooms, refiner=chain."
        in text
    )


def test_table_notes_report_mixed_code_of_same_dataset(sweep: Path) -> None:
    """Different datasets may have different code. Only different code for the same dataset is reported."""
    for path in sweep.glob("*/metrics.json"):
        metrics = json.loads(path.read_text())
        path.write_text(json.dumps(metrics | {"code.dataset": f"reader of {metrics['choice.dataset']} 3f"}))
    table(sweep, average_over=["seed", "dataset"])
    assert "Mixed" not in write_tables(sweep)
    [changed] = sweep.glob("dataset=desk,*refiner=chain,seed=1/metrics.json")
    changed.write_text(changed.read_text().replace("reader of desk 3f", "reader of desk 9c"))
    expected = "Mixed plugin code in refiner=chain: dataset reader of desk 3f (1 run), reader of desk 9c (1 run);"
    assert expected in write_tables(sweep)


def test_table_notes_name_command_line_and_data(sweep: Path) -> None:
    table(sweep, [*TASK, "dataset.stride=3", "skip_completed=true", "+table.columns=[fps]"], columns=[AP50])
    text = write_tables(sweep)
    assert f"- Command line: {' '.join(TASK)} dataset.stride=3.\n" in text
    assert (
        "dataset=desk in /desk (4 runs), rooms in /rooms (4 runs), scan in /scan (4 runs); sequences desk 1, " in text
    )


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"average_over": ["refner"]}, r"table\.average_over: .*, got refner; did you mean refiner\?"),
        ({"where": {"dataset.rot": 1}}, r"table\.where: .*, got dataset\.rot; did you mean dataset\.root\?"),
    ],
)
def test_table_unknown_keys_raise(sweep: Path, choice: dict[str, Any], message: str) -> None:
    table(sweep, **choice)
    with pytest.raises(ConfigError, match=message):
        write_tables(sweep)


def test_table_without_selected_run_raises(sweep: Path) -> None:
    table(sweep, where={"dataset": "moon"})
    with pytest.raises(DataError, match=r"table\.where: expected a completed run with dataset=moon, got none"):
        write_tables(sweep)
