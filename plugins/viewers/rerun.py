"""Viewer based on rerun (https://rerun.io, Apache-2.0 and MIT).

The output is a window, a web page or a file.
"""

from __future__ import annotations

import logging
import os
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any
from uuid import uuid4

from framework.config.validation import check_bounds, check_package, require
from framework.data import LIKELY, Detections, Frame, Pose
from framework.errors import ConfigError, in_one_line
from framework.interfaces import SceneMap, SubmapChange, SubmapGraph, Viewer
from framework.live_view.drawing_thread import DrawingThread
from framework.live_view.rerun_program import HERE, open_window
from framework.live_view.sealed_page import SealedPage

log = logging.getLogger(__name__)

RECORDING = "recording.rrd"
FLUSH_S = 0.2  # maximum duration of data lost by a killed run, s


class Mode(Enum):
    """Output of the viewer."""

    RECORD = "record"
    WINDOW = "window"
    BROWSER = "browser"


@dataclass
class RerunViewer(Viewer):
    """Viewer of the camera path, images with masks, the mesh, object boxes and stage times.

    When the back end corrects the map, the path moves, and a line marks each loop. If drawing is slower than mapping,
    some images are omitted. Poses, stage times and lost frames are always shown.
    """

    mode: Mode = Mode.RECORD  # output: RECORD (file), WINDOW (rerun's viewer) or BROWSER (local web page)
    # path of the .rrd file, relative to the run directory; "" = recording.rrd for RECORD, no file for the other modes
    file: str = ""
    frame_interval: int = 3  # interval between logged images, in frames, >= 1; 1 = every frame
    mesh_interval: float = 2.0  # minimum interval between mesh snapshots, s, in [0.1, 3600]
    stride: int = 2  # step between the logged pixels of an image, px, in [1, 16]
    jpeg_quality: int = 75  # JPEG quality of the images, in [1, 100]
    region_size: float = 1.0  # side of the cubic regions in which the mesh is updated, m, in [0.1, 1000]
    min_probability: float = LIKELY  # minimum probability that a displayed object exists, in [0, 1]
    min_score: float = 0.3  # minimum score of labeled detections, in [0, 1]
    # maximum viewer memory in the modes WINDOW and BROWSER, e.g. 2GB or 25% of system memory; the oldest data is
    # dropped first
    memory_limit: str = "2GB"
    port: int = 9876  # port of the data stream, in [1024, 65535]; WINDOW reuses a viewer that is open on this port
    web_port: int = 9090  # port of the web page in the mode BROWSER, in [1024, 65535]

    def __post_init__(self) -> None:
        check_bounds(
            self,
            frame_interval=(1, 10**6),
            mesh_interval=(0.1, 3600.0),
            stride=(1, 16),
            jpeg_quality=(1, 100),
            region_size=(0.1, 1000.0),
            min_probability=(0.0, 1.0),
            min_score=(0.0, 1.0),
            port=(1024, 65535),
            web_port=(1024, 65535),
        )
        limit = self.memory_limit.removesuffix("B").removesuffix("i").rstrip("kMGT%")
        require(limit.isdecimal(), "viewer.memory_limit", self.memory_limit, "a size such as 2GB or 25%")
        self._page: SealedPage | None = None
        check_package("viewer", "rerun", extra="viewer")

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        import rerun as rr

        from framework.live_view.rerun_drawing import RerunDrawing
        from framework.live_view.rerun_layout import layout

        batches = rr.ChunkBatcherConfig(flush_tick=FLUSH_S)
        recording = rr.RecordingStream("instancemap", recording_id=uuid4(), batcher_config=batches)
        recording.set_sinks(*self._sinks(rr, directory), default_blueprint=layout())
        recording.send_recording_name(video)
        drawing = RerunDrawing(
            recording, self.stride, self.jpeg_quality, self.region_size, self.min_probability, self.min_score
        )
        self._thread = DrawingThread(scene, drawing, self.frame_interval, self.mesh_interval)

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        self._thread.show(frame, detections, pose, stage_ms)

    def skip(self, reason: str) -> None:
        self._thread.skip(reason)

    def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
        self._thread.correct(change, graph)

    def end(self) -> None:
        self._thread.end()
        if self._page is not None:
            self._page.close()

    def _sinks(self, rr: Any, directory: Path) -> list[Any]:
        """Open the outputs, and return their rerun sinks."""
        sinks = []
        file = self.file or (RECORDING if self.mode is Mode.RECORD else "")
        if file:
            sinks.append(_file_sink(rr, directory / Path(file).expanduser()))
        if self.mode is Mode.WINDOW:
            sinks.append(_open_window(rr, self.port, self.memory_limit))
        if self.mode is Mode.BROWSER:
            sinks.append(_server(rr, self.port, self.memory_limit))
            with _named_errors(f"viewer.web_port: expected a free port, got {self.web_port}"):
                self._page = SealedPage(self.web_port, self.port)
            log.info("viewer: %s; available until the run ends", self._page.url)
        return sinks


def _file_sink(rr: Any, path: Path) -> Any:
    with _named_errors(f"viewer.file: expected a writable file, got {path}"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("wb").close()  # rerun would report this only on stderr
        return rr.FileSink(path)


def _server(rr: Any, port: int, memory_limit: str) -> Any:
    """Start a local data server, and return its rerun sink."""
    with _named_errors(f"viewer.port: expected a free port, got {port}"):
        with socket.socket() as probe:  # rerun would report this only on stderr
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HERE, port))
        return rr.GrpcServerSink(bind_ip=HERE, port=port, server_memory_limit=memory_limit)


def _open_window(rr: Any, port: int, memory_limit: str) -> Any:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError("viewer.mode: expected a display for WINDOW, got none; set viewer.mode=BROWSER or RECORD")
    with _named_errors("viewer.mode: expected rerun's viewer to start, got an error"):
        open_window(port, memory_limit)
    return rr.GrpcSink(f"rerun+http://{HERE}:{port}/proxy")


@contextmanager
def _named_errors(what: str) -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError, ValueError, subprocess.SubprocessError) as error:
        raise ConfigError(f"{what} ({in_one_line(error)})") from error
