"""Tests for tables over sequences, like Tables 2 and 3 of the paper."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas
import pytest
from omegaconf import OmegaConf

from framework.runs.data_frame import load_runs
from framework.runs.provenance import config_hash
from framework.tables.experiment_tables import write_tables
from tests.support.table_text import grids

AP50 = "instances.ap50"
ROWS = {"ours": [], "prior": ["refiner=geometric"], "other": ["refiner=identity"]}
NAMES = {"prior": "Prior (re-implementation)"}
ACROSS = {"average_over": ["seed"], "columns_by": "dataset.scene", "columns": [AP50], "names": NAMES}
BY = {
    "average_over": ["seed"],
    "group_by": "dataset.scene",
    "names": NAMES,
    "columns": [f"{AP50}.couch", f"{AP50}.tv", AP50],
}
FIGURES = {  # AP50 of seeds 0 and 1, keyed by row and scene
    ("ours", "011"): (0.6, 0.8),
    ("ours", "016"): (0.5, 0.3),
    ("prior", "011"): (0.5, 0.7),
    ("prior", "016"): (0.6, 0.4),
    ("other", "011"): (0.2, 0.2),
    ("other", "016"): (0.1, None),  # this run failed
}


def experiment(root: Path, table: dict[str, Any]) -> None:
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": table, "rows": ROWS})))


def run(root: Path, row: str, scene: str, seed: int, tracker: str = "ground_truth", **expected: Any) -> Path:
    """Write a run directory. Keyword arguments are metrics, or `data` and `release`."""
    directory = root / f"dataset.scene={scene},row={row},seed={seed},tracker={tracker}{len(expected.get('data', ''))}"
    directory.mkdir()
    config = {
        **{"row": row, "seed": seed, "refiner": {"kind": row}, "tracker": {"kind": tracker}},
        "dataset": {"root": f"/data{expected.pop('data', '')}", "scene": scene, "seed": seed},
    }
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    metrics = {
        **{"pose_source": "ground_truth" if tracker == "ground_truth" else "tracked", "choice.tracker": tracker},
        **{"choice.refiner": row, "choice.dataset": "scenenn"},
        "annotation_release": expected.pop("release", "made up"),
        **{"config_hash": config_hash(config), "git_commit": "1234567890", "git_dirty": False},
        **{"environment.cpus": 2, "environment.processor": "Z80", **expected},
    }
    (directory / "metrics.json").write_text(json.dumps(metrics))
    return directory


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """Write the runs of three rows, two scenes and two seeds, and return their folder. One run failed."""
    root = tmp_path / "table3"
    root.mkdir()
    experiment(root, ACROSS)
    for (row, scene), values in FIGURES.items():
        for seed, value in enumerate(values):
            directory = run(root, row, scene, seed, **{AP50: value, f"{AP50}.couch": value})
            if value is None:
                (directory / "metrics.json").unlink()
                (directory / "instancemap.log").write_text("12:00:00 ERROR   the map is full.\n")
    return root


GOLDEN = """\
# table3

| system                    | poses        | annotation |               011 |               016 |                mean |
| ------------------------- | ------------ | ---------- | ----------------: | ----------------: | ------------------: |
| ours                      | ground truth | made up    | **0.700 ± 0.141** |     0.400 ± 0.141 |       0.550 ± 0.000 |
| Prior (re-implementation) | ground truth | made up    |     0.600 ± 0.141 | **0.500 ± 0.141** |       0.550 ± 0.000 |
| other                     | ground truth | made up    |             0.200 |    0.100 (1 of 2) | 0.150 (3 of 4 runs) |

| ours minus                | poses        | annotation |    011 |    016 |           mean | pairs |
| ------------------------- | ------------ | ---------- | -----: | -----: | -------------: | ----: |
| Prior (re-implementation) | ground truth | made up    | +0.100 | -0.100 | +0.000 ± 0.100 |     2 |
| other                     | ground truth | made up    | +0.500 | +0.400 | +0.450 ± 0.050 |     2 |

- Cells: mean ± sample standard deviation over seed, without ± for equal values. mean: average over \
dataset.scene with equal weights; its standard deviation is over the runs with all values of dataset.scene. Bold: \
highest AP50 for the same poses and number of runs, unless several rows have it. missing: no complete run.
- Differences are paired by seed, dataset.scene: mean ± standard error over dataset.scene, after averaging the runs of \
each. pairs: number of values of dataset.scene in both rows. *: p < 0.05 in a paired t-test with Holm's correction.
- No statistics: they require at least 3 values of dataset.scene in a row and its base, and differences that are not \
all equal.
- Identical runs: the results do not depend on seed in other.
- ours compared with Prior (re-implementation), ground truth: higher in 1 of 2 sequences, lower in 1: 016.
- ours compared with other, ground truth: higher in 2 of 2 sequences, lower in 0.
- Overrides of each row: ours: none; prior: refiner=geometric; other: refiner=identity.
- Common to all runs: dataset=scenenn, tracker=ground_truth.
- Label transfer: each ground-truth vertex gets the instance of the nearest map vertex within 5 cm. AP is in [0, 1].
- Data: dataset=scenenn in /data, annotation made up.
- Code: 1234567.
- Machine: 2 cores of Z80.
- Config: config.yaml of each run; SHA-256 of all config hashes: DIGEST.
- Missing in other: seed=1 dataset.scene=016.
- Incomplete: dataset.scene=016,row=other,seed=1,tracker=ground_truth0: failed: the map is full.
"""


def test_sequence_columns_table_matches_expected_text(sweep: Path) -> None:
    text = write_tables(sweep)
    [line] = [line for line in text.splitlines() if "SHA-256" in line]
    assert text.replace(line.rpartition(" ")[2], "DIGEST.") == GOLDEN


def test_sequence_columns_table_has_published_rows(sweep: Path) -> None:
    experiment(sweep, ACROSS | {"published": "table3"})
    text = write_tables(sweep)
    first, _ = grids(text)
    assert (
        first[0] == "| system | poses | annotation | 011 | 016 | 030 | 061 | 078 | 086 | 096 | 206 | 223 | 255 | mean |"
    )
    found, missing = "**0.700 ± 0.141** | 0.400 ± 0.141 |", " ".join(["missing |"] * 8)
    assert first[2] == f"| ours | ground truth | made up | {found} {missing} 0.550 ± 0.000 (2 of 10) |"
    assert len(first) == 6, "expected no line for systems without published values"
    assert first[-1] == (
        "| Voxblox++ with Detectron2 panoptic (published) | ground truth | not known "
        "| 0.655 | 0.033 | 0.676 | 0.269 | 0.517 | 0.325 | 0.299 | – | 0.190 | – | – |"
    )
    assert "- Published, Voxblox++ with Detectron2 panoptic: Han et al., ICRA 2021" in text
    assert "not looked up: the paper (DDNS 2020" in text
    assert "- Sequences without a complete run: dataset.scene=030,061,078,086,096,206,223,255." in text
    assert "seed=0 dataset.scene=255" not in text  # listed once, not for each row and seed


@pytest.mark.parametrize("table", [ACROSS | {"published": "table3"}, BY | {"published": "table2"}])
def test_table_of_synthetic_rooms_has_no_published_numbers(sweep: Path, table: dict[str, Any]) -> None:
    """A sequence that only the paper has gets no column or group."""
    experiment(sweep, table)
    run(sweep, "ours", "016", 2, release="synthetic 1, seed 0, 240 frames", **{AP50: 0.5})
    text = write_tables(sweep)
    assert "(published)" not in text
    assert "030" not in text
    assert "- Published numbers are for the original SceneNN data" in text


def test_table_compares_rows_of_same_pose_source(sweep: Path) -> None:
    """Results depend on the poses, so tracked rows are compared only with tracked rows."""
    for row, value in (("ours", 0.2), ("prior", 0.3)):
        run(sweep, row, "011", 0, tracker="icp", **{AP50: value})
    first, second = grids(write_tables(sweep))
    assert [line.split(" | ")[:2] for line in first[2:]] == [
        ["| ours", "ground truth"],
        ["| Prior (re-implementation)", "ground truth"],
        ["| other", "ground truth"],
        ["| ours", "tracked (icp)"],
        ["| Prior (re-implementation)", "tracked (icp)"],
    ]
    assert (
        first[-1]
        == "| Prior (re-implementation) | tracked (icp) | made up | **0.300 (1 of 2)** | missing | **0.300 (1 of 2)** |"
    )
    assert second[-1] == "| Prior (re-implementation) | tracked (icp) | made up | -0.100 | missing | -0.100 | 1 |"


def test_table_tracked_row_needs_tracked_baseline(sweep: Path) -> None:
    for path in sweep.glob("*row=other*/metrics.json"):
        path.unlink()
    run(sweep, "other", "078", 0, tracker="icp", **{AP50: 0.9})
    text = write_tables(sweep)
    _, second = grids(text)
    assert len(second) == 3
    assert "- Rows without a matching base row (ours): other, tracker=icp." in text


@pytest.mark.parametrize(
    ("changed", "usual", "other", "annotation"),
    [
        ({"data": "/real"}, "dataset.root=/data", "dataset.root=/data/real", "made up"),
        ({"release": "2017"}, "annotation=made up", "annotation=2017", "2017"),
        ({"release": None}, "annotation=made up", "annotation=unknown", "–"),
    ],
)
def test_table_separates_other_data_and_annotations(
    sweep: Path, changed: dict[str, Any], usual: str, other: str, annotation: str
) -> None:
    """Such runs must be neither averaged nor compared."""
    for path in sweep.glob("*row=other*/metrics.json"):
        path.unlink()
    run(sweep, "ours", "078", 0, **{AP50: 0.9}, **changed)
    run(sweep, "other", "078", 0, **{AP50: 0.8}, **changed)
    first, second = grids(write_tables(sweep))
    prior, another = f"| Prior (re-implementation), {usual}", f"| other, {other}"
    assert {line.split(" | ")[0] for line in first[2:]} == {
        f"| ours, {usual}",
        prior,
        f"| ours, {other}",
        another,
    }
    assert [line.split(" | ")[1:] for line in second[2:] if line.startswith(another)] == [
        ["ground truth", annotation, "missing", "missing", "+0.100", "+0.100", "1 |"]
    ]
    assert len([line for line in second if line.startswith(prior)]) == 1


def test_table_csv_has_one_full_precision_line_per_run(sweep: Path) -> None:
    run(sweep, "ours", "078", 0, **{AP50: 1 / 3})
    write_tables(sweep)
    runs = load_runs(sweep)
    assert len(runs) == 12
    read = pandas.read_csv(sweep / "table.csv", dtype=dict(runs.dtypes))
    pandas.testing.assert_frame_equal(read, runs)
    [value] = read[read["dataset.scene"] == "078"][AP50]
    assert value == 1 / 3


def test_sequence_groups_table_has_expected_lines(sweep: Path) -> None:
    experiment(sweep, BY)
    first, second = grids(write_tables(sweep))
    assert first[0] == "| scene | system | poses | annotation | sofa | television | AP50 |"
    couch = "**0.700 ± 0.141** | – | **0.700 ± 0.141**"
    assert first[2] == f"| 011 | ours | ground truth | made up | {couch} |"
    assert first[5] == "| 016 | ours | ground truth | made up | 0.400 ± 0.141 | – | 0.400 ± 0.141 |"
    assert first[7] == "| | other | ground truth | made up | 0.100 (1 of 2) | – | 0.100 (1 of 2) |"
    assert first[8] == "| mean | ours | ground truth | made up | 0.550 ± 0.000 | – | 0.550 ± 0.000 |"
    assert second[0] == "| minus ours | pairs | sofa | television | AP50 |"
    assert second[2] == "| Prior (re-implementation) | 2 | +0.000 ± 0.100 | – | +0.000 ± 0.100 |"


def test_table_bold_mean_ignores_rows_with_fewer_sequences(sweep: Path) -> None:
    """The tracked row with the highest mean has only one sequence. The other tracked rows have two."""
    experiment(sweep, BY)
    for row, scene, value in (
        ("ours", "011", 0.2),
        ("prior", "011", 0.3),
        ("other", "078", 0.9),
        ("ours", "016", 0.2),
    ):
        run(sweep, row, scene, 0, tracker="icp", **{AP50: value})
    run(sweep, "prior", "016", 0, tracker="icp", **{AP50: 0.2})
    run(sweep, "ours", "078", 0, **{AP50: 0.9})
    first, _ = grids(write_tables(sweep))
    cells = {tuple(line.split(" | ")[1:3]): line.split(" | ")[-1] for line in first[-6:]}
    assert cells["ours", "tracked (icp)"] == "0.200 (2 of 3) |"
    assert cells["Prior (re-implementation)", "tracked (icp)"] == "**0.250 (2 of 3)** |"
    assert cells["other", "tracked (icp)"] == "0.900 (1 of 3) |"


@pytest.mark.parametrize("table", [ACROSS, BY])
def test_table_bold_mean_ignores_rows_with_fewer_runs(sweep: Path, table: dict[str, Any]) -> None:
    """A mean over fewer runs is marked with the number of runs."""
    experiment(sweep, table)
    for path in sweep.glob("*row=other,seed=1*/metrics.json"):
        path.unlink()
    for path in sweep.glob("*row=other,seed=0*/metrics.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {AP50: 0.75}))
    lines, _ = grids(write_tables(sweep))
    assert "".join(lines).count("| 0.750 (1 of 2) ") == 2
    assert sum(line.endswith("| 0.750 (2 of 4 runs) |") for line in lines) == 1
    assert sum(line.endswith("| 0.550 ± 0.000 |") for line in lines) == 2
    assert "**0.75" not in "".join(lines)


def test_sequence_groups_table_has_published_rows_in_group(sweep: Path) -> None:
    experiment(sweep, BY | {"published": "table2"})
    first, _ = grids(write_tables(sweep))
    han = "Voxblox++ with Detectron2 panoptic (published) | ground truth"
    assert first[5] == f"| | {han} | not known | 0.952 | – | 0.655 |"
    assert f"| 030 | {han} | not known | 0.991 | 0.000 | 0.676 |" in first  # a sequence without own runs
    assert "| Voxblox++ (published) |" not in "".join(first)
    assert not [line for line in first if line.startswith("| 206")]


@pytest.mark.parametrize("table", [ACROSS | {"published": "table3"}, BY | {"published": "table2"}])
def test_latex_rows_match_tabular_column_count(sweep: Path, table: dict[str, Any]) -> None:
    experiment(sweep, table)
    write_tables(sweep)
    latex = (sweep / "table.tex").read_text()
    tabulars = latex.split("\\begin{tabular}{")[1:]
    assert len(tabulars) == 2
    for tabular in tabulars:
        columns = len(tabular.partition("}")[0])
        rows = [line for line in tabular.splitlines() if line.endswith("\\\\")]
        assert {line.replace("\\&", "").count("&") + 1 for line in rows} == {columns}
    assert "\\textbf{0.700 $\\pm$ 0.141}" in latex
    cells = [line for line in latex.splitlines() if not line.startswith("%")]
    assert not any(mark in line for line in cells for mark in ("**", "±", "–"))
    assert all(line.startswith(("%", "\\")) or "&" in line or not line for line in latex.splitlines())
