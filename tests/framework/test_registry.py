"""Tests for the registry, which builds plugins from config nodes."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np
import pytest
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from framework.config import composition
from framework.config.composition import add_config_dir
from framework.config.validation import check_bounds
from framework.data import Detections, Frame
from framework.errors import ConfigError, DataError
from framework.files.search_paths import CONF
from framework.interfaces import Detector, PoseTracker, RGBDSequence, RGBDVideo
from framework.registry import GROUPS, STAGES, assemble, build, find_class, parameter_fields, rebuilt

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[2]
HERE = "build_targets"


class Storage(Enum):
    exact = 1
    compact = 2


@dataclass
class Probe(Detector):
    weights: Path
    threshold: float = 0.5
    limit: int = 10
    storage: Storage = Storage.exact
    name: str | None = None

    def __post_init__(self) -> None:
        self.classes = ("chair",)
        if not 0 <= self.threshold <= 1:
            raise ConfigError(f"threshold: expected a value in [0, 1], got {self.threshold}")
        if self.name == "absent":
            raise DataError(f"{self.weights} is not there")
        if self.name == "broken":
            raise ImportError("No module named 'onnxruntime'; install instancemap[onnx]")

    def detect(self, frame: Frame) -> Detections:
        return Detections.none(frame.camera.shape, self.classes)


class Undecorated(Probe):
    pass


@dataclass
class Abstract(Detector):
    pass


@dataclass
class Suppression:
    """Part whose parameters are shared by several plugins."""

    nms: float = 0.5
    agnostic: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, nms=(0.0, 1.0))


@dataclass
class Assembled(Probe):
    suppression: Suppression = field(default_factory=Suppression)
    size: int = 3


@dataclass
class Ambiguous(Probe):
    nms: float = 0.5
    suppression: Suppression = field(default_factory=Suppression)


@dataclass
class OddField(Probe):
    table: np.ndarray | None = None


def some_function() -> None:
    raise AssertionError("a config must not be able to call this")


REGISTERED = ("Probe", "Undecorated", "Abstract", "Assembled", "Ambiguous", "OddField", "some_function", "Path", "Prob")


def register(monkeypatch: pytest.MonkeyPatch, folder: Path, stage: str, *targets: str) -> None:
    """Register an option for each target, like the option --config-dir."""
    (folder / stage).mkdir(exist_ok=True)
    for target in targets:
        (folder / stage / f"{target.replace('.', '_').lower()}.yaml").write_text(f"_target_: {target}\n")
    monkeypatch.setattr(composition, "_added", [])
    add_config_dir(folder)


@pytest.fixture(autouse=True)
def importable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Import this module under a fixed name and register its classes."""
    monkeypatch.setitem(sys.modules, HERE, sys.modules[__name__])
    others = ("framework.interfaces.Detector", "framework.interface.Detector", "os.system", "nowhere.at.All", "Probe")
    register(monkeypatch, tmp_path, "detector", *(f"{HERE}.{name}" for name in REGISTERED), *others)


def detector(**parameters: object) -> Detector:
    node = {"_target_": f"{HERE}.Probe", "weights": "w.bin", **parameters}
    return build(Detector, OmegaConf.create({"detector": node, "seed": 7, "limit": 3})["detector"])


def fault(**parameters: object) -> str:
    with pytest.raises(ConfigError) as caught:
        detector(**parameters)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith("detector")
    return message


def test_build_converts_parameters_to_field_types() -> None:
    built = detector(threshold=1, storage="compact", limit="${limit}", name=3)
    assert built == Probe(Path("w.bin"), 1.0, 3, Storage.compact, "3")
    assert isinstance(built, Probe)
    assert isinstance(built.weights, Path)
    assert isinstance(built.threshold, float)


def test_build_uses_class_defaults_for_missing_parameters() -> None:
    assert detector() == Probe(Path("w.bin"))


def test_build_flattens_parameters_of_parts() -> None:
    expected = Assembled(Path("w.bin"), limit=4, suppression=Suppression(nms=0.25), size=5)
    assert detector(_target_=f"{HERE}.Assembled", limit=4, nms=0.25, size=5) == expected
    assert assemble(Assembled, weights=Path("w.bin"), limit=4, nms=0.25, size=5) == expected
    assert list(parameter_fields(Assembled))[-3:] == ["nms", "agnostic", "size"]
    with pytest.raises(TypeError, match="agnostik"):
        assemble(Assembled, weights=Path("w.bin"), agnostik=True)


def test_rebuilt_plugin_has_parameters_without_state() -> None:
    used = Assembled(Path("w.bin"), limit=4, suppression=Suppression(nms=0.25), size=5)
    used.suppression.seen = used.seen = True  # type: ignore[attr-defined]
    copy = rebuilt(used)
    assert copy == used
    assert not hasattr(copy, "seen")
    assert not hasattr(copy.suppression, "seen")


@pytest.mark.parametrize(
    ("parameters", "output"),
    [
        ({"threshold": "high"}, ["Probe", "threshold: expected a number, got 'high'"]),
        ({"threshold": 10**400}, ["threshold: expected a number, got 1000"]),
        ({"limit": 2.5}, ["limit: expected an integer, got 2.5"]),
        ({"limit": None}, ["limit: expected an integer, got None"]),
        ({"storage": "exakt"}, ["storage: expected one of exact, compact, got 'exakt'"]),
        ({"treshold": 0.2}, ["expected a known parameter", "did you mean 'threshold'?"]),
        ({"zzz": 0.2}, ["got 'zzz'", "expected one of weights, threshold, limit, storage, name"]),
        ({"weights": "???"}, ["expected a value for weights", "set detector.weights=..."]),
        ({"limit": "${nowhere}"}, ["limit", "nowhere"]),
        ({"threshold": 2.0}, ["threshold: expected a value in [0, 1], got 2.0"]),
        ({"name": "broken"}, ["install instancemap[onnx]"]),
        ({"_target_": f"{HERE}.Undecorated"}, ["@dataclass"]),
        (
            {"_target_": f"{HERE}.Abstract"},
            ["expected all methods of Detector in Abstract, got none for: detect; implement them"],
        ),
        ({"_partial_": True}, ["got '_partial_'"]),
        ({"_target_": f"{HERE}.OddField"}, ["bool, int, float, str, Path, Enum or list", "got numpy.ndarray | None"]),
        ({"_target_": f"{HERE}.Assembled", "nms": 2}, ["detector.nms: expected a value in [0, 1], got 2"]),
        ({"_target_": f"{HERE}.Assembled", "nms": "high"}, ["Assembled: nms: expected a number, got 'high'"]),
        ({"_target_": f"{HERE}.Assembled", "suppression": {"nms": 0.1}}, ["got 'suppression'"]),
        ({"_target_": f"{HERE}.Assembled", "agnostik": True}, ["did you mean 'agnostic'?"]),
        ({"_target_": f"{HERE}.Ambiguous"}, ["Ambiguous: expected unique parameter names, got nms twice"]),
        ({"_target_": f"{HERE}.Prob"}, ["got Prob", "did you mean 'Probe'?"]),
        ({"_target_": f"{HERE}.some_function"}, ["implements Detector", "got a function"]),
        ({"_target_": f"{HERE}.Path"}, ["implements Detector", "got the class Path"]),
        ({"_target_": "os.system"}, ["implements Detector"]),
        ({"_target_": "framework.interfaces.Detector"}, ["implements Detector"]),
        (
            {"_target_": "framework.interface.Detector"},
            ["expected an existing module, got framework.interface", "did you mean 'interfaces'?"],
        ),
        ({"_target_": "nowhere.at.All"}, ["expected an existing module, got nowhere"]),
        ({"_target_": "Probe"}, ["package.module.Class"]),
        ({"_target_": ""}, ["_target_"]),
        ({"_target_": None}, ["_target_"]),
    ],
    ids=str,
)
def test_build_invalid_parameters_raise_one_line_error(parameters: dict[str, object], output: list[str]) -> None:
    message = fault(**parameters)
    for words in output:
        assert words in message


def test_build_plugin_error_keeps_type_and_adds_name() -> None:
    with pytest.raises(DataError, match=r"detector build_targets\.Probe: w\.bin is not there"):
        detector(name="absent")


def test_build_missing_choice_raises() -> None:
    with pytest.raises(ConfigError, match="choose detector=NAME"):
        build(Detector, OmegaConf.create({"detector": None})["detector"])


def test_find_class_import_failure_raises_one_line_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    tracker = "class Tracker: pass\n"
    (tmp_path / "needs_more.py").write_text(f"import surely_not_installed\n{tracker}")
    failing = "raise RuntimeError('operator torchvision::nms does not exist\\nmore')\n"
    (tmp_path / "raises.py").write_text(failing + tracker)
    with pytest.raises(ConfigError, match=r".* expected an installed package 'surely_not_installed', got none"):
        find_class(PoseTracker, "needs_more.Tracker")
    with pytest.raises(
        ConfigError,
        match=r"raises: expected an importable module, got an error \(RuntimeError: operator .* does not exist\)$",
    ):
        find_class(PoseTracker, "raises.Tracker")


@pytest.fixture
def printing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a package and a module that print when they are imported. Both have the class Named."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "printing").mkdir()
    (tmp_path / "printing" / "__init__.py").write_text("print('imported')\n")
    (tmp_path / "printing" / "one.py").write_text("print('imported')\nclass Named: pass\n")


@pytest.mark.parametrize("hydra_runs", [True, False])
@pytest.mark.parametrize(
    ("target", "output"),
    [
        ("plugins.detectors.none.NoDetection", "did you mean 'plugins.detectors.none.NoDetections'?"),
        (
            "plugins.trackers.ground_truth.GroundTruth",
            "expected the _target_ of a registered option of",
        ),  # a plugin of another stage
        ("printing.one.Named", "expected the _target_ of a registered option of"),
        ("os.system", "expected the _target_ of a registered option of"),
        ("this.X", "expected the _target_ of a registered option of"),
    ],
)
@pytest.mark.usefixtures("printing")
def test_build_does_not_import_unregistered_target(
    target: str, output: str, hydra_runs: bool, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Registered options are also found in Hydra applications, and in stored configs without Hydra."""
    monkeypatch.setattr(composition, "_added", [])
    with initialize_config_dir(str(CONF), version_base="1.3") if hydra_runs else nullcontext():
        assert output in fault(_target_=target)
        assert build(Detector, OmegaConf.create({"_target_": "plugins.detectors.none.NoDetections"})).classes
    assert not {"this", "printing", "printing.one"} & set(sys.modules)
    assert capfd.readouterr() == ("", "")


def test_build_inside_hydra_application_ignores_its_options(tmp_path: Path) -> None:
    with initialize_config_dir(str(tmp_path), version_base="1.3"):
        assert detector() == Probe(Path("w.bin"))


def test_registry_reports_conflicting_plugins_package(tmp_path: Path) -> None:
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "__init__.py").write_text("print('imported')\n")
    line = [sys.executable, "-m", "framework", "plugins"]
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{CHECKOUT}"}
    done = subprocess.run(line, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    output = f"plugins: expected InstanceMap's package at {CHECKOUT}/plugins, got {tmp_path}/plugins"
    assert f"{output}; rename the other package or start Python in another folder" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "imported" not in done.stdout


def test_registry_has_interface_for_each_stage() -> None:
    assert list(STAGES) == ["dataset", "detector", "masking", "tracker", "refiner", "fuser", "backend"]
    assert list(GROUPS) == [*STAGES, "viewer"]


def test_find_class_wrong_video_kind_raises() -> None:
    """Commands such as `check` require random access to the frames. A run also accepts live video."""
    live = "tests.support.scenes.corner_room.LiveRoom"
    assert find_class(RGBDVideo, live).__name__ == "LiveRoom"
    with pytest.raises(ConfigError, match=r"LiveRoom: expected a subclass of RGBDSequence "):
        find_class(RGBDSequence, live)
