"""Mapping from Python: the same stages, names and defaults as on the command line."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from framework.configs import composed
from framework.data import Camera, Detections, Frame, Instance, InstanceMesh, PointClusters, Pose, View
from framework.detection.cache import with_cache
from framework.detection.domain import warn_outside_domain
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, MapFullError
from framework.interfaces import ClusterRefiner, Detector, MapFuser, PoseTracker, RGBDSequence, SceneMap
from framework.journal import Journal
from framework.parameters import checked_path
from framework.pipeline import Pipeline
from framework.records.stored_runs import MAP, PLACES
from framework.registry import build
from framework.settings import Settings
from framework.tracking.places_file import read_places

__all__ = [
    "Camera",
    "ClusterRefiner",
    "ConfigError",
    "DataError",
    "Detections",
    "Detector",
    "Frame",
    "FrameError",
    "Instance",
    "InstanceMapError",
    "InstanceMesh",
    "MapFullError",
    "MapFuser",
    "Mapper",
    "Pipeline",
    "PointClusters",
    "Pose",
    "PoseTracker",
    "RGBDSequence",
    "SceneMap",
    "View",
    "load_map",
]


def pipeline_of(config: DictConfig) -> Pipeline:
    """The stages that a config names, the detector behind the cache that it asks for."""
    fuser, refiner = build(MapFuser, config.get("fuser")), build(ClusterRefiner, config.get("refiner"))
    tracker = build(PoseTracker, config.get("tracker"))
    detector = with_cache(build(Detector, config.get("detector")), config)  # last, as loading a network takes its time
    return Pipeline(detector, tracker, refiner, fuser, config.ahead)


def go_on(pipeline: Pipeline, run: Path) -> None:
    """Has a pipeline that has mapped nothing go on with the map of a stored run.

    The tracker says that it is lost until it finds itself in that map. Raises DataError where the run has left no map
    that can be read, ConfigError where the stages cannot go on with it.
    """
    if not (run / MAP).is_file():
        raise DataError(f"map: there is no {run / MAP}: expected the directory of a run")
    scene = load_map(run / MAP)
    pipeline.fuser.go_on(scene)
    pipeline.tracker.recall(read_places(run / PLACES))


class Mapper:
    """Maps frames as they come: `Mapper("detector=mask_rcnn", "fuser.voxel_size=0.02")`.

    The arguments are those of a run on the command line, with its defaults for what is recorded; `dataset` is left out,
    since the frames are yours, and `ahead` and `resume` mean nothing here. Raises ConfigError for a name or a value
    that there is not.

    Several threads may share one: `add` and `instances` wait for each other. Whoever reads `scene` while another thread
    may be in `add` holds `lock` meanwhile, `with mapper.lock: mesh = mapper.scene.mesh()`: half a frame may be in it.
    """

    scene: SceneMap  # the map: mesh(), render(), instances(), save()
    lock: threading.RLock  # held while a frame is mapped

    def __init__(self, *overrides: str) -> None:
        for override in overrides:
            if not isinstance(override, str):
                raise ConfigError(f"Mapper takes words such as 'fuser.voxel_size=0.02', found {override!r}")
            if override.lstrip("+~").startswith(("dataset", "hydra", "experiment", "sequences", "launcher")):
                raise ConfigError(f"Mapper: {override} is of a run on the command line; here the frames are yours")
        config = composed("~dataset", *overrides)
        Settings.of(config).apply()
        self.pipeline = pipeline_of(config)
        if config.map is not None:
            go_on(self.pipeline, checked_path("map", config.map))
        warn_outside_domain(self.pipeline.detector, None)
        self.scene = self.pipeline.fuser.scene
        self._journal = Journal(self.scene, 0, self.pipeline.tracker.pose_source)
        self.lock = threading.RLock()

    def add(self, frame: Frame) -> Pose:
        """Detects, tracks, refines and fuses one frame; the frames of a video in their order.

        Returns the camera's pose; one that is lost was not fused, and the next frames may be found again. Raises
        FrameError when the frame cannot be used, as one without a pose where poses are given, which leaves the map as
        it was, and MapFullError at the end of `fuser.max_blocks`.
        """
        if not isinstance(frame, Frame):
            raise DataError(f"Mapper.add takes an instancemap.Frame, found {type(frame).__name__}")
        with self.lock:
            self._journal.timings.clear()  # nobody asks for them, or for the poses, and a camera may run for days
            self._journal.tracked.clear()
            return self.pipeline.map_frame(frame, self.pipeline.detector.detect(frame), self._journal)

    def instances(self) -> Mapping[int, Instance]:
        """The objects found so far, by id; `scene.classes` names their classes, `scene.mesh()` has their vertices."""
        with self.lock:
            return self.scene.instances()

    def __getstate__(self) -> dict[str, Any]:
        with self.lock:
            return {name: value for name, value in vars(self).items() if name != "lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, lock=threading.RLock())


def load_map(path: Path | str) -> SceneMap:
    """The map that a run left behind as map.npz, or that `SceneMap.save` wrote, of whatever fuser.

    Raises DataError when the file is none or was damaged.
    """
    from framework.mapping import instance_map
    from framework.mapping.map_file import read_format
    from framework.rivals import object_map, open3d_map, semantic_map

    kinds: dict[str, type[SceneMap]] = {
        str(instance_map.FORMAT): instance_map.InstanceMap,
        object_map.FORMAT: object_map.ObjectMap,
        open3d_map.FORMAT: open3d_map.Open3DMap,
        semantic_map.FORMAT: semantic_map.SemanticMap,
    }
    return kinds.get(read_format(path), instance_map.InstanceMap).load(path)
