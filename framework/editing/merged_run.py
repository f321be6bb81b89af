"""Runs whose map is the union of two overlapping stored maps."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Array, Float64
from framework.datasets.frames.world_offset import origin_comments, stored_origin
from framework.editing.map_alignment import KeyframedMap, align_maps, check_agreement
from framework.editing.opened_run import OVERVIEW, OpenedRun, check_empty
from framework.errors import DataError
from framework.files.folders.staged_files import staged_files
from framework.files.json_file import write_json
from framework.files.manifest import RUN_FILES, Manifest, RunStatus
from framework.files.tum_trajectory import write_tum
from framework.geometry import transform
from framework.mapping.instances.association import Association
from framework.rendering.overview import write_overview
from framework.runs.instances_file import write_instances
from framework.runs.mesh_file import write_mesh
from framework.runs.metrics import is_evaluation, room_metrics
from framework.runs.run_directory import caption, likely_labels
from framework.runs.stored_runs import (
    CONFIG,
    DEPTH_DISTORTION,
    EDITED_FROM,
    EVALUATION,
    INSTANCES,
    KEYFRAMES,
    MAP,
    MERGED_FROM,
    MERGED_POSES,
    MERGED_WITH,
    MESH,
    METRICS,
    TRAJECTORY,
)
from framework.runs.world_frames import contains, have_given_poses, known_transform
from framework.tracking.keyframes import Keyframes, read_keyframes, write_keyframes
from framework.vocabulary.label_spaces import label_space_of

OF_ONE_RUN = (
    *("trajectory.", "stage_ms.", "fps", "latency_ms", "color_delay", "peak_rss_bytes", "frames", "masks_omitted"),
    *("map.up.", "map.floor_m", "up_from", EVALUATION),
)  # prefixes of metrics that do not apply to a merged map
COUNTED = ("frames", "frames_lost", "frames_skipped")  # metrics that are summed


@dataclass(frozen=True)
class MergedRun:
    """Two stored runs and their merged map, in the world frame of the first run."""

    first: OpenedRun  # its map is the merged map
    second: OpenedRun
    keyframes: Mapping[str, Array]  # of both runs
    T_first_second: Float64  # (4, 4) between the world frames
    shared: int  # number of instances that both maps contain
    timestamps: Float64  # (F,) s
    poses: Float64  # (F, 4, 4) T_world_camera

    @classmethod
    def of(cls, first: Path, second: Path) -> MergedRun:
        """Merge the maps of two completed runs. The stored runs are not changed.

        Raises:
            DataError: A run is incomplete or changed, its map has no label evidence, the maps have different
                parameters or classes, or the transform between them is uncertain.
        """
        for run, other in ((first, second), (second, first)):
            if contains(run, other):
                raise DataError(
                    f"{run}: expected a map of other frames, got a map that contains {other}; use it as it is"
                )
        a, b = (_opened(run) for run in (first, second))
        saved_a, saved_b = (read_keyframes(run / KEYFRAMES) for run in (first, second))
        try:
            a.scene.check_compatible(b.scene)
        except DataError as error:
            raise DataError(f"{second}: {error}") from error
        T_a_b = known_transform(first, second)
        try:
            if T_a_b is None:
                T_a_b = align_maps(_keyframed(a, saved_a), _keyframed(b, saved_b))
            elif have_given_poses(first, second):  # which may be those of different buildings
                check_agreement(a.visit, b.visit, T_a_b)
        except DataError as error:
            raise DataError(f"{second}: {error}; map it again with localize_in={first}") from error
        before = {*a.scene.table.records}
        ids = a.scene.absorb(b.scene, T_a_b, _association(a.record.config))
        later = b.timestamps
        if len(a.timestamps) and len(later) and later[0] <= a.timestamps[-1]:
            later = later + math.ceil(a.timestamps[-1] - later[0] + 1)  # keeps the fractions of a second
        return cls(
            a,
            b,
            _joined(saved_a, saved_b, T_a_b),
            T_a_b,
            len(before & {*ids.values()} & a.scene.instance_ids()),
            np.concatenate([a.timestamps, later]),
            np.concatenate([a.poses, T_a_b @ b.poses]),
        )

    def write(self, out: Path) -> None:
        """Write the run directory of the merged map. After an error, it has no files.

        Its config and provenance are those of the first run.

        Raises:
            DataError: The directory is not empty, or a file cannot be read or written.
        """
        check_empty(out)
        first, scene = self.first, self.first.scene
        mesh, found = scene.mesh(), scene.instances()
        comments = origin_comments(stored_origin(first.record.metrics))
        metrics = self._metrics() | {"instances.count": len(found)}
        with staged_files(out) as folder:
            for name in (CONFIG, DEPTH_DISTORTION):
                if (first.record.directory / name).exists():
                    shutil.copyfile(first.record.directory / name, folder / name)
            write_tum(folder / TRAJECTORY, self.timestamps, self.poses, comments)
            scene.save(folder / MAP)
            if self.keyframes:
                write_keyframes(folder / KEYFRAMES, self.keyframes)
            write_instances(folder / INSTANCES, mesh, found, scene.classes)
            write_mesh(folder / MESH, mesh, comments)
            title = f"{caption(metrics)} | merged"
            write_overview(folder / OVERVIEW, mesh, likely_labels(found, scene.classes), self.poses, title)
            write_json(folder / METRICS, metrics)
            manifest = Manifest(RunStatus.COMPLETE, {}, first.manifest.inputs, first.manifest.parameters)
            manifest.with_files(folder, RUN_FILES).write(folder)

    def _metrics(self) -> dict[str, Any]:
        """Return the metrics of the first run that apply to the merged map, and the size of the map."""
        first, second, scene = self.first.record, self.second.record, self.first.scene
        kept = {
            key: value
            for key, value in first.metrics.items()
            if not is_evaluation(key) and not key.startswith(OF_ONE_RUN)
        }
        counts = {key: sum(int(one.metrics.get(key) or 0) for one in (first, second)) for key in COUNTED}
        return {
            **kept,
            **counts,
            **{f"map.{name}": value for name, value in asdict(scene.statistics).items()},
            **room_metrics(scene, scene.mesh()),
            "label_space": label_space_of(scene.classes),
            MERGED_FROM: str(first.directory.resolve()),
            MERGED_WITH: str(second.directory.resolve()),
            MERGED_POSES: first.metrics.get(MERGED_POSES, len(self.first.poses)),
        }


def _opened(run: Path) -> OpenedRun:
    opened = OpenedRun.of(run)
    if EDITED_FROM in opened.record.metrics:  # all its instances count as confirmed
        raise DataError(f"{run}: expected an unedited map, got an {opened.record.derived}; merge first, then edit")
    return opened


def _keyframed(run: OpenedRun, saved: Mapping[str, Array]) -> KeyframedMap:
    keyframes = Keyframes()
    if saved:
        keyframes.restore(saved)
    return KeyframedMap(run.visit, [*keyframes])


def _joined(saved_a: Mapping[str, Array], saved_b: Mapping[str, Array], T_a_b: Float64) -> dict[str, Array]:
    """Return the keyframes of both runs in the world frame of the first run."""
    if not saved_b:
        return dict(saved_a)
    moved = {
        **saved_b,
        "poses": T_a_b @ saved_b["poses"].astype(np.float64),
        "points_world": transform(T_a_b, saved_b["points_world"].astype(np.float64)).astype(np.float32),
    }
    return {name: np.concatenate([saved_a[name], moved[name]]) for name in moved} if saved_a else moved


def _association(config: Mapping[str, Any]) -> Association:
    """Return the rule of the data association in the config of a run."""
    given = config.get("fuser") or {}
    return Association(**{name: given[name] for name in ("min_overlap", "create_points") if name in given})
