"""What the readers of scanned rooms with labelled meshes share: truth is the mesh, where its files are there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from framework.data import FrameTruth, SceneTruth
from framework.datasets.frames.sequence_reader import Recording
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.files.atomic_write import is_there

log = logging.getLogger(__name__)


@dataclass
class LabeledRecording(Recording):
    """A recording of a scene that may have a labelled mesh, which the subclass's `open` sets.

    Truth is all of the mesh, whatever frames are chosen.
    """

    frame_truth: bool = False  # whether frames have the true instances: the mesh is rendered for detectors that ask

    def __post_init__(self) -> None:
        self.mesh: LabeledMesh | None = None
        super().__post_init__()

    def truth_in(self, index: int) -> FrameTruth | None:
        T_world_camera = self.contents.frames[index].T_world_camera
        if self.mesh is None or not self.frame_truth or T_world_camera is None:
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
