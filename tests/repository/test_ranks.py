"""Tests for docs/results/ranks.py, compared with manual results and SciPy."""

from __future__ import annotations

import csv
import importlib.util
import math
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import spearmanr

from framework.errors import DataError
from framework.tables.comparison import ComparisonTable
from tests.support.doc_pages import CHECKOUT, LINES
from tests.support.stored_experiments import AP50, IOU, experiment, run

pytestmark = pytest.mark.integration

SCRIPT = CHECKOUT / "docs" / "results" / "ranks.py"
COMMAND = "python docs/results/ranks.py "

script = sys.modules["ranks_script"] = importlib.util.module_from_spec(
    importlib.util.spec_from_file_location("ranks_script", SCRIPT)
)
script.__spec__.loader.exec_module(script)
Ranking, ranks, spearman, write_ranks = script.Ranking, script.ranks, script.spearman, script.write_ranks


@pytest.fixture
def places(tmp_path: Path) -> list[Path]:
    """Write the runs of four rows in three folders.

    The order of the rows is a, b, c, d in the rooms. In the flat, it is b, a, and then c and d with equal ranks. In the
    hall, it is d, c, b, a.
    """
    return [
        experiment(tmp_path / "rooms", {"a": (0.9, 0.7), "b": (0.7, 0.7), "c": (0.5, 0.3), "d": (0.1, 0.1)}),
        experiment(tmp_path / "flat", {"d": (0.2,), "c": (0.2,), "b": (0.6,), "a": (0.5,)}),
        experiment(tmp_path / "hall", {"a": (0.1, 0.1), "b": (0.3, 0.3), "c": (0.4, 0.4), "d": (0.9, 0.7)}),
    ]


def lines_of(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def test_ranks_and_means_match_hand_computed_values(places: list[Path]) -> None:
    lines = lines_of(write_ranks(places, [AP50], None))
    assert "| row | rooms | rank | flat | rank | hall | rank | mean of the others | rank |" in lines
    first = lines.index("| a | 0.800 | 1 | 0.500 | 2 | 0.100 | 4 | 0.300 | 3.5 |")
    assert lines[first + 1 : first + 4] == [
        "| b | 0.700 | 2 | 0.600 | 1 | 0.300 | 3 | 0.450 | 2 |",
        "| c | 0.400 | 3 | 0.200 | 3.5 | 0.400 | 2 | 0.300 | 3.5 |",
        "| d | 0.100 | 4 | 0.200 | 3.5 | 0.800 | 1 | 0.500 | 1 |",
    ]
    assert "- Runs of each row: rooms 2, flat 1, hall 2." in lines


def test_ranks_rho_matches_hand_computed_values(places: list[Path]) -> None:
    """The ranks 1 2 3 4 and 2 1 3.5 3.5 have the correlation 3.5 / sqrt(5 * 4.5).

    After subtraction of the means, they are -1.5 -0.5 0.5 1.5 and -0.5 -1.5 1 1.
    """
    lines = lines_of(write_ranks(places, [AP50], None))
    rhos = {line.split(" | ")[0]: line.split(" | ")[1:3] for line in lines if ", " in line and line.startswith("|")}
    expected = {"rooms, flat": 3.5 / math.sqrt(22.5), "rooms, hall": -1.0, "flat, hall": -3.5 / math.sqrt(22.5)}
    # the ranks 1 2 3 4 and 3.5 2 3.5 1 are -1.5 -0.5 0.5 1.5 and 1 -0.5 1 -1.5 without their means
    expected["rooms, mean of the others"] = -3 / math.sqrt(5 * 4.5)
    assert rhos == {f"| {pair}": ["4", f"{rho:+.2f}"] for pair, rho in expected.items()}


def test_ranks_of_two_datasets_have_no_mean_of_others(places: list[Path]) -> None:
    text = write_ranks(places[:2], [AP50], None)
    assert "the others" not in text
    assert text.count("| rooms, flat ") == 1


def test_ranks_rho_with_ties_agrees_with_scipy() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = rng.integers(0, 4, (200, 7)).astype(float), rng.integers(0, 4, (200, 7)) / 3
    expected = [
        spearmanr(a, b).statistic if np.ptp(a) and np.ptp(b) else math.nan for a, b in zip(ours, theirs, strict=True)
    ]
    np.testing.assert_allclose(spearman(ours, theirs), expected, atol=1e-12)
    assert np.isnan(spearman(np.ones((1, 5)), np.arange(5.0)[None])).all()


def test_ranks_means_equal_up_to_rounding_share_rank() -> None:
    assert ranks(np.array([0.1 + 0.2, 0.0, 0.3])).tolist() == [1.5, 3, 1.5]
    assert spearman(np.array([[0.1 + 0.2, 0.0, 0.3]]), np.array([[0.3, 0.0, 0.1 + 0.2]])) == pytest.approx([1])


def agreement(places: Sequence[Path]) -> object:
    [(_, found), *_] = Ranking.of(AP50, [ComparisonTable.below(place) for place in places]).agreements()
    return found


def test_ranks_row_interval_is_bootstrap_over_rows(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    ours = rng.random(12)
    theirs = ours + rng.normal(0, 0.2, 12)
    one = experiment(tmp_path / "one", {f"r{k}": (float(v),) for k, v in enumerate(ours)})
    other = experiment(tmp_path / "other", {f"r{k}": (float(v),) for k, v in enumerate(theirs)})
    found = agreement([one, other])
    assert found.rho == pytest.approx(spearmanr(ours, theirs).statistic)
    drawn = [rng.integers(12, size=12) for _ in range(4000)]
    low, high = np.quantile([spearmanr(ours[k], theirs[k]).statistic for k in drawn], [0.025, 0.975])
    assert found.over_rows == pytest.approx((low, high), abs=0.05)
    assert found.over_rows[0] < found.rho < found.over_rows[1]
    assert np.isnan(found.over_runs).all(), "expected no interval for one run"


def test_ranks_run_interval_reflects_seed_noise(tmp_path: Path) -> None:
    """If the order of the rows is the same for all seeds, the interval is a point."""
    steady = {"a": (0.9, 0.8, 0.9), "b": (0.5, 0.4, 0.5), "c": (0.1, 0.2, 0.1)}
    one, same = experiment(tmp_path / "one", steady), experiment(tmp_path / "same", steady)
    assert agreement([one, same]).over_runs == (1, 1)
    noisy = experiment(tmp_path / "noisy", {"a": (0.9, 0.4, 0.9), "b": (0.5, 0.8, 0.5), "c": (0.1, 0.2, 0.1)})
    # the means of a and b are 0.73 and 0.6; b is first if the second seed dominates; then rho is 0.5
    found = agreement([one, noisy])
    assert (found.rho, *found.over_runs) == pytest.approx((1, 0.5, 1))
    # b is first only if the last seed is drawn four times, i.e. in 1 of 256 samples
    rare = experiment(tmp_path / "rare", {"a": (0.9, 0.9, 0.9, 0.8), "b": (0.5, 0.5, 0.5, 0.9), "c": (0.1,) * 4})
    assert agreement([one, rare]).over_runs == (1, 1)


def test_ranks_intervals_are_repeatable(places: list[Path]) -> None:
    alone, with_another = agreement(places[::2]), agreement([places[0], places[2], places[1]])
    assert alone == with_another
    assert write_ranks(places, [AP50], None) == write_ranks(places, [AP50], None)


def test_ranks_scenes_have_equal_weight_in_mean(tmp_path: Path) -> None:
    """One of the two scenes has two runs. The mean over 0.9 and 0.3 is 0.6."""
    figures = {"a": (0.9, 0.3), "b": (0.5, 0.5), "c": (0.1, 0.1)}
    one = experiment(tmp_path / "one", figures, scenes=("x", "y"))
    other = experiment(tmp_path / "other", figures, scenes=("x", "y"))
    for row, values in figures.items():
        run(one, row, 1, values[0], scene="x")
    lines = lines_of(write_ranks([one, other], [AP50], None))
    assert "| a | 0.600 | 1 | 0.600 | 1 |" in lines
    assert "- Runs of each row: one 3, other 2." in lines


def test_ranks_compare_only_runs_common_to_all_rows(tmp_path: Path) -> None:
    """One row has no run for the most difficult seed, which must not improve its rank."""
    one = experiment(tmp_path / "one", {"a": (0.9, 0.3), "b": (0.8, 0.2), "c": (0.7, None), "d": (0.6, 0.1)})
    other = experiment(tmp_path / "other", {"a": (0.9,), "b": (0.8,), "c": (0.7,), "d": (0.6,)})
    lines = lines_of(write_ranks([one, other], [AP50], None))
    assert "| c | 0.700 | 3 | 0.700 | 3 |" in lines
    assert "| a | 0.900 | 1 | 0.900 | 1 |" in lines
    assert "- Omitted runs, without this metric in some rows: one 1." in lines


def test_ranks_show_folders_of_same_name_with_path(tmp_path: Path) -> None:
    roots = [experiment(tmp_path / k / "ranks", {"a": (0.9,), "b": (0.8,), "c": (0.7,)}) for k in "xy"]
    assert f"| row | {roots[0]} | rank | {roots[1]} | rank |" in lines_of(write_ranks(roots, [AP50], None))


def test_ranks_list_rows_missing_in_one_dataset(places: list[Path]) -> None:
    run(places[1], "e", 0, 0.7)
    text = write_ranks(places, [AP50], None)
    assert "- Omitted rows, missing in some folders: e: not in rooms, hall." in text
    assert "| e " not in text


def test_ranks_of_several_metrics_are_written_to_files(places: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "new" / "folder"
    text = write_ranks(places, [AP50, IOU], out)
    assert (out / "ranks.md").read_text() == text
    assert text.count("\n## ") == 2
    assert "| rooms, flat | 4 | – | – | – |" in lines_of(text), "expected no ranking of equal rows"
    with (out / "ranks.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 2 * 4 * 4
    [line] = [x for x in lines if (x["figure"], x["row"], x["place"]) == (AP50, "c", "flat")]
    assert (float(line["mean"]), line["rank"]) == (0.2, "3.5")
    [line] = [x for x in lines if (x["figure"], x["row"], x["place"]) == (AP50, "b", "mean of the others")]
    assert (float(line["mean"]), line["rank"]) == (pytest.approx(0.45), "2")


def test_ranks_provenance_of_runs_is_printed(places: list[Path]) -> None:
    [line] = [line for line in lines_of(write_ranks(places, [AP50], None)) if line.startswith("- flat: ")]
    assert "dataset=d, detector=seen, poses ground truth; annotation: unknown; code 1234567; SHA-256" in line


@pytest.mark.parametrize(
    ("asked", "keys", "message"),
    [
        (["rooms"], [AP50], "DIR: expected at least two folders, got 1"),
        (["rooms", "rooms/../rooms"], [AP50], "DIR: expected each folder once, got "),
        (["rooms", "nowhere"], [AP50], "nowhere: expected a folder of runs, got no folder"),
        (["rooms", "empty"], [AP50], "expected a completed run, got none"),
        (
            ["rooms", "flat"],
            ["instances.ap51"],
            r"rooms: expected a run with the metric instances.ap51, got none; did you mean instances.ap50\?",
        ),
        (["rooms", "flat"], ["zzz"], "rooms: expected a run with the metric zzz, got none$"),
        (
            ["rooms", "small"],
            [AP50],
            r"at least 3 common rows of all folders, got 2 \(a, b\); c: not in small; d: not in",
        ),
        (["rooms", "apart"], [AP50], "apart: expected a run with instances.ap50 in all rows, got none"),
    ],
)
def test_ranks_incomparable_folders_raise_one_line_error(
    places: list[Path], asked: list[str], keys: list[str], message: str
) -> None:
    root = places[0].parent
    (root / "empty").mkdir()
    experiment(root / "small", {"a": (0.1,), "b": (0.2,)})
    experiment(root / "apart", {"a": (0.1, None), "b": (None, 0.2), "c": (0.1, 0.2)})
    with pytest.raises(DataError, match=message) as caught:
        write_ranks([root / name for name in asked], keys, None)
    assert "\n" not in str(caught.value)


def start(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(CHECKOUT), "HOME": str(directory)}
    line = [sys.executable, str(SCRIPT), *arguments]
    return subprocess.run(line, cwd=directory, env=environment, capture_output=True, text=True, timeout=120)


def test_ranks_documented_command_prints_and_writes_tables(tmp_path: Path) -> None:
    [command] = [line.removeprefix(COMMAND) for line in LINES if line.startswith(COMMAND)]
    folders = [word for word in shlex.split(command) if word.startswith("outputs/ranks_")]
    assert len(folders) == 3
    for folder in folders:
        experiment(tmp_path / folder, {"a": (0.9,), "b": (0.8,), "c": (0.7,), "d": (0.6,)})
    done = start(tmp_path, *shlex.split(command))
    assert done.returncode == 0, done.stderr
    [out] = tmp_path.rglob("ranks.md")
    assert out.read_text() == done.stdout
    assert out.with_name("ranks.csv").exists()
    assert "+1.00" in done.stdout


def test_ranks_script_error_is_one_line(tmp_path: Path) -> None:
    experiment(tmp_path / "rooms", {"a": (0.9,), "b": (0.8,), "c": (0.7,)})
    done = start(tmp_path, "rooms", "flat")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: flat: expected a folder of runs, got no folder\n"
