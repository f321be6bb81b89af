"""A mesh whose vertices are labelled with the true instances, as data sets of scanned rooms publish them."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from framework.data import Camera, DeferredTruth, Float32, Float64, FrameTruth, Int32, SceneTruth
from framework.datasets.frames.sequence_reader import Recording
from framework.files.atomic_write import is_there
from framework.files.hashing import add_array, path_hash
from framework.rendering import rasterizer
from framework.rendering.rasterizer import Rasterizer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LabeledMesh:
    """The true surface of a scene and the instances on it."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None]  # as in FrameTruth
    classes: tuple[str, ...] | None = None  # as in SceneTruth

    def scene_truth(self) -> SceneTruth:
        """The vertices as points: all of them, whatever frames of the video are chosen."""
        return SceneTruth(self.vertices, self.instance_ids, dict(self.class_names), self.classes)

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> FrameTruth:
        """The instances that `camera` would see, rendered when they are asked for.

        They are those of the mesh's vertices nearest to what the pixels meet.
        """
        return DeferredTruth(
            render=lambda: self._drawn(camera, T_world_camera),
            shape=camera.shape,
            class_names=self.class_names,
            origin=f"{self._fingerprint} {camera!r} {T_world_camera.tobytes().hex()}",
        )

    def _drawn(self, camera: Camera, T_world_camera: Float64) -> Int32:
        return self._rasterizer.draw(camera, T_world_camera).nearest(self.triangles, self.instance_ids)

    @cached_property
    def _rasterizer(self) -> Rasterizer:
        return Rasterizer(self.vertices, self.triangles)

    @cached_property
    def _fingerprint(self) -> str:
        """SHA-256 (hex) of what is rendered, and of the code that does."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles, self.instance_ids):
            add_array(digest, array)
        for source in (__file__, rasterizer.__file__):
            digest.update(path_hash(Path(source)).encode())
        return digest.hexdigest()


@dataclass
class LabeledRecording(Recording):
    """A recording of a scene that may have a labelled mesh, which the subclass's `open` sets.

    Truth is all of the mesh, whatever frames are chosen.
    """

    frame_ground_truth: bool = (
        False  # whether frames have the true instances: the mesh is rendered for detectors that ask
    )

    def __post_init__(self) -> None:
        self.mesh: LabeledMesh | None = None
        super().__post_init__()

    def truth_in(self, index: int) -> FrameTruth | None:
        T_world_camera = self.contents.frames[index].T_world_camera
        if self.mesh is None or not self.frame_ground_truth or T_world_camera is None:
            return None
        return self.mesh.seen_by(self.camera, T_world_camera)

    def scene_truth(self) -> SceneTruth | None:
        return self.mesh.scene_truth() if self.mesh else None


def mesh_of(files: Sequence[Path], read: Callable[..., LabeledMesh]) -> LabeledMesh | None:
    """What `read` makes of the files; None, with a word in the log where only some are missing, without all of them."""
    missing = [path for path in files if not is_there(path)]
    if 0 < len(missing) < len(files):
        log.warning("no true instances: %s is missing", missing[0])
    return None if missing else read(*files)
