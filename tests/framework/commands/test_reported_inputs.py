"""Tests for the inputs in ../shared/cases up to folder 58. `expected.md` there states the expected results."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.files.ply import read_ply
from tests.support.forked_commands import CHECKOUT, completed

pytestmark = pytest.mark.acceptance  # several seconds each
Inputs = Callable[[str], Path]
FOLDER = "dataset=rgbd_folder dataset.root=CASE"
GIVEN = "tracker=ground_truth detector=none"
SEVEN_SCENES = "dataset=seven_scenes dataset.root=CASE dataset.scene"
BOXES = f"{FOLDER}/room tracker=ground_truth detector=onnx_boxes detector.placement=stretch"
NETWORK = f"{FOLDER}/room tracker=ground_truth detector=onnx_segmentation"
STORED = f"{FOLDER}/room tracker=ground_truth detector=precomputed detector.path=CASE"
FRAMED = f"{FOLDER}/framed tracker=ground_truth detector=precomputed detector.path=CASE"


@pytest.fixture(scope="module")
def inputs(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """Return a function that writes the inputs of a case, once, and returns their directory."""
    directory = tmp_path_factory.mktemp("cases")

    def write(case: str) -> Path:
        if not (directory / case).is_dir():
            script = shared / "cases" / case / "make.py"
            environment = os.environ | {"CASES_OUT": str(directory), "PYTHONPATH": str(CHECKOUT)}
            subprocess.run([sys.executable, script], cwd=CHECKOUT, env=environment, check=True, capture_output=True)
        return directory / case

    return write


def output(command: str, case: Path, directory: Path, status: int = 0) -> str:
    """Run a command, check the exit status, and return stdout and stderr.

    Args:
        command: The arguments as in a shell. CASE is replaced by `case`, and OUT by `directory`.
        case: Directory of the inputs.
        directory: Working directory of the command. A run writes to its subdirectory `run`.
        status: Expected exit status.
    """
    words = [word.replace("CASE", str(case)).replace("OUT", str(directory)) for word in shlex.split(command)]
    if words[0] not in ("check", "import", "export"):
        words.append(f"hydra.run.dir={directory / 'run'}")
    result = completed(directory, *words)
    text = result.stdout + result.stderr
    assert result.returncode == status, text
    assert "Traceback" not in text
    return text


COMMANDS = [  # case, arguments, exit status, text in the output
    ("02", f"{BOXES} detector.layout=ssd_tensorflow detector.weights=CASE/ssd_tf_62.onnx", 0, "objects: 1 chair"),
    ("02", f"{BOXES} detector.layout=ssd_torchvision detector.weights=CASE/torchvision_62.onnx", 0, "objects: 1 chair"),
    ("02", f"{STORED}/zero_based_56.json", 0, "56 is 'broccoli', but it could be .* 'chair' by FROM_ZERO"),
    ("02", f"{STORED}/zero_based_many.json", 0, "41 is 'skateboard', but it could be .* 'cup' by FROM_ZERO"),
    ("05", "import CASE/only_color OUT/room", 1, "expected the aspect ratio of color .* record its CameraInfo"),
    ("08", f"check {SEVEN_SCENES}=png/seq-01", 0, "poses: valid.*camera from .*/png/seq-01/camera.json"),
    ("08", f"check {SEVEN_SCENES}=jpg/seq-01", 0, "valid: median error"),
    ("08", f"check {SEVEN_SCENES}=short/seq-01", 0, "valid: median error"),
    ("16", f"{FOLDER}/room tracker=trajectory_file tracker.path=CASE/nanoseconds.txt", 1, "tracker.time_unit=1e-09"),
    ("16", f"{FOLDER}/room tracker=trajectory_file tracker.path=CASE/milliseconds.txt", 1, "tracker.time_unit=0.001"),
    ("18", f"check {FOLDER}/sts", 1, "left-handed world.* set dataset.mirrored=Y"),
    ("18", "check dataset=replica_nice_slam dataset.root=CASE/replica dataset.scene=det", 1, "dataset.mirrored=WORLD"),
    ("19", f"check {FOLDER}/posed", 1, "WRONG +depth: normalized frame by frame"),
    ("19", f"check {FOLDER}/eight_bit dataset.depth_scale=13107", 1, "WRONG +depth: normalized frame by frame"),
    ("19", f"check {FOLDER}/inverse dataset.depth_scale=13107", 1, "WRONG +depth: normalized frame by frame"),
    *(("20", f"{FOLDER}/{name} {GIVEN}", 0, "4 frames") for name in ("float_tiff", "uint16_tiff", "exr", "npy")),
    *(("20", f"{FOLDER}/{name} {GIVEN}", 1, "expected a PNG with 1 channel") for name in ("rgba8", "rgb8", "gray8")),
    ("20", f"{FOLDER}/color16 {GIVEN}", 1, "expected color with 8 bits per channel, got uint16"),
    ("20", f"{FOLDER}/color_exif6 {GIVEN}", 0, "EXIF orientation 6 is not applied"),
    ("20", f"{FOLDER}/color_exif6_turned {GIVEN}", 1, "got 480x640 px with the EXIF orientation 6"),
    ("22", f"{NETWORK} detector.weights=CASE/rfdetr_seg.onnx", 0, "objects: 1 chair"),
    ("23", f"{NETWORK} detector.weights=CASE/own.onnx detector.label_space=CASE/labels.txt", 0, "objects: 1 pallet"),
    ("23", f"{STORED}/coco.json detector.label_space=CASE/labels.txt detector.category_ids=FROM_ONE", 0, "1 forklift"),
    ("30", f"check {FOLDER}/intrinsics_of_double_size", 1, "WRONG +camera: .* multiply fx, fy, cx, cy by 0.5"),
    ("30", f"{FOLDER}/intrinsics_of_double_size {GIVEN}", 0, "WARNING camera: expected a principal point"),
    ("30", f"check {FOLDER}/scale_5000", 1, "set dataset.depth_scale=1000"),
    ("30", f"{FOLDER}/poses_4x4_folder detector=none", 0, "ATE"),
    ("43", f"{FRAMED}/frame_names.json", 0, "objects: 1 chair"),
    ("44", "check dataset=tum_rgbd dataset.root=CASE/my_freiburg1_room", 0, "poses: valid.*camera from .*camera.json"),
    ("52", f"{FOLDER}/mp4_color detector=none", 1, "color: expected a folder"),
    ("52", f"{FOLDER}/large_lowdepth detector=none", 1, "expected 1920x1440 px"),
    ("52", "import CASE/stray_short_video OUT/room", 0, "6 frames; skipped 4, .*rgb.mp4"),
    ("52", "import CASE/stray_new_columns OUT/room", 0, "10 frames"),
    ("52", "import CASE/stray_no_video OUT/room", 1, "rgb.mp4"),
    ("53", "import CASE/depth_in_mm_float OUT/room", 1, "median of 979 m; set --depth-unit 0.001"),
    ("58", f"check {FOLDER}/exif3", 1, "WRONG +color: .*EXIF orientation 3"),
    ("58", f"check {FOLDER}/exif3_unposed", 1, "WRONG +color: .*EXIF orientation 3"),
]


@pytest.mark.parametrize(
    ("case", "command", "status", "text"), COMMANDS, ids=[f"{row[0]}-{row[1]}" for row in COMMANDS]
)
def test_command_for_reported_input_gives_expected_result(
    inputs: Inputs, tmp_path: Path, case: str, command: str, status: int, text: str
) -> None:
    printed = output(command, inputs(case), tmp_path, status)
    assert re.search(text, printed, re.DOTALL), printed
    if command.startswith("check"):
        assert printed.count("WRONG") == status  # consequences of an error are not reported


@pytest.mark.parametrize("kind", ["stride2", "from1"])
@pytest.mark.parametrize("form", [".json", "_masks"])
def test_detections_named_by_file_belong_to_this_file(inputs: Inputs, tmp_path: Path, kind: str, form: str) -> None:
    place = inputs("01")
    vertices = []
    for name in (kind, "plain"):
        (tmp_path / name).mkdir()
        command = f"{FOLDER}/{name} {GIVEN} detector=precomputed detector.path=CASE/{name}{form}"
        assert "objects: 1 chair" in output(command, place, tmp_path / name)
        [chair] = json.loads((tmp_path / name / "run/instances.json").read_text())
        vertices.append(chair["vertices"])
    assert vertices[0] == vertices[1]


@pytest.mark.parametrize("form", ["rect", "rect.bag"])
def test_import_of_rectified_images_uses_projection_matrix(inputs: Inputs, tmp_path: Path, form: str) -> None:
    output(f"import CASE/{form} OUT/room", inputs("04"), tmp_path)
    assert json.loads((tmp_path / "room/camera.json").read_text())["fx"] == pytest.approx(517.3, abs=0.1)


def test_import_registers_depth_by_static_transforms(inputs: Inputs, tmp_path: Path) -> None:
    assert "14 frames" in output("import CASE/tf OUT/room", inputs("05"), tmp_path)
    output(f"check {FOLDER}", tmp_path / "room", tmp_path)


@pytest.mark.parametrize(
    "scene", ["2024_01_05", "47333462_1", "1e3", "1.10", "true", "null", "007", "0x10", "on", "nan"]
)
def test_scene_name_like_number_is_text(inputs: Inputs, tmp_path: Path, scene: str) -> None:
    assert f"{scene}: " in output(f"check {FOLDER} dataset.scene={scene}", inputs("06"), tmp_path)
    output(f"check {FOLDER}/{scene}", inputs("06"), tmp_path)


def test_folders_with_special_characters_are_read_as_typed(inputs: Inputs, tmp_path: Path) -> None:
    places = sorted(inputs("07").iterdir())
    assert len(places) >= 18
    for place in places:
        printed = output(f"check dataset=rgbd_folder {shlex.quote(f'dataset.root={place}')}", place, tmp_path)
        assert f"{place.name}: " in printed


def test_bag_times_match_external_trajectory(inputs: Inputs, tmp_path: Path) -> None:
    place = inputs("10")
    output("import CASE/bag OUT/room", place, tmp_path)
    trajectory = f"tracker=trajectory_file tracker.path={place / 'traj.txt'}"
    assert "14 frames" in output(f"{FOLDER} {trajectory} detector=none", tmp_path / "room", tmp_path)


@pytest.mark.parametrize(
    ("case", "name"),
    [
        ("11", "bag"),
        ("15", "raw.db3"),
        ("15", "compressed_same_topic.db3"),
        ("15", "compressed_transport_topics.db3"),
        ("53", "robot"),
    ],
)
def test_imported_bag_is_valid(inputs: Inputs, tmp_path: Path, case: str, name: str) -> None:
    assert "14 frames" in output(f"import CASE/{name} OUT/room", inputs(case), tmp_path)
    assert "WRONG" not in output(f"check {FOLDER}", tmp_path / "room", tmp_path)


def test_console_script_finds_plugin_in_working_directory(inputs: Inputs) -> None:
    place = inputs("27")
    program = Path(sys.executable).with_name("instancemap")
    words = ("--config-dir", "my_conf", "detector=color_blobs", "dataset=desk", "dataset.stop=4", "hydra.run.dir=run")
    subprocess.run([program, *words], cwd=place, check=True, capture_output=True)
    assert (place / "run/metrics.json").exists()


def test_sweep_over_lists_names_folders_without_backslash(inputs: Inputs) -> None:
    place = inputs("28")
    sweep = ("--config-dir", "my_conf", "-m", "detector=lists", "detector.words=[mug,red chair],[cup]")
    program = Path(sys.executable).with_name("instancemap")
    words = (*sweep, "dataset=desk", "dataset.stop=2", "hydra.sweep.dir=sweep")
    subprocess.run([program, *words], cwd=place, check=True, capture_output=True)
    runs = sorted(path.parent.name for path in place.glob("sweep/*/metrics.json"))
    assert len(runs) == 2
    assert not any("\\" in name for name in runs)


def test_exports_far_from_origin_stay_on_the_mesh(inputs: Inputs, tmp_path: Path) -> None:
    place = inputs("29")
    output(f"{FOLDER}/far {GIVEN} detector=precomputed detector.path=CASE/d.json", place, tmp_path)
    output("export OUT/run --to ply", place, tmp_path)
    exported, mesh = (read_ply(tmp_path / "run" / name).vertices for name in ("export/scene.ply", "mesh.ply"))
    for corner in (np.min, np.max):
        assert np.allclose(corner(exported, axis=0)[:2], corner(mesh, axis=0)[:2], atol=0.05)
