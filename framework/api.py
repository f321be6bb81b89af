"""Mapping from Python: the same stages, names and defaults as on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from weakref import finalize

from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig

from framework.compilation.catalog import compile_for_run
from framework.config.composition import composed
from framework.config.validation import checked_path
from framework.data import (
    Camera,
    Detections,
    Float32,
    Float64,
    Frame,
    Instance,
    InstanceMesh,
    PointClusters,
    Pose,
    UInt8,
    View,
)
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.detection.domain import warn_outside_domain
from framework.detection.stored.cache import with_cache
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, MapFullError
from framework.interfaces import (
    ClusterRefiner,
    Detector,
    Gravity,
    LiveVideo,
    MapFuser,
    MapStatistics,
    PoseTracker,
    RGBDSequence,
    SceneMap,
    Viewer,
)
from framework.pipeline import Pipeline
from framework.queries.map_queries import Map
from framework.queries.text_search import Match, QueryResult, TextQuery, search
from framework.registry import build
from framework.runs.stored_runs import KEYFRAMES, MAP
from framework.runtime.cpu_budget import limited_threads
from framework.runtime.process_settings import Settings, configure_process
from framework.runtime.run_log import Journal
from framework.tracking.keyframes import read_keyframes

__all__ = [
    "Camera",
    "ClusterRefiner",
    "ConfigError",
    "DataError",
    "Detections",
    "Detector",
    "Frame",
    "FrameError",
    "FrameResult",
    "Gravity",
    "Instance",
    "InstanceMapError",
    "InstanceMesh",
    "LiveVideo",
    "Map",
    "MapFullError",
    "MapFuser",
    "MapStatistics",
    "Mapper",
    "Match",
    "Pipeline",
    "PointClusters",
    "Pose",
    "PoseTracker",
    "QueryResult",
    "RGBDSequence",
    "SceneMap",
    "View",
    "Viewer",
    "configure_process",
    "export",
    "load_map",
    "open_dataset",
    "query",
]


def pipeline_of(config: DictConfig) -> Pipeline:
    """The stages that a config names, the detector behind the cache that it asks for."""
    fuser, refiner = build(MapFuser, config.get("fuser")), build(ClusterRefiner, config.get("refiner"))
    tracker = build(PoseTracker, config.get("tracker"))
    viewer = build(Viewer, config.get("viewer"))
    detector = with_cache(build(Detector, config.get("detector")), config)  # last, as loading a network takes its time
    return Pipeline(detector, tracker, refiner, fuser, config.prefetch, viewer)


def resume_map(pipeline: Pipeline, run: Path) -> None:
    """Has a pipeline that has mapped nothing go on with the map of a stored run.

    The tracker says that it is lost until it finds itself in that map. Raises DataError where the run has left no map
    that can be read, ConfigError where the stages cannot go on with it.
    """
    scene = scene_of("resume_from", run)
    pipeline.fuser.resume(scene)
    pipeline.tracker.load_keyframes(read_keyframes(run / KEYFRAMES), scene)


def begin_in(pipeline: Pipeline, run: Path) -> None:
    """Has a pipeline make a map of its own in the world of a stored run, in whose map the tracker first finds itself.

    Raises likewise.
    """
    pipeline.tracker.load_keyframes(read_keyframes(run / KEYFRAMES), scene_of("localize_in", run))


def begin(config: DictConfig) -> Pipeline:
    """The stages that a config names, with the map or the world that it asks for and their kernels compiled."""
    pipeline = pipeline_of(config)
    map_, world = config.get("resume_from"), config.get("localize_in")
    if map_ is not None and world is not None:
        raise ConfigError("resume_from and localize_in: expected at most one of them, got both")
    if map_ is not None:
        resume_map(pipeline, checked_path("resume_from", map_))
    if world is not None:
        begin_in(pipeline, checked_path("localize_in", world))
    compile_for_run()
    return pipeline


def scene_of(key: str, run: Path) -> SceneMap:
    """The map of a stored run. Raises DataError, which begins with `key`, where there is none that can be read."""
    if not (run / MAP).is_file():
        raise DataError(f"{key}: there is no {run / MAP}: expected the directory of a run")
    return load_scene(run / MAP)


@dataclass(frozen=True)
class FrameResult(Pose):
    """What became of a frame: the camera's pose, or that it is lost, and which objects there are since."""

    new: tuple[int, ...] = ()  # ids of objects that count from this frame on
    removed: tuple[int, ...] = ()  # ids that no longer count: merged with another object, or outvoted


class Mapper(Map):
    """Maps frames as they come: `Mapper("fuser.voxel_size=0.02", detector="mask_rcnn")`.

    The arguments are those of a run on the command line, as words or by name, with its defaults for what is recorded;
    `dataset` is left out, since the frames are yours, and `prefetch` and `skip_completed` mean nothing here.
    `resume_from=DIR` goes on with the map of the run in DIR, `viewer="rerun"` shows it, in `recording.rrd` in the
    working directory or as `viewer.mode` says, until the mapper is gone. Raises ConfigError for a name or a value that
    there is not.

    Several threads may share one: they wait for each other. Whoever reads `scene` itself while another thread may be in
    `add` holds `lock` meanwhile, `with mapper.lock: mesh = mapper.scene.mesh()`: half a frame may be in it.
    """

    def __init__(self, *overrides: str, **named: object) -> None:
        words = [*overrides, *(_override(name, value) for name, value in named.items())]
        for override in words:
            if not isinstance(override, str):
                raise ConfigError(f"Mapper takes words such as 'fuser.voxel_size=0.02', found {override!r}")
            if override.lstrip("+~").startswith(("dataset", "hydra", "experiment", "sequences", "launcher")):
                raise ConfigError(f"Mapper: {override} is of a run on the command line; here the frames are yours")
        config = composed("~dataset", *words)
        self._threads = Settings.of(config).threads
        self.pipeline = begin(config)
        warn_outside_domain(self.pipeline.detector, None)
        super().__init__(self.pipeline.fuser.scene)
        self._journal = Journal(self.scene, 0, self.pipeline.tracker.pose_source)
        viewer = self.pipeline.viewer
        viewer.begin(self.scene, "frames from Python", Path())
        finalize(self, viewer.end)  # with this mapper, or with the program
        self._camera: Camera | None = None  # of the last frame
        self._T_world_camera: Float64 | None = None  # of the last frame that was not lost
        self._frames = 0  # that `add` was given

    def add(
        self,
        color: UInt8 | Frame,
        depth: Float32 | None = None,
        pose: Float64 | None = None,
        camera: Camera | None = None,
        timestamp: float | None = None,
        up: Float64 | None = None,
    ) -> FrameResult:
        """Detects, tracks, refines and fuses one frame; the frames of a video in their order.

        `color` (H, W, 3) is uint8 RGB, `depth` (H, W) float32 m along z, 0 = no reading, `pose` (4, 4) T_world_camera
        where it is known, `camera` that of the last frame where none is given, `timestamp` s, 30 frames a second where
        none is given, `up` (3,) the unit vector against gravity in the camera where a sensor tells it; or `color` is a
        Frame, with all of that.

        A frame that is lost was not fused, and the next ones may be found again. Raises FrameError when the frame
        cannot be used, as one without a pose where poses are given, which leaves the map as it was, DataError for
        arrays that are no frame, and MapFullError at the end of `fuser.max_blocks`.
        """
        with self.lock, limited_threads(self._threads):
            frame = color if isinstance(color, Frame) else self._frame(color, depth, pose, camera, timestamp, up)
            self._camera = frame.camera
            self._frames += 1
            self._journal.timings.clear()  # nobody asks for them, or for the poses, and a camera may run for days
            self._journal.tracked.clear()
            before = self.scene.instance_ids()
            found = self._map(frame)
            if found.lost:
                return FrameResult(found.T_world_camera, lost=True, reason=found.reason)
            self._T_world_camera = found.T_world_camera
            now = self.scene.instance_ids()
        return FrameResult(found.T_world_camera, new=tuple(sorted(now - before)), removed=tuple(sorted(before - now)))

    def _map(self, frame: Frame) -> Pose:
        """Detects and maps a frame, and has the viewer show it."""
        pipeline, journal = self.pipeline, self._journal
        try:
            with journal.timed(frame.index, "detect"):
                detections = pipeline.detector.detect(frame)
            pose = pipeline.map_frame(frame, detections, journal)
        except FrameError as error:
            pipeline.viewer.skip(str(error))
            raise
        pipeline.viewer.show(frame, detections, pose, journal.stage_ms(frame.index))
        return pose

    def _frame(
        self,
        color: UInt8,
        depth: Float32 | None,
        pose: Float64 | None,
        camera: Camera | None,
        timestamp: float | None,
        up: Float64 | None,
    ) -> Frame:
        camera = camera or self._camera
        if depth is None:
            raise DataError(f"Mapper.add takes a Frame, or colour and depth, found {type(color).__name__} alone")
        if camera is None:
            raise DataError("Mapper.add needs the camera once: camera=Camera(width, height, fx, fy, cx, cy)")
        when = self._frames / FRAME_RATE if timestamp is None else timestamp
        return Frame(self._frames, when, color, depth, camera, pose, up=up)

    def at_pixel(
        self, u: int, v: int, camera: Camera | None = None, T_world_camera: Float64 | None = None
    ) -> Instance | None:
        """The object at pixel (u, v) of the last frame that was not lost, or of what `camera` would see from elsewhere.

        None where there is none. Raises DataError for a pixel outside the image, or before there is any frame.
        """
        camera = camera or self._camera
        T_world_camera = self._T_world_camera if T_world_camera is None else T_world_camera
        if camera is None or T_world_camera is None:
            raise DataError("nothing is mapped yet, so that there is no last frame")
        return super().at_pixel(u, v, camera, T_world_camera)


def _override(name: str, value: object) -> str:
    """A keyword as a word of the command line."""
    if value is None or isinstance(value, bool | int | float):
        return f"{name}={'null' if value is None else value}"
    if isinstance(value, str | Path):
        return f"{name}={QuotedString(str(value), Quote.single).with_quotes()}"
    raise ConfigError(f"{name} must be a name, a number, true, false or None, found {value!r:.60}")


def open_dataset(name: str, **parameters: object) -> RGBDSequence:
    """A recording, to be gone through frame by frame: `open_dataset("rgbd_folder", root="DIR", stride=2)`.

    The name and the parameters are those of `dataset=` on the command line. Raises ConfigError for what there is not,
    DataError for a recording that cannot be read.
    """
    words = [_override("dataset", name), *(_override(f"dataset.{key}", value) for key, value in parameters.items())]
    return build(RGBDSequence, composed(*words).dataset)


def load_map(path: Path | str) -> Map:
    """The map that a run left behind as map.npz, or that `save` wrote, of whatever fuser.

    Raises DataError when the file is none or was damaged.
    """
    return Map(load_scene(path))


def export(
    run: Path | str,
    *formats: str,
    out: Path | str | None = None,
    objects: Sequence[str | int] = (),
    up: Sequence[float] | None = None,
    floor: float | None = None,
    **choices: object,
) -> list[Path]:
    """Writes what a run found as "glb", "ply", "usd", "obj", "floorplan" or "graph", and returns the files.

    `export("outputs/demo", "glb", objects=["chair", 7])`: `objects` are classes or ids, () = all and the room around
    them; `out` is a folder, None = `export` in the run's. `choices` are min_confidence, triangles, coloring, collision,
    resolution and robot_height, as `instancemap export --help` says of them. `up` (3,) and `floor`, m along up, say
    what the run does not tell. Raises ConfigError for a word that there is not, DataError for a run that cannot be
    exported.
    """
    from framework.exporting import exports

    kinds = [exports.one_of(exports.ExportFormat, "a format", one) for one in formats]
    chosen = exports.Chosen.named(objects, **choices)
    return exports.export(Path(run), kinds, None if out is None else Path(out), chosen, up, floor)


def query(run: Map | Path | str, words: str, by: str | None = None, model: Path | str | None = None) -> QueryResult:
    """The objects of a run, or of a map, that words mean, best first: `query("outputs/demo", "a red chair").objects`.

    `by` "embeddings" compares the words with the objects' pictures, through `model`, a folder, a file or an id on
    huggingface.co, None = that of the run's detector; "names" with class names and measured colours; None is
    embeddings where there are any, else names. Of a map that is no run's, `model` is to be named.

    Raises ConfigError for a question that is none, DataError for a run without a map, for words that nothing in it is
    called, and for embeddings that are not there or of another model.
    """
    question = TextQuery(words, by, None if model is None else str(model))
    if isinstance(run, Map):
        return search(run, question)
    return search(Map(scene_of("query", Path(run))), question, Path(run))


def load_scene(path: Path | str) -> SceneMap:
    """The same as `load_map`, for who goes on with the map itself."""
    from framework.baselines import object_map, open3d_map, semantic_map
    from framework.mapping import instance_map
    from framework.mapping.storage.map_file import read_format

    kinds: dict[str, type[SceneMap]] = {
        str(instance_map.FORMAT): instance_map.InstanceMap,
        object_map.FORMAT: object_map.ObjectMap,
        open3d_map.FORMAT: open3d_map.Open3DMap,
        semantic_map.FORMAT: semantic_map.SemanticMap,
    }
    return kinds.get(read_format(path), instance_map.InstanceMap).load(path)
