"""Recordings with a labeled mesh."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from framework.data import FrameTruth, SceneTruth
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.errors import DataError
from framework.files.atomic_write import path_exists

log = logging.getLogger(__name__)


@dataclass
class LabeledRecording(Recording):
    """A recording with an optional labeled mesh as ground truth.

    Subclasses load the mesh in `open`.
    """

    # True = render the ground-truth instances of each frame, for simulated detectors; always rendered if ground_truth
    # is set
    frame_ground_truth: bool = False

    def __post_init__(self) -> None:
        self.mesh: LabeledMesh | None = None
        super().__post_init__()
        if any(self.world_origin):
            self.mesh = self._in_map_world(self.mesh)

    def load_mesh(self, files: Sequence[Path], read: Callable[..., LabeledMesh]) -> None:
        """Load the mesh if all of its files exist and `ground_truth` is not set.

        Args:
            files: The files of the mesh and its annotation.
            read: A function that returns the mesh. Its arguments are the files.

        Raises:
            DataError: A file is missing, and `frame_ground_truth` is set.
        """
        if self.named_truth is not None:
            return
        missing = [path for path in files if not path_exists(path)]
        if not missing:
            self.mesh = read(*files)
        elif self.frame_ground_truth:
            expected = f"expected the file {missing[0]} of the labeled mesh, got none"
            raise DataError(f"dataset.frame_ground_truth: {expected}; add the file, or set this key to false")
        elif len(missing) < len(files):
            log.warning("%s: expected a file of the labeled mesh, got none; instances are not evaluated", missing[0])

    def _in_map_world(self, mesh: LabeledMesh | None) -> LabeledMesh | None:
        """Return a mesh relative to the world offset."""
        if mesh is None:
            return None
        return replace(mesh, vertices=(mesh.vertices.astype(np.float64) - self.world_origin).astype(np.float32))

    def truth_in(self, index: int) -> FrameTruth | None:
        T_world_camera = self.contents.frames[index].T_world_camera
        if self.mesh is None or not self.frame_ground_truth or T_world_camera is None:
            return None
        return self.mesh.seen_by(self.camera, T_world_camera)

    def own_scene_truth(self) -> SceneTruth | None:
        return self.mesh.scene_truth() if self.mesh else None
