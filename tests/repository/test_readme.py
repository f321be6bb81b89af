"""Tests that the commands and examples in the README and in docs/ work."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from framework.api import load_map
from framework.config import composition
from framework.config.text_values import literal
from framework.data import Camera, Frame
from framework.files.search_paths import CONF
from framework.interfaces import Detector
from framework.pipeline import Pipeline
from framework.registry import STAGES, build, text_kind
from framework.runs.mesh_file import read_mesh
from tests.support import stored_experiments
from tests.support.doc_pages import CHECKOUT, LINES, block, blocks
from tests.support.recordings.phone_exports import room_frames, write_stray_scanner

pytestmark = pytest.mark.integration

COMMANDS = {  # main config of each command
    line: "config" if "=" in words[3] or words[3] == "-m" else words[3].replace("-", "_")
    for line in LINES
    if (words := line.split())[:3] == ["python", "-m", "framework"]
    and ("=" in words[3] or words[3] == "-m" or (CONF / f"{words[3].replace('-', '_')}.yaml").exists())
}
BENCHMARKS = [line for line in LINES if line.startswith("python -m pytest ")]


def test_documented_data_frame_has_means_of_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stored_experiments.experiment(tmp_path / "outputs" / "ablation_refiner", {"chain": [0.5, 0.7], "identity": [0.25]})
    monkeypatch.chdir(tmp_path)
    exec(block("python", 'load_runs("outputs/ablation_refiner'), {})
    chain, identity = capsys.readouterr().out.splitlines()[-2:]
    assert chain.split()[:3] == ["chain", "0.60", "0.141421"]
    assert identity.split()[:2] == ["identity", "0.25"]


def test_contributing_paths_exist() -> None:
    tour = (CHECKOUT / "CONTRIBUTING.md").read_text()
    named = re.findall(r"`((?:framework|plugins|tests|conf)/[\w/]+\.py)`", tour)
    assert len(named) > 15
    assert not [path for path in named if not (CHECKOUT / path).exists()]
    assert all(hasattr(Pipeline, step) for step in ("read_and_detect", "map_frame"))


@pytest.fixture
def my_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the detector of the tutorial to the path in the documentation."""
    (tmp_path / "my_plugins").mkdir()
    (tmp_path / "my_plugins" / "color_blobs.py").write_text(block("python", "class ColorBlobs"))
    (tmp_path / "my_conf" / "detector").mkdir(parents=True)
    (tmp_path / "my_conf" / "detector" / "color_blobs.yaml").write_text(block("yaml", "color_blobs.ColorBlobs"))
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    return tmp_path


def test_tutorial_detector_detects_red_square(my_plugins: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    node = OmegaConf.load(my_plugins / "my_conf" / "detector" / "color_blobs.yaml")
    monkeypatch.setattr(composition, "_added", [my_plugins / "my_conf"])
    detector = build(Detector, OmegaConf.create({"detector": node}).detector)
    camera = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
    color = np.full((48, 64, 3), 200, np.uint8)
    color[10:30, 5:25] = (220, 20, 30)  # a red square
    color[35:40, 40:45] = (220, 20, 30)  # a red square that is too small
    color[10:30, 40:60] = (20, 220, 30)  # a green square
    found = detector.detect(Frame(0, 0.0, color, np.ones((48, 64), np.float32), camera))
    assert len(found) == 1
    np.testing.assert_array_equal(found.boxes, [[5, 10, 24, 29]])
    assert found.masks[0].sum() == 400
    assert found.masks[0, 10:30, 5:25].all()
    assert found.classes[0] == "cup"
    blank = Frame(0, 0.0, np.zeros_like(color), np.ones((48, 64), np.float32), camera)
    assert len(detector.detect(blank)) == 0


def test_tutorial_detector_runs_by_option_name(my_plugins: Path) -> None:
    """The command is the one in the tutorial. The other stages are fakes, which are faster."""
    chosen = [f"{stage}=fake" for stage in FAKES]
    (my_plugins / "my_conf").joinpath("dataset").mkdir()
    for stage, name in FAKES.items():
        group = my_plugins / "my_conf" / stage
        group.mkdir(exist_ok=True)
        (group / "fake.yaml").write_text(f"_target_: tests.support.scenes.corner_room.{name}\n")
    assert OWN_PLUGIN in LINES
    done = subprocess.run(
        [sys.executable, *OWN_PLUGIN.split()[1:], *chosen, "hydra.run.dir=run"],
        cwd=my_plugins,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": f"{CHECKOUT}:{my_plugins}", "HOME": str(my_plugins)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert (my_plugins / "run" / "metrics.json").exists()


OWN_PLUGIN = "python -m framework --config-dir my_conf detector=color_blobs detector.hue=220"
FAKES = {"dataset": "CornerRoom", "tracker": "GivenPose", "refiner": "KeepAll", "fuser": "GridFuser"}


@pytest.mark.parametrize("command", COMMANDS)
def test_documented_command_composes(command: str) -> None:
    overrides = [word for word in shlex.split(command)[3:] if "=" in word]
    if "hydra/sweeper=optuna" in overrides:
        pytest.importorskip(
            "hydra_plugins.hydra_optuna_sweeper", reason="requires hydra-optuna-sweeper (extra sweepers)"
        )
    choices = [override.split("=")[1].split(",") for override in overrides if override.split("=")[0] in STAGES]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for k in range(max(map(len, choices), default=1)):
            compose(
                COMMANDS[command],
                overrides=literal(
                    [re.sub(r"=.*", f"={_kth(override, k)}", override) for override in overrides], text_kind
                ),
            )


# example that writes a recording and reads the outputs of a run
OWN_DATA = blocks("python", "docs/tutorials/own_data.md")
SMALL = ["dataset.frames=4", "dataset.width=160", "dataset.height=120"]
OWN = ["dataset=rgbd_folder", "dataset.root=DIR"]  # the imported recording
DEFAULTS = "python -m framework"
RUNNABLE = {  # arguments that reduce the run time of each command to seconds
    # 320x240 px, because tracking of the noisy room fails at 160x120 px
    DEFAULTS: [*SMALL, "dataset=synthetic", "dataset.width=320", "dataset.height=240", "hydra.run.dir=defaults"],
    "python -m framework import SOURCE DIR": [],
    "python -m framework check dataset=rgbd_folder dataset.root=DIR": [],
    "python -m framework dataset=rgbd_folder dataset.root=DIR": ["hydra.run.dir=imported"],
    "python -m framework hydra.run.dir=outputs/demo": ["dataset=synthetic", "detector=simulated", *SMALL],
    "python -m framework report outputs/demo": [],
    "python -m framework dataset=synthetic detector=simulated": [*SMALL, "hydra.run.dir=outputs/synthetic"],
    "python -m framework tracker=ground_truth fuser.voxel_size=0.02": [*OWN, "hydra.run.dir=coarse"],
    "python -m framework -m refiner=identity,kmeans,gmm_em": [*OWN, "hydra.sweep.dir=outputs/table3_map"],
    "python -m framework check dataset=rgbd_folder dataset.root=my_room": [],
    "python -m framework dataset=rgbd_folder dataset.root=my_room hydra.run.dir=outputs/my_room": [
        "dataset.stop=6",
        "fuser.voxel_size=0.04",
    ],
    "python -m framework detection_cache=read_write refiner=kmeans": [*OWN, "hydra.run.dir=cached"],
    "python -m framework detect dataset=synthetic detector=simulated out=detections.json": SMALL,
    "python -m framework show-refinement dataset=synthetic detector=simulated frame=24 out=refinement.png": [
        *SMALL,
        "frame=1",
    ],
    "python -m framework dataset=rgbd_folder dataset.root=DIR tracker=trajectory_file tracker.path=FILE": [
        "hydra.run.dir=own"
    ],
    "python -m framework dataset=rgbd_folder dataset.root=DIR dataset.odometry=FILE": ["hydra.run.dir=with_odometry"],
    "python -m framework tables outputs/table3_map": [],  # folder of the sweep above
    "python -m framework evaluate outputs/table3_map": [],
    "python -m framework export outputs/demo --to glb usd ply obj": [],
    "python -m framework export outputs/demo --to floorplan graph --robot-height 0.5": [],
    "python -m framework plugins": [],
    "python -m framework plugins detector": [],
    "python -m framework new-plugin refiner my_refiner": [],
}
COPY_POSES = "open('FILE', 'w').write(open('DIR/poses.txt').read())"
EXPECTED_FILES = [
    "detections.json",
    "refinement.png",
    "instancemap-my-refiner/pyproject.toml",
    *(f"{run}/metrics.json" for run in ("outputs/demo", "imported", "coarse", "own", "with_odometry")),
    *(f"outputs/demo/export/{name}" for name in ("scene.glb", "scene.usdc", "map.yaml", "scene_graph.json")),
]
RUN = """
import json, sys
from framework.__main__ import main
for line in json.load(open("commands.json")):
    print(">>>", line, flush=True)
    if isinstance(line, str):
        exec(line, {})
    else:
        sys.argv = ["instancemap", *line]
        main()
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run all commands in one process, which loads the libraries only once, and return the folder."""
    folder = tmp_path_factory.mktemp("readme")
    write_stray_scanner(folder / "SOURCE", room_frames(6))
    recording, result = OWN_DATA
    commands = [shlex.split(command)[3:] + small for command, small in RUNNABLE.items()]
    lines = [recording, commands[1], COPY_POSES, commands[0], *commands[2:], result]
    (folder / "commands.json").write_text(json.dumps(lines))
    done = subprocess.run(
        [sys.executable, "-c", RUN],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(CHECKOUT), "XDG_CACHE_HOME": str(folder), "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return folder


def test_documented_commands_write_expected_files(ran: Path) -> None:
    assert set(RUNNABLE) - {DEFAULTS} <= set(LINES)
    assert not [name for name in EXPECTED_FILES if not (ran / name).exists()]
    assert len(list((ran / "outputs" / "table3_map").glob("*/metrics.json"))) == 3
    assert list(ran.glob("instancemap/detections/*/*.detections"))
    assert (ran / "outputs" / "check.png").exists()


def test_default_pipeline_runs_end_to_end(ran: Path) -> None:
    """The included network, tracking, all refiners and fusion process four small frames."""
    metrics = json.loads((ran / "defaults" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["frames_lost"], metrics["frames_skipped"]) == (4, 0, 0)
    assert metrics["pose_source"] == "tracked"
    assert metrics["trajectory.ate_rmse_m"] < 0.02
    mesh = read_mesh(ran / "defaults" / "mesh.ply")
    assert len(mesh.vertices) > 1000
    assert load_map(ran / "defaults" / "map.npz").scene.statistics.voxels == metrics["map.voxels"] > 0


@pytest.mark.parametrize("command", BENCHMARKS)
def test_documented_benchmark_exists(command: str) -> None:
    folder, _, keyword = command.split()[3:]
    tests = [
        f"{path.stem}::{name}"
        for path in (CHECKOUT / folder).glob("test_*.py")
        for name in re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)
    ]
    assert any(keyword in test for test in tests)


def _kth(override: str, k: int) -> str:
    value = override.split("=")[1]
    if value.startswith("interval("):
        return value.removeprefix("interval(").split(",")[0]
    if value.startswith("'"):
        return value
    values = value.split(",")
    return values[k % len(values)]
