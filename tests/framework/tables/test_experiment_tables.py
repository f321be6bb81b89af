"""Tests for experiment tables in three formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas
import pytest
from omegaconf import OmegaConf

from framework.errors import DataError
from framework.runs.data_frame import load_runs
from framework.runs.provenance import config_hash
from framework.synthetic.scenenn_scene import BenchmarkSettings
from framework.tables.experiment_tables import write_tables
from framework.tables.table_check import changed_tables
from tests.support.forked_commands import completed

pytestmark = pytest.mark.integration

AP50 = "instances.ap50"
CHECKOUT = Path(__file__).resolve().parents[3]
TABLE = {"average_over": ["seed"], "base": "chain", "columns": ["instances.ap50", "stage_ms.refinement.median"]}
FUSER_HEADS = "association (ms), update (ms), integration (ms), fusion (ms)"
ROWS = {"identity": ["refiner=identity"], "chain": [], "none_yet": ["refiner=none_yet"]}


def run(root: Path, row: str, seed: int, ap: float | None, ms: float, scene: str = "", **metrics: Any) -> Path:
    directory = root / f"row={row},seed={seed}{scene}"
    directory.mkdir()
    config = {"row": row, "seed": seed, "scene": scene, "refiner": {"kind": row}}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    expected = {
        **{"instances.ap50": ap, "stage_ms.refinement.median": ms, "pose_source": "ground_truth", "choice.fuser": "f"},
        **{"config_hash": config_hash(config), "git_commit": "1234567890", "git_dirty": False},
        **{"environment.cpus": 2, "environment.processor": "Z80"},
    }
    (directory / "metrics.json").write_text(json.dumps(expected | metrics))
    return directory


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    root = tmp_path / "ablation_x"
    root.mkdir()
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": TABLE, "rows": ROWS})))
    for seed, (bare, chain) in enumerate([(0.2, 0.5), (0.4, 0.6), (0.6, 1.0)]):
        run(root, "identity", seed, bare, 0.0)
        run(root, "chain", seed, chain, 150 + seed)
    return root


def test_write_tables_values_match_manual_result(sweep: Path) -> None:
    text = write_tables(sweep)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[0] == "# ablation_x"
    assert lines[2] == "| row | runs | AP50 | refinement (ms) | poses |"
    # identity: mean 0.4, sd 0.2; chain: mean 0.7, sd sqrt(0.14 / 2) = 0.2646
    assert "| identity | 3 | 0.400 ± 0.200 | 0.0 | ground_truth |" in lines
    assert "| chain | 3 | 0.700 ± 0.265 | 151.0 ± 1.0 | ground_truth |" in lines
    # -0.3, -0.2, -0.4: mean -0.3, standard error 0.1 / sqrt(3) = 0.0577; t = 5.2 > 4.3
    assert "| identity | 3 | -0.300 ± 0.058 * | -151.0 ± 0.6 * |" in lines
    assert "| minus chain | pairs | AP50 | refinement (ms) |" in lines
    # scipy.stats.ttest_1samp([-0.3, -0.2, -0.4], 0).pvalue is 0.035; three negative values: 2 of 2^3 sign patterns
    assert "| AP50 | identity | 3 | -0.300 | – | 0.035 | 0.035 | 0.250 | 0.250 | 4 |" in lines
    assert "| refinement (ms) | identity | 3 | -151.0 | – | < 0.001 | < 0.001 | 0.250 | 0.250 | 2 |" in lines
    assert "with fewer than 6 values of seed; its smallest p with 3 is 0.250." in text
    assert (sweep / "table.md").read_text() == text
    assert "- Overrides of each row: identity: refiner=identity; chain: none; none_yet: refiner=none_yet." in lines
    assert "- Rows without a complete run: none_yet." in lines
    assert "- Common to all runs: fuser=f." in lines
    assert "- Code: 1234567." in lines
    assert "- Machine: 2 cores of Z80." in lines
    assert "Missing" not in text


@pytest.mark.parametrize(
    ("name", "before", "after", "message"),
    [
        ("table.md", "0.700 ±", "0.900 ±", "chain: AP50: expected 0.700 ± 0.265 as in the runs, got 0.900 ± 0.265"),
        ("table.tex", "0.700", "0.900", "chain: AP50 $\\uparrow$: expected 0.700 $\\pm$ 0.265 as in the runs, got 0.9"),
        ("table.csv", ",0.6,", ",0.61,", "row=chain,seed=1: instances.ap50: expected 0.6 as in the runs, got 0.61"),
        ("table.md", "| identity | 3 | -", "| x | 3 | -", "minus chain: expected identity as in the runs, got x"),
        ("table.md", " poses ", " x | poses ", "expected the rows and columns of the runs' table, got different ones"),
    ],
)
def test_changed_tables_name_edited_cell(sweep: Path, name: str, before: str, after: str, message: str) -> None:
    write_tables(sweep)
    assert list(changed_tables(sweep)) == []
    content = (sweep / name).read_text()
    content = "\n".join(" ".join(line.split()) for line in content.splitlines()) if name == "table.md" else content
    assert before in content
    (sweep / name).write_text(content.replace(before, after))
    assert any(message in change for change in changed_tables(sweep)), list(changed_tables(sweep))


def test_changed_tables_too_long_field_is_error(sweep: Path) -> None:
    write_tables(sweep)
    (sweep / "table.csv").write_text("x" * 200_000)
    with pytest.raises(DataError, match=r"table.csv: expected valid CSV, got an error \(field larger than"):
        list(changed_tables(sweep))


def test_changed_tables_uses_overrides_of_stored_tables(sweep: Path) -> None:
    write_tables(sweep, ["table.base=identity", "table.columns=[instances.ap50]"])
    assert list(changed_tables(sweep)) == []
    (sweep / "table.yaml").unlink()
    assert list(changed_tables(sweep)) != []
    write_tables(sweep, ["table.base=identity"])
    write_tables(sweep)
    assert not (sweep / "table.yaml").exists()


def test_table_csv_is_data_frame_of_its_runs(sweep: Path) -> None:
    write_tables(sweep)
    runs = load_runs(sweep)
    assert runs[AP50].tolist() == [0.5, 0.6, 1.0, 0.2, 0.4, 0.6]
    read = pandas.read_csv(sweep / "table.csv", dtype=dict(runs.dtypes))
    pandas.testing.assert_frame_equal(read, runs.replace("", pandas.NA))  # CSV has no empty strings


def test_table_difference_error_is_over_scenes(tmp_path: Path) -> None:
    """The differences are 0.3 and 0.1 in the two scenes. The error must not depend on the number of seeds."""
    table = {"average_over": ["seed", "scene"], "columns": ["instances.ap50"]}
    rows = {"chain": [], "other": ["refiner=other"]}
    (tmp_path / "multirun.yaml").write_text(OmegaConf.to_yaml({"table": table, "rows": rows}))
    for row, scene, ap in (("chain", "a", 0.5), ("chain", "b", 0.5), ("other", "a", 0.8), ("other", "b", 0.6)):
        for seed in range(3):
            run(tmp_path, row, seed, ap, 1.0, scene=scene)
    text = write_tables(tmp_path)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "| other | 2 | +0.200 ± 0.100 |" in lines  # the error over six runs would be 0.045
    assert "paired by seed, scene: mean ± standard error over scene, after averaging" in text


def test_table_notes_list_missing_runs(sweep: Path) -> None:
    (sweep / "row=chain,seed=1" / "metrics.json").unlink()
    (sweep / "row=chain,seed=1" / "instancemap.log").write_text("12:00:00 ERROR   the map is full.\n")
    (sweep / "row=identity,seed=2" / "metrics.json").write_text("{")
    run(sweep, "identity", 7, None, 1.0, git_commit="89abcdef", pose_source="tracked")
    text = write_tables(sweep)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "| identity | 3 | 0.300 ± 0.141 (2 of 3) | 0.3 ± 0.6 | ground_truth/tracked |" in lines
    assert "| identity | 1 | -0.300 | -150.0 |" in lines  # seed 0 is the only pair, and a single pair has no error
    assert "- Missing in chain: seed=1,7." in lines
    assert "- Missing in identity: seed=2." in lines
    assert "- Incomplete: row=chain,seed=1: failed: the map is full." in lines
    assert sum(line.startswith("- Incomplete: row=identity,seed=2: ") for line in lines) == 1
    assert "- Code: 1234567 (4 runs), 89abcde (1 run)." in lines


def test_table_notes_list_requested_runs_without_outputs(sweep: Path) -> None:
    asked = {"sweeper": {"params": {"row": "${all_of:${rows}}", "seed": 0}}, "overrides": {"task": ["seed=range(0,5)"]}}
    config = {"table": TABLE, "rows": ROWS, "hydra": asked}
    (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    lines = write_tables(sweep).splitlines()
    assert "- Missing in identity: seed=3,4." in lines
    assert "- Missing in chain: seed=3,4." in lines


def test_table_code_note_names_later_evaluation_commit(sweep: Path) -> None:
    """One of the runs was evaluated again with a later version."""
    path = sweep / "row=chain,seed=1" / "metrics.json"
    again = {"evaluation.git_commit": "fedcba9876", "evaluation.git_dirty": True}
    path.write_text(json.dumps(json.loads(path.read_text()) | again))
    expected = "- Code: 1234567 (5 runs), 1234567, evaluated by fedcba9 with changes (1 run)."
    assert expected in write_tables(sweep).splitlines()


def test_table_notes_name_rows_of_mixed_plugin_code(sweep: Path) -> None:
    for seed, code in enumerate(("mean 0.1 3f", "mean 0.1 9c", "mean 0.1 9c")):
        run(sweep, "mean", seed, 0.5, 1.0, **{"code.refiner": code, "code.fuser": "tsdf 1.0 aa"})
    assert "- Mixed plugin code in mean: refiner mean 0.1 9c (2 runs), mean 0.1 3f (1 run); repeat its runs with" in (
        write_tables(sweep)
    )


def test_table_code_of_several_options_is_not_mixed(sweep: Path) -> None:
    for seed, dataset in enumerate(("desk", "replica", "desk")):
        code = {"choice.dataset": dataset, "code.dataset": f"{dataset} 3f"}
        run(sweep, "mean", seed, 0.5, 1.0, **code)
    assert "Mixed plugin code" not in write_tables(sweep)


def test_table_notes_replace_line_breaks(sweep: Path) -> None:
    (sweep / "row=chain,seed=1" / "metrics.json").unlink()
    partial = {"partial": "the map\nis\r\nfull"}
    (sweep / "row=chain,seed=1" / "metrics.partial.json").write_text(json.dumps(partial))
    assert "- Incomplete: row=chain,seed=1: partial: the map is full." in write_tables(sweep).splitlines()
    assert "% Incomplete: row=chain,seed=1: partial: the map is full." in (sweep / "table.tex").read_text()


def test_table_notes_list_parameters_equal_to_seed(tmp_path: Path) -> None:
    for seed in (1, 2):
        config = {"seed": seed, "dataset": {"stride": seed}}
        directory = run(tmp_path, "x", seed, 0.5, 1.0)
        (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
        metrics = json.loads((directory / "metrics.json").read_text()) | {"config_hash": config_hash(config)}
        (directory / "metrics.json").write_text(json.dumps(metrics))
    expected = "- Also averaged over keys that depend on seed: dataset.stride."
    assert expected in write_tables(tmp_path)


def test_table_without_base_has_no_differences(sweep: Path) -> None:
    for path in sweep.glob("row=chain*/metrics.json"):
        path.unlink()
    text = write_tables(sweep)
    assert "minus chain" not in text
    assert "- No differences: the base chain has no complete run; set table.base=ROW." in text
    assert text.count("| identity ") == 1


def test_table_rows_use_configured_names(sweep: Path) -> None:
    table = TABLE | {"names": {"chain": "all of it"}}
    (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": table, "rows": ROWS})))
    text = write_tables(sweep)
    assert "| all of it |" in text
    assert "| minus all of it |" in text


RUN_TIMES = {
    "average_over": ["seed"],
    "columns": ["fps", "stage_ms.refinement.median", "frames_lost"],
    "published": "table1",
}


def of_dataset(sweep: Path, dataset: str, annotation: str | None = None, only: str = "") -> None:
    """Set the dataset of all runs, or of the runs of one row."""
    for path in sweep.glob(f"row={only}*/metrics.json"):
        expected = {"choice.dataset": dataset, "annotation_release": annotation}
        path.write_text(json.dumps(json.loads(path.read_text()) | expected))


@pytest.mark.parametrize("annotation", ["not named", None])
def test_table_on_scenenn_has_published_run_times(sweep: Path, annotation: str | None) -> None:
    of_dataset(sweep, "scenenn", annotation)
    (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": RUN_TIMES, "rows": ROWS})))
    text = write_tables(sweep)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[2] == "| row | runs | Hz | refinement (ms) | frames lost | poses |"
    assert "| the paper (published) | – | 10.8 | not known | – | tracked |" in lines
    assert "Voxblox++ (published)" not in text, "expected no row without values"
    assert "- Published, the paper: DDNS 2020, article 2528954; all components on every frame of 640x480" in text
    unknown = [line for line in lines if "Published results not looked up" in line]
    assert unknown == [
        "- Published results not looked up: Voxblox++ (Grinvald et al., RA-L 2019); Pham et al. (WACV "
        "2019); MaskFusion (Rünz et al., ISMAR 2018); Fusion++ (McCormac et al., 3DV 2018)."
    ]


@pytest.mark.parametrize(
    ("dataset", "annotation", "only"),
    [
        ("scenenn", BenchmarkSettings().release, ""),
        # one row is on synthetic rooms, and the others are on real data
        ("scenenn", BenchmarkSettings().release, "chain"),
        ("scannet", "ScanNet v2", ""),
        ("synthetic", None, ""),
    ],
)
def test_table_on_other_data_has_no_published_numbers(
    sweep: Path, dataset: str, annotation: str | None, only: str
) -> None:
    of_dataset(sweep, "scenenn", "2016")
    of_dataset(sweep, dataset, annotation, only)
    (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": RUN_TIMES, "rows": ROWS})))
    text = write_tables(sweep)
    assert "(published)" not in text
    assert "not known" not in text
    assert "not looked up" not in text
    assert "- Published numbers are for the original SceneNN data (sequences=scenenn) and omitted" in text


def test_table_published_row_without_values_is_omitted(sweep: Path) -> None:
    """The paper reports the frame rate, but neither stage times nor lost frames."""
    of_dataset(sweep, "scenenn")
    for columns, named in ((["stage_ms.refinement.median"], True), (["frames_lost"], False)):
        table = RUN_TIMES | {"columns": columns}
        (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": table, "rows": ROWS})))
        text = write_tables(sweep)
        assert "(published)" not in text
        assert ("not looked up: the paper (DDNS 2020" in text) is named


def test_table_split_row_is_compared_with_matching_baseline(tmp_path: Path) -> None:
    """The command line splits the rows by voxel size. Rows are compared if their voxel sizes are equal."""
    root = tmp_path / "x"
    root.mkdir()
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create({"table": TABLE, "rows": ROWS})))
    for voxel, better in ((1, 0.25), (2, 0.125)):
        for row, ap in (("chain", 0.5), ("identity", 0.5 - better)):
            directory = run(root, row, 0, ap, 1.0)
            config = OmegaConf.load(directory / "config.yaml")
            config.fuser = {"voxel": voxel}
            OmegaConf.save(config, directory / "config.yaml")
            metrics = json.loads((directory / "metrics.json").read_text())
            metrics["config_hash"] = config_hash({str(k): v for k, v in OmegaConf.to_object(config).items()})
            (directory / "metrics.json").write_text(json.dumps(metrics))
            directory.rename(root / f"{row}{voxel}")
    lines = [" ".join(line.split()) for line in write_tables(root).splitlines()]
    assert "| identity, fuser.voxel=1 | 1 | -0.250 | +0.000 |" in lines
    assert "| identity, fuser.voxel=2 | 1 | -0.125 | +0.000 |" in lines


def test_table_unknown_metric_is_dash(sweep: Path) -> None:
    (sweep / "multirun.yaml").write_text(OmegaConf.to_yaml({"table": TABLE | {"columns": ["no.such"]}, "rows": ROWS}))
    text = write_tables(sweep)
    assert "| identity |    3 |       – | ground_truth |" in text
    assert "- Metrics in no run: no.such." in text, "expected a note on the column, which may be misspelled"


def test_table_without_experiment_has_available_columns(tmp_path: Path) -> None:
    """Only columns with values are written. Recordings without annotation have no instance metrics."""
    poses = {"trajectory.ate_rmse_m": 0.012, "frames_lost": 2, "fps": 21.5}
    for name in ("a", "b"):
        run(tmp_path, name, 0, None, 1.0, **poses)
    text = write_tables(tmp_path)
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert lines[2] == "| row | runs | ATE (m) | frames lost | Hz | refinement (ms) | poses |"
    assert "| a | 1 | 0.012 | 2.00 | 21.5 | 1.000 | ground_truth |" in lines
    assert "| minus a | pairs | ATE (m) | frames lost | Hz | refinement (ms) |" in lines
    absent = (
        "- Omitted columns without values: AP50, AP50 agnostic, AP25, AP, mean IoU (only with ground-truth instances); "
    )
    assert [line for line in lines if "Omitted" in line] == [absent + f"instances, {FUSER_HEADS}."]
    assert "transfer" not in text, "expected no note on the transfer without ground-truth instances"


def test_table_without_experiment_has_column_for_single_value(tmp_path: Path) -> None:
    run(tmp_path, "a", 0, None, 1.0, **{"instances.mean_iou": 0.0})
    run(tmp_path, "b", 0, 0.5, 1.0)
    lines = [" ".join(line.split()) for line in write_tables(tmp_path).splitlines()]
    assert lines[2] == "| row | runs | AP50 | mean IoU | refinement (ms) | poses |"
    assert "| a | 1 | – | 0.000 | 1.000 | ground_truth |" in lines
    assert [line for line in lines if "Omitted" in line] == [
        "- Omitted columns without values: AP50 agnostic, AP25, AP (only with ground-truth instances); "
        f"instances, frames lost, Hz, {FUSER_HEADS}; ATE (m) (only with ground-truth poses)."
    ]


def test_table_without_metrics_has_all_columns(tmp_path: Path) -> None:
    run(tmp_path, "a", 0, None, 1.0, **{"stage_ms.refinement.median": None})
    text = write_tables(tmp_path)
    assert text.splitlines()[2].count("|") == 18  # row, runs, poses and 14 metrics
    assert "Omitted" not in text


def test_experiment_table_keeps_columns_without_values(sweep: Path) -> None:
    for path in sweep.glob("*/metrics.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"instances.ap50": None}))
    text = write_tables(sweep)
    assert "| row      | runs | AP50 |" in text
    assert "Omitted" not in text


def test_table_notes_count_older_records(sweep: Path) -> None:
    (sweep / "again").mkdir()
    run(sweep / "again", "chain", 0, 0.0, 1.0)
    assert "- Omitted older records of the same runs: 1." in write_tables(sweep)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("table: [", "expected valid YAML"),
        ("table: {columns: [], average_over: [seed]}", r"table\.columns: expected at least one key, got none"),
    ],
)
def test_write_tables_invalid_experiment_raises_one_line_error(sweep: Path, content: str, message: str) -> None:
    (sweep / "multirun.yaml").write_text(content)
    with pytest.raises(Exception, match=message) as caught:
        write_tables(sweep)
    assert "\n" not in str(caught.value)


def test_write_tables_without_complete_run_raises_reason(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a completed run, got none"):
        write_tables(tmp_path)
    with pytest.raises(DataError, match="expected a folder of runs, got no folder"):
        write_tables(tmp_path / "nowhere")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "metrics.partial.json").write_text('{"partial": "the map is full"}')
    with pytest.raises(DataError, match=r"\(run: partial: the map is full\)"):
        write_tables(tmp_path)
    assert not list(tmp_path.glob("table.*"))


def test_latex_and_markdown_tables_escape_special_characters(sweep: Path) -> None:
    run(sweep, r"50%_{a}|b\c", 0, 0.5, 1.0)
    assert r"50%\_{a}\|b\\c" in write_tables(sweep)
    latex = (sweep / "table.tex").read_text()
    assert r"50\%\_\{a\}\textbar{}b\textbackslash{}c & 1 & 0.500 &" in latex
    assert r"chain & 3 & 0.700 $\pm$ 0.265 & 151.0 $\pm$ 1.0 & ground\_truth \\" in latex
    bodies = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert {line.count("&") for line in bodies[:4]} == {4}
    assert latex.count("\\begin{tabular}{lrrrr}") == 1
    assert all(line.startswith(("%", "\\")) or "&" in line or not line for line in latex.splitlines())


def test_table_notes_name_data_without_evaluation(tmp_path: Path) -> None:
    for seed, frames in enumerate((600, 90)):
        run(tmp_path, "a", seed, None, 1.0, frames=frames, **{"choice.dataset": "desk"})
    assert "- Data: dataset=desk; 90 to 600 frames per run.\n" in write_tables(tmp_path)


def test_tables_command_prints_table_or_error(sweep: Path) -> None:
    done = completed(CHECKOUT, "tables", str(sweep))
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("# ablation_x")
    wrong = completed(CHECKOUT, "tables", str(sweep), "nowhere")
    assert (wrong.returncode, wrong.stderr) == (1, "error: nowhere: expected a folder of runs, got no folder\n")
