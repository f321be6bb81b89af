"""Tests for recordings of rerun."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import urlopen

import cv2
import numpy as np
import pytest

from framework.api import Mapper
from framework.data import Frame, InstanceMesh, Pose
from framework.errors import ConfigError, FrameError
from framework.geometry import exp_se3
from framework.interfaces import SceneMap
from framework.live_view import rerun_program
from framework.live_view.drawing_thread import FrameNote, MapSnapshot
from framework.live_view.rerun_drawing import RerunDrawing, turned
from framework.live_view.rerun_layout import EYE_ABOVE, EYE_BACK, STAGE_COLORS
from framework.live_view.rerun_program import free_port
from framework.pipeline import Pipeline
from framework.registry import assemble
from framework.runtime.run_log import STAGES as STAGE_NAMES
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.viewers.rerun import RECORDING, Mode, RerunViewer
from tests.support import registered
from tests.support.scenes.corner_room import CAMERA, CornerRoom, GivenPose, KeepAll, SphereDetector, pose_at
from tests.support.scenes.given_changes import GivenChanges, RoomTracker, SubmapFuser

pytest.importorskip("rerun", reason="requires rerun-sdk (extra viewer)")
import rerun as rr
from pyarrow.types import is_temporal
from rerun.chunk import RrdReader

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
STAGES = ("detector=ground_truth", "tracker=ground_truth", "refiner=identity", "fuser.voxel_size=0.04")
FAKES = [f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser")]
PATIENCE_S = 120


class GetsLost(GivenPose):
    """Tracker that is lost in frame 4."""

    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        pose = super().track(frame, scene)
        return Pose(pose.T_world_camera, lost=True, reason="too dark") if frame.index == 4 else pose


def pipeline(viewer: RerunViewer, **stages: Any) -> Pipeline:
    fuser = assemble(BayesianTsdf, voxel_size=0.04, min_observations=1)
    stages = {"detector": SphereDetector(), "tracker": GetsLost(), "refiner": KeepAll(), "fuser": fuser} | stages
    return Pipeline(**stages, viewer=viewer)


def rows(file: Path, entity: str) -> Iterator[dict[str, Any]]:
    """Yield the rows of an entity: the values by column, and the times, ns, by timeline."""
    for chunk in RrdReader(file).stream():
        if chunk.entity_path == f"/{entity}" and not chunk.is_static:
            batch = chunk.to_record_batch()
            columns = {
                name: column.cast("int64") if is_temporal(column.type) else column
                for name, column in zip(batch.schema.names, batch.columns, strict=True)
            }
            for k in range(batch.num_rows):
                yield {name: column[k].as_py() for name, column in columns.items()}


def fixed(file: Path) -> Path:
    """Write the complete messages to a new file and return the file, because `RrdReader` rejects a truncated file."""
    whole = file.with_name("whole.rrd")
    rrd("merge", file, "-o", str(whole))
    return whole


def rrd(command: str, file: Path, *options: str) -> None:
    line = [sys.executable, "-m", "rerun", "rrd", command, str(file), *options]
    home = os.environ | {"HOME": str(file.parent)}  # rerun writes settings to HOME
    done = subprocess.run(line, capture_output=True, text=True, timeout=PATIENCE_S, env=home)
    assert done.returncode == 0, done.stderr


def entities(file: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(file).stream()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of six frames. Frame 2 is unreadable, and frame 4 is lost."""
    directory = tmp_path_factory.mktemp("run")
    viewer = RerunViewer(frame_interval=1, stride=1, mesh_interval=0.1, min_probability=0.0, min_score=0.1)
    pipeline(viewer).run_to_any_end(CornerRoom(unreadable=2), directory)
    return directory / "recording.rrd"


def stages_timed(milliseconds: Sequence[float]) -> list[str]:
    """Return the stages with a finite time. `milliseconds` has one value for each stage in the legend."""
    return [stage for stage, time in zip(STAGE_COLORS, milliseconds, strict=True) if np.isfinite(time)]


def test_rerun_recording_is_valid_and_has_blueprint(recorded: Path) -> None:
    rrd("verify", recorded)
    assert len(RrdReader(recorded).blueprints()) >= 1


def test_rerun_viewpoint_follows_the_estimated_up_direction(tmp_path: Path) -> None:
    """The first camera looks down, so that its up direction differs from that of the map."""
    up, file = np.array([0.0, -1.0, 0.0]), tmp_path / RECORDING
    T_world_camera = exp_se3(np.array([0.3, -1.2, 0.1, -0.7, 0.2, 0.0]))
    recording = rr.RecordingStream("test", recording_id="test")
    recording.save(file)
    drawing = RerunDrawing(recording, stride=1, jpeg_quality=75, region=1.0, min_probability=0.5, min_score=0.5)
    empty = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8)
    mesh = InstanceMesh(*empty, np.zeros(0, np.int32), np.zeros(0, np.int32), ("chair",))
    drawing.draw_frames([FrameNote(0, 0.0, Pose(T_world_camera), {})], [], None)
    for estimate in (None, up, up):
        drawing.draw_map(MapSnapshot(0, 0.0, mesh, {}, estimate))
    drawing.close()
    reader, positions = RrdReader(file), []
    for store in reader.blueprints():
        batches = [chunk.to_record_batch().to_pydict() for chunk in reader.stream(store=store)]
        positions += [batch["EyeControls3D:position"][0][0] for batch in batches if "EyeControls3D:position" in batch]
    expected = []
    for drawn in (-T_world_camera[:3, 1], up):
        first = turned(drawn, T_world_camera[:3, 2]) @ T_world_camera[:3]
        expected.append((first[:, 3] - EYE_BACK * first[:, 2] + [0, 0, EYE_ABOVE]).tolist())
    np.testing.assert_allclose(sorted(positions), sorted(expected), atol=1e-5)  # blueprints have no order


def test_rerun_stage_times_cover_only_completed_stages(recorded: Path) -> None:
    times = {row["frame"]: row["Scalars:scalars"] for row in rows(recorded, "milliseconds")}
    assert sorted(times) == [0, 1, 3, 4, 5]
    assert all(stages_timed(times[k]) == [*STAGE_NAMES] for k in (0, 1, 3, 5))
    assert stages_timed(times[4]) == ["reading", "detection", "tracking"], (
        "expected only the stages before fusion: frame 4 is lost"
    )


def test_rerun_lost_and_skipped_frames_are_logged(recorded: Path) -> None:
    expected = {row["TextLog:text"][0]: row["frame"] for row in rows(recorded, "log")}
    assert expected["lost: too dark"] == 4
    assert "skipped: frame 2: depth/000002.png is truncated" in expected


def test_rerun_camera_path_is_split_at_lost_frames(recorded: Path) -> None:
    pieces = {}
    for entity in entities(recorded):
        if entity.startswith("/world/path/"):
            pieces[entity] = list(rows(recorded, entity[1:]))[-1]["LineStrips3D:strips"][0]
    assert [len(pieces[f"/world/path/{k}"]) for k in range(2)] == [3, 1]
    np.testing.assert_allclose(pieces["/world/path/0"], [pose_at(k)[:3, 3] for k in (0, 1, 3)], atol=1e-6)


def test_rerun_path_is_corrected_and_loops_are_drawn(tmp_path: Path) -> None:
    viewer = RerunViewer()
    stages: dict[str, Any] = {"tracker": RoomTracker(), "fuser": SubmapFuser(), "backend": GivenChanges()}
    result = pipeline(viewer, **stages).run_to_any_end(CornerRoom(), tmp_path)
    file = tmp_path / "recording.rrd"
    corrected = [one.pose.T_world_camera[:3, 3] for one in result.tracked]
    drawn = [list(rows(file, f"world/path/{k}"))[-1]["LineStrips3D:strips"][0] for k in range(2)]
    for line, frames in zip(drawn, (slice(0, 3), slice(2, 6)), strict=True):
        np.testing.assert_allclose(line, corrected[frames], atol=1e-6)
    loops = list(rows(file, "world/loops"))[-1]["LineStrips3D:strips"]
    np.testing.assert_allclose(loops, [[corrected[1], corrected[4]]], atol=1e-6)


def test_rerun_mesh_equals_map_mesh(recorded: Path, tmp_path: Path) -> None:
    last = {}
    for entity in entities(recorded):
        if entity.startswith("/world/mesh/"):
            last[entity] = list(rows(recorded, entity[1:]))[-1]
    points = np.concatenate([np.array(row["Mesh3D:vertex_positions"]) for row in last.values()])
    triangles = sum(len(row["Mesh3D:triangle_indices"]) for row in last.values())
    mesh = pipeline(RerunViewer()).run_to_any_end(CornerRoom(unreadable=2), tmp_path).scene.mesh()
    assert triangles == len(mesh.triangles) > 1000
    used = mesh.vertices[np.unique(mesh.triangles)]
    assert {tuple(row) for row in points.astype(np.float32).tolist()} == {tuple(row) for row in used.tolist()}


def test_rerun_objects_and_masks_share_colors_and_names(recorded: Path) -> None:
    boxes = list(rows(recorded, "world/objects/boxes"))[-1]
    names = list(rows(recorded, "world/objects/names"))[-1]
    assert sorted(label.split()[0] for label in names["Points3D:labels"]) == ["chair", "couch"]
    assert len(set(boxes["Boxes3D:colors"])) == 2
    found = list(rows(recorded, "world/camera/found"))[-1]
    assert found["frame"] == 5
    assert set(found["Boxes2D:colors"]) == set(boxes["Boxes3D:colors"])
    labels = list(rows(recorded, "world/camera/names"))[-1]["Points2D:labels"]
    assert sorted(label.split()[0] for label in labels) == ["chair", "couch"]
    png = list(rows(recorded, "world/camera/masks"))[-1]["EncodedImage:blob"][0]
    image = cv2.imdecode(np.array(png, np.uint8), cv2.IMREAD_UNCHANGED)  # BGR and opacity
    masks = SphereDetector().detect(CornerRoom()[5]).masks
    np.testing.assert_array_equal(image[..., 3] > 0, masks.any(axis=0))
    red, green, blue = (image[masks.any(axis=0)][:, k].astype(int) for k in (2, 1, 0))
    assert set((red << 24 | green << 16 | blue << 8 | 255).tolist()) == set(boxes["Boxes3D:colors"])


def test_rerun_camera_has_pose_and_intrinsics(recorded: Path) -> None:
    camera = list(rows(recorded, "world/camera"))[-1]
    assert camera["frame"] == 5
    np.testing.assert_allclose(camera["Transform3D:translation"][0], pose_at(5)[:3, 3], atol=1e-6)
    assert camera["Pinhole:resolution"][0] == [CAMERA.width, CAMERA.height]
    K = np.array(camera["Pinhole:image_from_camera"][0]).reshape(3, 3).T
    np.testing.assert_allclose(K, [[90, 0, 48], [0, 90, 36], [0, 0, 1]])  # in rerun, pixel centers are at half-integers


def test_rerun_viewer_does_not_change_result(tmp_path: Path) -> None:
    """The viewer reads the map after every frame."""
    maps = {}
    for name in ("none", "rerun"):
        viewer = build_viewer(name, "viewer.mesh_interval=0.1") if name == "rerun" else build_viewer(name)
        (tmp_path / name).mkdir()
        result = pipeline(viewer).run_to_any_end(CornerRoom(frames=12), tmp_path / name)
        result.scene.save(tmp_path / name / "map.npz")
        poses = [frame.pose.T_world_camera.tobytes() for frame in result.tracked]
        maps[name] = (tmp_path / name / "map.npz").read_bytes(), poses
    assert maps["none"] == maps["rerun"]
    assert not (tmp_path / "none" / "recording.rrd").exists()
    assert (tmp_path / "rerun" / "recording.rrd").stat().st_size > 10_000


def build_viewer(name: str, *overrides: str) -> Any:
    return registered.built("viewer", name, *overrides)


def test_rerun_recording_of_killed_run_lacks_at_most_1_5_s(tmp_path: Path) -> None:
    """The last time in the recording is compared with the time of the last fused frame."""
    endless = ("dataset.frames=100000", "dataset.slow_s=0.03", "fuser.capacity=100000", "fuser.note=note")
    line = [
        sys.executable,
        "-m",
        "framework",
        "--config-dir",
        str(CHECKOUT / "tests" / "support" / "fake_conf"),
        *FAKES,
        *endless,
    ]
    run = subprocess.Popen(
        [*line, "viewer=rerun", "hydra.run.dir=run"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not (tmp_path / "note").exists():
            assert run.poll() is None, run.communicate()[1]
            assert time.monotonic() < deadline
            time.sleep(0.01)
        time.sleep(3)
    finally:
        os.kill(run.pid, signal.SIGKILL)
        run.communicate()
    fused_at = (tmp_path / "note").stat().st_mtime  # s, time of the last fused frame
    file = tmp_path / "run" / "recording.rrd"
    os.truncate(file, file.stat().st_size - 1)  # simulate a kill during a write
    frames = list(rows(fixed(file), "world/camera/color"))
    assert len(frames) > 3
    last = max(row["log_time"] for row in frames) / 1e9
    assert abs(fused_at - last) < 1.5, f"expected at most 1.5 s to be missing, got {fused_at - last:.2f} s"


def test_rerun_mapper_writes_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mapper = Mapper(*STAGES, viewer="rerun")
    room = CornerRoom()
    mapper.add(room[0])
    with pytest.raises(FrameError):
        mapper.add(replace(room[1], T_world_camera=None))
    mapper.add(room[2])
    del mapper
    times = {row["frame"]: row["Scalars:scalars"] for row in rows(tmp_path / "recording.rrd", "milliseconds")}
    assert sorted(times) == [0, 2]
    assert stages_timed(times[0]) == [*STAGE_NAMES[1:]], "expected no reading time: the caller reads the frame"
    assert [row["TextLog:text"] for row in rows(tmp_path / "recording.rrd", "log")]


def test_rerun_missing_package_error_names_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = importlib.util.find_spec
    there = {"rerun": None}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: there.get(name, find_spec(name, *rest)))
    with pytest.raises(ConfigError, match=r"viewer: expected the package rerun, got none; run pip install"):
        build_viewer("rerun")


@pytest.mark.parametrize(
    ("parameter", "message"),
    [
        ("frame_interval=0", r"frame_interval: expected a value in \[1, 1e\+06\], got 0"),
        ("mesh_interval=nan", "mesh_interval: expected a value in"),
        ("memory_limit=lots", "memory_limit: expected a size such as 2GB or 25%, got lots"),
        ("mode=WINDOWS", "mode"),
        ("port=80", "port: expected a value in"),
    ],
)
def test_rerun_invalid_parameter_raises(parameter: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build_viewer("rerun", f"viewer.{parameter}")


def begun(viewer: RerunViewer, directory: Path) -> None:
    viewer.begin(assemble(BayesianTsdf).scene, "nothing", directory)


def test_rerun_unwritable_recording_raises(tmp_path: Path) -> None:
    (tmp_path / "recording.rrd").mkdir()
    with pytest.raises(
        ConfigError, match=r"viewer\.file: expected a writable file, got .*recording\.rrd \(.*Is a directory"
    ):
        begun(RerunViewer(), tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"viewer\.file: expected a writable file"):
        begun(RerunViewer(file="file/below.rrd"), tmp_path)


def test_rerun_window_mode_without_display_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"viewer\.mode: expected a display for WINDOW, got none"):
        begun(RerunViewer(mode=Mode.WINDOW), tmp_path)


def test_rerun_occupied_port_raises(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"viewer\.port: expected a free port, got {port}"):
            begun(RerunViewer(mode=Mode.BROWSER, port=port), tmp_path)


def listening() -> set[str]:
    """Return the addresses on which this process listens, as hexadecimal ADDRESS:PORT like in /proc."""
    own = {str(file.readlink()) for file in list(Path("/proc/self/fd").iterdir()) if file.is_symlink()}
    lines = [line.split() for table in ("tcp", "tcp6") for line in Path("/proc/net", table).read_text().splitlines()]
    return {line[1] for line in lines if line[3] == "0A" and f"socket:[{line[9]}]" in own}


@pytest.mark.skipif(sys.platform != "linux", reason="requires /proc")
def test_rerun_browser_mode_listens_only_on_localhost(tmp_path: Path) -> None:
    viewer = RerunViewer(mode=Mode.BROWSER, port=free_port(), web_port=free_port())
    begun(viewer, tmp_path)
    served = {address.partition(":")[2]: address.partition(":")[0] for address in listening()}
    viewer.end()
    assert {served.pop(f"{port:04X}") for port in (viewer.port, viewer.web_port)} == {"0100007F"}
    assert not {host for host in served.values() if not host.endswith("7F")}, "expected no other open address"


def test_rerun_window_mode_binds_only_localhost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that records its arguments and listens on the port replaces rerun."""
    program, port = tmp_path / "rerun", free_port()
    program.write_text(
        f"""#!{sys.executable}
import socket, sys, time
open({str(tmp_path / "calls")!r}, "a").write(" ".join(sys.argv[1:]) + "\\n")
if "--port" in sys.argv:
    with socket.create_server(("127.0.0.1", {port})):
        time.sleep(3)
"""
    )
    program.chmod(0o755)
    monkeypatch.setattr(rerun_program, "program", lambda: str(program))
    for _ in range(2):  # at the second call, the program is already running
        rerun_program.open_window(port, "1GB")
    disabled, opened, *others = (tmp_path / "calls").read_text().splitlines()
    assert disabled == "analytics disable"
    assert f"--bind 127.0.0.1 --port {port} --memory-limit 1GB" in opened
    assert others == [disabled]
    program.write_text("#!/bin/sh\n[ $1 = analytics ]\n")
    with pytest.raises(OSError, match=r"rerun: expected a server on port \d+, got exit status 1"):
        rerun_program.open_window(free_port(), "1GB")


def test_rerun_browser_page_connects_only_to_viewer_server(tmp_path: Path) -> None:
    viewer = RerunViewer(mode=Mode.BROWSER, port=free_port(), web_port=free_port(), file="also.rrd")
    begun(viewer, tmp_path)
    with urlopen(f"http://127.0.0.1:{viewer.web_port}/?url=data", timeout=30) as page:
        text, policy = page.read().decode(), page.headers["Content-Security-Policy"]
    with pytest.raises(HTTPError, match="404"):
        urlopen(f"http://127.0.0.1:{viewer.web_port}/../../etc/passwd", timeout=30)
    viewer.end()
    assert "<html" in text
    sources = {word for word in policy.replace(";", " ").split() if word.startswith("http")}
    assert sources == {f"http://{name}:{viewer.port}" for name in ("127.0.0.1", "localhost")}
    assert "*" not in policy
    assert (tmp_path / "also.rrd").exists()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", viewer.web_port)) != 0, "expected a closed server"
