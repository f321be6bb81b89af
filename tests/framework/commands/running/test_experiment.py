"""Tests for experiments and for the rows of the included experiments."""

from __future__ import annotations

import functools
import json
import subprocess
from itertools import product
from pathlib import Path
from typing import Any

import pandas
import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from framework.commands.running.choices import with_row
from framework.errors import ConfigError, InstanceMapError
from framework.files.search_paths import CONF
from framework.interfaces import ClusterRefiner, Detector, MapFuser, PoseTracker
from framework.registry import build, stage_of
from framework.runs.data_frame import load_runs
from framework.runs.provenance import config_hash
from framework.synthetic.benchmark import SCENES
from framework.tables.published import read_published
from tests.support.forked_commands import FAKE_CONF, completed

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

CHECKOUT = Path(__file__).resolve().parents[4]
FAKES = CHECKOUT / "tests" / "support" / "fake_conf"
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
PRESETS = sorted(path.stem for path in (CONF / "preset").glob("*.yaml"))
USER_SETTINGS = ("++dataset.root=somewhere",)


def start(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return completed(directory, "--config-dir", str(FAKE_CONF), "experiment=fake_ablation", *arguments)


def table(directory: Path) -> dict[str, dict[str, str]]:
    """Return the cells of table.md as {name of the row: {heading: cell}}."""
    lines = [line.strip("|").split("|") for line in (directory / "table.md").read_text().splitlines()[2:]]
    heads, _, *rows = [[cell.strip() for cell in line] for line in lines[: lines.index([""])]]
    return {row[0]: dict(zip(heads, row, strict=True)) for row in rows}


def test_experiment_runs_missing_rows_and_writes_table(tmp_path: Path) -> None:
    """The row `all` maps 8 frames and `half` maps 4 frames. `seed` frames are lost in each. The row `broken` fails."""
    first = start(tmp_path)
    out = tmp_path / "outputs" / "fake_ablation"
    assert first.returncode == 1, "expected the status of failed runs, from the row `broken`"
    assert first.stderr.count("ERROR") == 2
    assert "Traceback" not in first.stderr
    metrics = {path.parent.name: path for path in out.glob("*/metrics.json")}
    assert set(metrics) == {f"row={row},seed={seed}" for row in ("all", "half") for seed in (1, 3)}

    lines = table(out)
    assert list(lines) == ["all", "half"]
    assert [line["frames"] for line in lines.values()] == ["8.00", "4.00"]
    assert [line["frames lost"] for line in lines.values()] == ["2.00 ± 1.41", "2.00 ± 1.41"]
    runs = load_runs(out)
    assert list(runs["run"]) == sorted(metrics)
    assert list(runs["dataset.frames"]) == [8, 8, 4, 4]
    assert list(runs["frames_lost"]) == [1, 3, 1, 3]
    read = pandas.read_csv(out / "table.csv", dtype=dict(runs.dtypes))
    pandas.testing.assert_frame_equal(read, runs.replace("", pandas.NA))  # CSV has no empty strings
    text = (out / "table.md").read_text()
    assert text in first.stdout
    assert "| half | 2 | -4.00 | +0.000 |" in " ".join(text.split()), "expected equal differences"
    assert "Rows without a complete run: broken." in text
    assert "Incomplete: row=broken,seed=3: failed: dataset" in text
    assert "half: refiner=identity dataset.frames=4" in text
    assert (out / "table.tex").read_text().count("\\begin{tabular}") == 2
    assert {path.name for path in out.glob("figure.*")} == {"figure.png", "figure.pdf"}
    assert "omitted from the figure: row=broken,seed=1: failed:" in first.stdout
    config = OmegaConf.load(out / "row=half,seed=3" / "config.yaml")
    assert (config.row, config.seed, config.dataset.frames) == ("half", 3, 4)
    assert config.refiner._target_ == "plugins.refiners.identity.Identity"
    assert json.loads(metrics["row=half,seed=3"].read_text())["choice.refiner"] == "identity"

    written = {name: path.stat().st_mtime_ns for name, path in metrics.items()}
    metrics["row=half,seed=3"].unlink()  # simulate a run that was killed before it wrote the last file
    again = start(tmp_path, "row=all,half", "table.columns=[frames]")
    assert again.returncode == 0, again.stderr
    assert again.stderr.count("skipped: the completed run in") == 3
    assert again.stderr.count("mapping corner_room") == 1
    kept = {name for name, path in metrics.items() if path.stat().st_mtime_ns == written[name]}
    assert kept == set(metrics) - {"row=half,seed=3"}
    assert table(out)["half"] == {"row": "half", "runs": "2", "frames": "4.00", "poses": "ground_truth"}


def test_experiment_table_has_one_column_per_sequence(tmp_path: Path) -> None:
    """Sequence names keep their leading zeros, and directory names do not contain settings of the table."""
    done = start(tmp_path, "experiment=fake_scenes", "table.average_over=[seed]")
    assert done.returncode == 0, done.stderr
    lines = [" ".join(line.split()) for line in done.stdout.splitlines()]
    assert "| system | poses | 011 | 078 | mean |" in lines
    assert "| ours | ground truth | **1.00** | **1.00** | **1.00** |" in lines
    assert "| Prior | ground truth | -1.000 | -1.000 | -1.000 | 2 |" in lines
    out = tmp_path / "outputs" / "fake_scenes"
    assert (out / "dataset.scene=078,row=prior,seed=1,tracker=fake" / "metrics.json").exists()


# Composition of a job


def composed(overrides: list[str], *directories: Path) -> tuple[DictConfig, Any]:
    """Return the config of a sweep job and the option that is chosen in each config group."""
    with initialize_config_dir(str(directories[0] if directories else CONF), version_base="1.3"):
        config = compose("config", overrides=overrides, return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        own = HydraConfig.get()
        with open_dict(config):
            del config["hydra"]
        return with_row(config, own)


def test_experiment_row_name_accepts_number() -> None:
    assert OmegaConf.create("{rows: {ours: [], 2: []}, all: '${all_of:${rows}}'}").all == "ours,2"


@pytest.mark.parametrize(
    ("experiment", "preset", "all_rows"),
    [
        *((experiment, None, False) for experiment in EXPERIMENTS),
        *((experiment, "paper", False) for experiment in ("ablation_fuser", "ablation_tracker", "table3_map")),
        *(pytest.param(*case, True, marks=REPEATED) for case in product(EXPERIMENTS, [None, *PRESETS])),
    ],
)
def test_experiment_rows_compose_with_every_preset(experiment: str, preset: str | None, all_rows: bool) -> None:
    """The rows are composed and their stages are built. Without `all_rows`, only the last rows are tested."""
    hashes: dict[str, str] = {}
    asked = [f"experiment={experiment}", "seed=1", *USER_SETTINGS] + ([f"preset={preset}"] if preset else [])
    with initialize_config_dir(str(CONF), version_base="1.3"):
        rows = compose("config", overrides=asked).rows
    for row in rows if all_rows else list(rows)[-1 if preset else -2 :]:
        config, choices = composed([*asked, f"row={row}"])
        resolved = OmegaConf.to_container(config, resolve=True)
        assert isinstance(resolved, dict)
        if list(rows[row]) != ["preset=default"]:  # the config of this row may equal that of another row
            hashes[row] = config_hash({str(key): value for key, value in resolved.items()})
        for interface in (PoseTracker, ClusterRefiner, MapFuser):
            build(interface, config[stage_of(interface)])
        build_detector(config.detector)
        given = next((change for change in rows[row] if change.startswith("preset=")), f"preset={preset or 'default'}")
        assert f"preset={choices['preset']}" == given
        assert choices["experiment"] == experiment
        assert config.dataset.seed == 1
        assert config.row == row
    assert preset or len(set(hashes.values())) == len(hashes), "expected a different config for each row"


def build_detector(node: DictConfig) -> None:
    """Build the detector, or check that a missing file is reported in a one-line error."""
    try:
        build(Detector, node)
    except InstanceMapError as error:
        assert "\n" not in str(error)
        assert str(node.weights) in str(error)


def test_experiment_row_applies_its_overrides() -> None:
    config, choices = composed(["experiment=ablation_refiner", "row=chain_with_kmeans", "seed=4"])
    assert config.refiner.links.gmm_em._target_ == "plugins.refiners.kmeans.KMeans"
    assert (choices["refiner"], config.seed, config.dataset.stride, config.fuser.voxel_size) == ("chain", 4, 2, 0.02)
    assert "hydra" not in config


def test_sequences_choose_data_detector_and_pose_source() -> None:
    config, choices = composed(["experiment=ablation_fuser", "sequences=replica_given_poses", "row=label_count"])
    assert (choices["dataset"], choices["detector"], choices["fuser"]) == ("rgbd_folder", "maskrcnn2go", "label_count")
    assert (config.dataset.frame_fraction, config.dataset.stride, config.fuser.voxel_size) == (0.85, 1, 0.05)
    assert config.fuser.storage == "EXACT"
    assert choices["tracker"] == "ground_truth"


@pytest.mark.parametrize("sequences", sorted(path.stem for path in (CONF / "sequences").glob("*.yaml")))
def test_sequences_with_given_poses_use_ground_truth_tracker(sequences: str) -> None:
    """The tracker set by `sequences` overrides that of `preset`, and the command line overrides both."""
    given = sequences.endswith("_given_poses")
    for preset in PRESETS:
        asked = {"experiment": "table3_map", "sequences": sequences, "preset": preset}
        assert chosen(**asked)["tracker"] == ("ground_truth" if given else chosen(preset=preset)["tracker"])
    assert chosen(**asked, tracker="icp_only")["tracker"] == "icp_only"


@functools.cache
def chosen(**choices: str) -> dict[str, str]:
    """Return the option that Hydra chooses in each config group."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [f"{group}={name}" for group, name in choices.items()], return_hydra_config=True)
    return {str(key): str(value) for key, value in config.hydra.runtime.choices.items()}


def test_preset_default_changes_nothing() -> None:
    assert composed(["preset=default"])[0] == composed(["~preset"])[0]


@pytest.mark.parametrize("experiment", ["table1_runtime", "table2_class_ap", "table3_map", "figure3_stage_times"])
def test_sequences_of_scenenn_select_real_data_settings(experiment: str) -> None:
    """The detector is a network for real images. The sequences are those of the paper."""
    overrides = [f"experiment={experiment}", "sequences=scenenn", "dataset.root=DIR"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        asked = compose("config", overrides=overrides, return_hydra_config=True)
        HydraConfig.instance().set_config(asked)
        assert asked.hydra.sweep.dir.endswith(f"/{experiment}_scenenn")
    assert asked.hydra.runtime.choices.detector == "mask_rcnn"
    assert (asked.dataset.frame_ground_truth, asked.dataset.stride) == (False, 1)
    assert asked.detector.weights.startswith("resnet101")
    assert asked.hydra.runtime.choices.tracker == "voxel_hashing_icp"
    sequences = asked.hydra.sweeper.params["dataset.scene"].split(",")
    assert set(sequences) <= set(read_published("table3").sequences)
    assert len(sequences) == (5 if experiment in ("table1_runtime", "figure3_stage_times") else 10)


@pytest.mark.parametrize("experiment", ["table3_map", "figure4_progress", "figure5_refinement", "ablation_overlap"])
def test_experiment_on_synthetic_scenes_simulates_detector(experiment: str) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[f"experiment={experiment}"], return_hydra_config=True)
    assert (config.hydra.runtime.choices.detector, config.dataset.frame_ground_truth) == ("simulated_yolo11n", True)
    assert config.sequences.all.split(",") == list(SCENES)
    assert not set(SCENES) & set(read_published("table3").sequences)
    assert set(config.hydra.sweeper.params["dataset.scene"].split(",")) <= set(config.sequences.all.split(","))


@pytest.mark.parametrize(("sequences", "stop"), [("benchmark", 40), ("scenenn", 1000)])
def test_figure4_progress_stop_frame_depends_on_sequences(sequences: str, stop: int) -> None:
    config, _ = composed(["experiment=figure4_progress", f"sequences={sequences}", "row=in_progress"])
    assert config.dataset.stop == stop


def test_ranks_folder_name_contains_sequences_and_detector() -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        asked = compose(
            "config",
            overrides=["experiment=ranks", "sequences=scannet_given_poses", "detector=rf_detr_seg"],
            return_hydra_config=True,
        )
        HydraConfig.instance().set_config(asked)
        assert asked.hydra.sweep.dir.endswith("/ranks_scannet_given_poses_rf_detr_seg")
    assert (asked.dataset.frame_fraction, asked.fuser.voxel_size) == (0.85, 0.02)
    assert asked.hydra.sweeper.params.seed == "0,1,2,3"


def test_experiment_is_overridden_by_command_line() -> None:
    config, _ = composed(["experiment=ablation_fuser", "row=label_count", "fuser.voxel_size=0.04", "tracker=icp_only"])
    assert config.fuser.voxel_size == 0.04
    assert config.tracker._target_ == "plugins.trackers.voxel_hashing_icp.VoxelHashingIcp"


def test_experiment_unknown_figure_kind_raises_before_runs() -> None:
    with pytest.raises(ConfigError, match=r"figure\.kind: expected one"):
        composed(["experiment=figure4_progress", "row=final", "figure.kind=pie"])


def test_experiment_unknown_row_raises() -> None:
    with pytest.raises(ConfigError, match=r"row: expected one of .*, got chian; did you mean chain\?"):
        composed(["experiment=ablation_refiner", "row=chian"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["row=half,hafl"], "error: row: expected one of"),
        (
            ["row=half,whole", "fuser.capcity=3"],
            "error: fuser.capcity: expected a known key, got capcity; did you mean",
        ),
        (["seed=range(0,0)"], "error: seed=range(0,0): expected at least one value, got none"),
    ],
)
def test_sweep_errors_are_reported_before_first_run(tmp_path: Path, arguments: list[str], message: str) -> None:
    done = start(tmp_path, *arguments)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith(message)
    assert len(done.stderr.splitlines()) == 1
    assert not list(tmp_path.rglob("config.yaml"))


def test_run_without_experiment_has_no_experiment_settings() -> None:
    config, choices = composed(["refiner=kmeans"])
    assert "row" not in config
    assert not config.get("skip_completed")
    assert choices["refiner"] == "kmeans"


def test_experiment_settings_do_not_change_config_hash() -> None:
    expected = {
        "row": "a",
        "rows": {"a": []},
        "sequences": {"all": "b"},
        "skip_completed": True,
        "table": {"average_over": ["seed"]},
        "figure": {"zoom": True},
    }
    assert config_hash({"seed": 1}) == config_hash({"seed": 1} | expected)
