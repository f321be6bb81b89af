"""Stored runs whose maps are changed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from framework.data import Float64
from framework.errors import DataError
from framework.files.folders.restartable_folder import check_new
from framework.files.folders.staged_files import finish_replacement
from framework.files.manifest import Manifest
from framework.files.tum_trajectory import read_tum
from framework.mapping.instance_map import FORMAT, InstanceMap
from framework.mapping.storage.map_file import read_format
from framework.queries.changes import Visit
from framework.runs.stored_runs import MAP, TRAJECTORY, Record, read_record

OVERVIEW = "overview.png"


@dataclass(frozen=True)
class OpenedRun:
    """A completed run with its map, which is a copy in memory."""

    record: Record
    manifest: Manifest
    scene: InstanceMap
    timestamps: Float64  # (F,) s, of the mapped frames
    poses: Float64  # (F, 4, 4) T_world_camera of the mapped frames

    @property
    def visit(self) -> Visit:
        """The map with its camera poses."""
        return Visit(self.scene, self.poses)

    @classmethod
    def of(cls, run: Path) -> OpenedRun:
        """Read a completed run.

        Raises:
            DataError: The run is incomplete or changed, or its map has no label evidence.
        """
        record, manifest = read_record(run), Manifest.read(run)
        if changed := manifest.changed_files(run):
            raise DataError(f"{changed[0]}; repeat the run")
        if (found := read_format(run / MAP)) != str(FORMAT):
            raise DataError(
                f"{run / MAP}: expected map format {FORMAT}, got {found}; map with a fuser that stores instances in "
                "voxels, such as fuser=bayesian_tsdf"
            )
        return cls(record, manifest, InstanceMap.load(run / MAP), *read_tum(run / TRAJECTORY))


def check_empty(out: Path) -> None:
    """Raise DataError unless a path is a new or empty folder. Unfinished files of a killed process are ignored."""
    finish_replacement(out)
    check_new(out)


def directory_next_to(run: Path, ending: str) -> Path:
    """Return a directory next to a stored run, whose name has the given ending."""
    named = run if run.name not in ("", "..") else run.resolve()
    return named.with_name(f"{named.name}_{ending}")
