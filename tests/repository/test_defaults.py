"""Tests for the default detector of each dataset.

The files of all defaults must be part of the project.
"""

from __future__ import annotations

import hashlib
import re
import zipfile
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig

from framework.config.composition import composed
from framework.files.search_paths import CONF, PROJECT_ROOT
from framework.registry import GROUPS, STAGES
from framework.reporting.markup import SCRIPTS, STYLE
from plugins.detectors.maskrcnn2go import SHA256, MaskRCNN2Go
from tests.support import registered

pytestmark = pytest.mark.integration

DESK = PROJECT_ROOT / "data" / "desk"
WEIGHTS = Path("plugins/detectors/maskrcnn2go_int8")
EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
OF_RENDERED_ROOMS = {"synthetic", "synthetic_building"}
TIMED = {"table1_runtime", "figure3_stage_times", "ablation_detection_interval"}


def chosen(*overrides: str, main: str = "config") -> dict[str, str]:
    """Return the dataset and the detector that Hydra chooses. The composed config must have the same detector."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config: DictConfig = compose(main, [*overrides], return_hydra_config=True)
    choices = {stage: str(config.hydra.runtime.choices[stage]) for stage in ("dataset", "detector")}
    node = registered.composed("detector", choices["detector"]).detector
    assert (config.detector._target_, config.detector.get("weights")) == (node._target_, node.get("weights"))
    return choices


@pytest.mark.parametrize("main", ["config", "detect", "show_refinement"])
@pytest.mark.parametrize("dataset", registered.names("dataset"))
def test_default_detector_depends_on_dataset(dataset: str, main: str) -> None:
    expected = "mask_rcnn_rooms" if dataset in OF_RENDERED_ROOMS else "maskrcnn2go"
    assert chosen(f"dataset={dataset}", main=main)["detector"] == expected


@pytest.mark.parametrize("dataset", ["synthetic", "rgbd_folder"])
@pytest.mark.parametrize("detector", ["none", "maskrcnn2go", "mask_rcnn_rooms"])
def test_default_detector_is_overridden_by_explicit_detector(dataset: str, detector: str) -> None:
    for order in ([0, 1], [1, 0]):
        words = [f"dataset={dataset}", f"detector={detector}"]
        assert chosen(*(words[k] for k in order))["detector"] == detector


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_sets_its_detector(experiment: str) -> None:
    expected = "mask_rcnn_rooms" if experiment in TIMED else "simulated_yolo11n"
    assert chosen(f"experiment={experiment}")["detector"] == expected


@pytest.mark.parametrize("experiment", ["table1_runtime", "ablation_fuser"])
def test_experiment_detector_overrides_dataset_not_command_line(experiment: str) -> None:
    expected = chosen(f"experiment={experiment}")["detector"]
    assert chosen(f"experiment={experiment}", "dataset=synthetic")["detector"] == expected
    assert chosen(f"experiment={experiment}", "detector=none")["detector"] == "none"


def test_default_detector_of_external_dataset_is_set(tmp_path: Path) -> None:
    """A dataset that inherits from dataset=synthetic also inherits the detector."""
    (tmp_path / "dataset").mkdir()
    (tmp_path / "dataset" / "theirs.yaml").write_text("_target_: theirs.Theirs\n")
    (tmp_path / "dataset" / "their_rooms.yaml").write_text("defaults: [synthetic, _self_]\nframes: 3\n")
    path = f"hydra.searchpath=[file://{tmp_path}]"
    assert chosen(path, "dataset=theirs")["detector"] == "maskrcnn2go"
    assert chosen(path, "dataset=their_rooms")["detector"] == "mask_rcnn_rooms"
    assert chosen(path, "dataset=their_rooms", "detector=none")["detector"] == "none"


def test_default_dataset_is_desk() -> None:
    assert chosen() == {"dataset": "desk", "detector": "maskrcnn2go"}


def test_default_detector_without_dataset_is_maskrcnn2go() -> None:
    assert composed("~dataset").detector == registered.composed("detector", "maskrcnn2go").detector


def test_default_detector_depends_on_dataset_of_sweep_job() -> None:
    """A launcher composes each job from the config of the sweep and the overrides of the job."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        sweep = loader.load_configuration("config", ["dataset=synthetic,rgbd_folder"], RunMode.MULTIRUN)
        jobs = [loader.load_sweep_config(sweep, [f"dataset={name}"]) for name in ("synthetic", "rgbd_folder")]
    assert [job.hydra.runtime.choices.detector for job in jobs] == ["mask_rcnn_rooms", "maskrcnn2go"]
    assert [job.detector.weights for job in jobs] == ["plugins/detectors/mask_rcnn_rooms.safetensors", str(WEIGHTS)]


def test_default_paths_are_inside_project() -> None:
    """All paths in YAML files must exist in the project."""
    files = sorted(CONF.rglob("*.yaml"))
    assert len(files) > 60
    assert not [file for file in files if "../" in file.read_text()]
    named = [path for file in files for path in re.findall(r"(?m)^\w+: ((?:plugins|data)/[\w./-]+)", file.read_text())]
    assert {str(WEIGHTS), "plugins/detectors/mask_rcnn_rooms.safetensors"} <= set(named)
    assert not [path for path in named if not (PROJECT_ROOT / path).exists()]


def test_bundled_weights_match_published_checksums() -> None:
    folder = PROJECT_ROOT / WEIGHTS
    assert MaskRCNN2Go(device="cpu").weights == WEIGHTS
    card = (PROJECT_ROOT / "plugins" / "detectors" / "maskrcnn2go.md").read_text()
    for name, expected in SHA256.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == expected
        assert f"| `{name}` | `{expected}` |" in card
    assert "Apache License" in (folder / "LICENSE").read_text()
    assert {path.name for path in folder.iterdir()} == {*SHA256, "LICENSE"}


def test_wheel_contains_networks_configs_and_assets(tmp_path: Path) -> None:
    wheel = pytest.importorskip("hatchling.builders.wheel", reason="hatchling is missing: pip install --group test")
    [built] = wheel.WheelBuilder(str(PROJECT_ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(built) as archive:
        names = set(archive.namelist())
        for name, expected in SHA256.items():
            assert hashlib.sha256(archive.read(f"{WEIGHTS}/{name}")).hexdigest() == expected
    assert {f"{WEIGHTS}/LICENSE", "plugins/detectors/maskrcnn2go.md", "framework/conf/config.yaml"} <= names
    assert {f"framework/desk/{path.relative_to(DESK)}" for path in DESK.rglob("*") if path.is_file()} <= names
    assert any(name.endswith(f"licenses/{WEIGHTS}/LICENSE") for name in names)
    assert "plugins/detectors/mask_rcnn_rooms.safetensors" in names
    assert {f"framework/reporting/assets/{name}" for name in (*SCRIPTS, STYLE, "three.LICENSE")} <= names
    assert {f"framework/reporting/templates/{name}.html" for name in ("page", "parts", "run", "comparison")} <= names
    assert any(name.endswith("licenses/framework/reporting/assets/three.LICENSE") for name in names)
    assert not [name for name in names if "viewer_source" in name]
    assert not GROUPS.keys() - {name.split("/")[2] for name in names if name.startswith("framework/conf/")}
    assert not {f"framework/templates/{stage}/plugin.py.template" for stage in STAGES} - names
    assert not [name for name in names if name.startswith(("examples", "tests"))]
