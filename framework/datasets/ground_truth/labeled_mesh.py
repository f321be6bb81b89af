"""Meshes with instance labels at their vertices, as datasets of scanned rooms publish them."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from framework.data import Camera, DeferredTruth, Float32, Float64, FrameTruth, Int32, SceneTruth
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import DataError
from framework.files.atomic_write import is_there
from framework.files.hashing import add_array, path_hash
from framework.rendering import rasterizer
from framework.rendering.rasterizer import Rasterizer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LabeledMesh:
    """The true surface of a scene with its instances."""

    vertices: Float32  # (V, 3) m, world
    triangles: Int32  # (F, 3)
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None]  # as in FrameTruth
    classes: tuple[str, ...] | None = None  # as in SceneTruth

    def scene_truth(self) -> SceneTruth:
        """Return all vertices as points, whatever frames of the video are selected."""
        return SceneTruth(self.vertices, self.instance_ids, dict(self.class_names), self.classes)

    def seen_by(self, camera: Camera, T_world_camera: Float64) -> FrameTruth:
        """Return the instances of the vertices nearest to each pixel's surface point, rendered on demand."""
        return DeferredTruth(
            render=lambda: self._rasterizer.draw(camera, T_world_camera).nearest(self.triangles, self.instance_ids),
            shape=camera.shape,
            class_names=self.class_names,
            origin=f"{self._fingerprint} {camera!r} {T_world_camera.tobytes().hex()}",
        )

    @cached_property
    def _rasterizer(self) -> Rasterizer:
        return Rasterizer(self.vertices, self.triangles)

    @cached_property
    def _fingerprint(self) -> str:
        """SHA-256 (hex) of the mesh and the rendering code."""
        digest = hashlib.sha256()
        for array in (self.vertices, self.triangles, self.instance_ids):
            add_array(digest, array)
        for source in (__file__, rasterizer.__file__):
            digest.update(path_hash(Path(source)).encode())
        return digest.hexdigest()


@dataclass
class LabeledRecording(Recording):
    """A recording of a scene that may have a labeled mesh, which the subclass loads in `open`.

    The ground truth is the whole mesh, whatever frames are selected.
    """

    frame_ground_truth: bool = False  # frames have the true instances: the mesh is rendered for detectors that need it

    def __post_init__(self) -> None:
        self.mesh: LabeledMesh | None = None
        super().__post_init__()

    def load_mesh(self, files: Sequence[Path], read: Callable[..., LabeledMesh]) -> None:
        """Load the mesh from its files, if all of them exist.

        Raises DataError if one is missing and `frame_ground_truth` needs it.
        """
        missing = [path for path in files if not is_there(path)]
        if not missing:
            self.mesh = read(*files)
        elif self.frame_ground_truth:
            raise DataError(f"dataset.frame_ground_truth: expected the labeled mesh, found no {missing[0]}")
        elif len(missing) < len(files):
            log.warning("no true instances: %s is missing", missing[0])

    def truth_in(self, index: int) -> FrameTruth | None:
        T_world_camera = self.contents.frames[index].T_world_camera
        if self.mesh is None or not self.frame_ground_truth or T_world_camera is None:
            return None
        return self.mesh.seen_by(self.camera, T_world_camera)

    def scene_truth(self) -> SceneTruth | None:
        return self.mesh.scene_truth() if self.mesh else None
