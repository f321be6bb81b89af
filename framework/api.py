"""Python API with the stages, names and defaults of the command line."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from weakref import finalize

import numpy as np
from hydra.core.override_parser.types import Quote, QuotedString
from omegaconf import DictConfig

from framework.checking.image_geometry import warn_of_camera
from framework.compilation.catalog import compile_for_run
from framework.config.composition import composed, composed_with_choices, config_errors, resolved
from framework.config.text_values import literal
from framework.config.validation import checked_path, without_interpolation
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
    Structure,
    UInt8,
    View,
)
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.detection.domain import warn_outside_domain
from framework.detection.map_classes import with_classes_of_map
from framework.detection.stored.cache import with_cache
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, MapFullError, errors_of
from framework.files.folders.directory_lock import locked
from framework.files.folders.staged_files import finish_replacement
from framework.files.search_paths import usable_path
from framework.geometry import camera_of, pose_of
from framework.interfaces import (
    BackEnd,
    ClosedLoop,
    ClusterRefiner,
    DepthCalibrator,
    Detector,
    FrameMasking,
    GraphAnchor,
    Gravity,
    LiveVideo,
    MapFuser,
    MapStatistics,
    PoseTracker,
    RGBDSequence,
    SceneMap,
    StageTimer,
    SubmapChange,
    SubmapGraph,
    SubmapSurfaces,
    Viewer,
    untimed,
)
from framework.live_view.guarded_viewer import watched_run
from framework.pipeline import Pipeline, watched
from framework.pose_graph.depth_distortion_file import read_depth_distortion
from framework.queries.map_queries import Map
from framework.queries.text_search import Match, QueryResult, TextQuery, search
from framework.registry import build, text_kind
from framework.runs.data_frame import load_runs
from framework.runs.run_directory import write_run
from framework.runs.stored_runs import DEPTH_DISTORTION, KEYFRAMES, MAP, REPORT
from framework.runtime.cpu_budget import limited_threads
from framework.runtime.forked_process import check_not_forked
from framework.runtime.process_settings import Settings, configure_process
from framework.runtime.run_log import Journal
from framework.sensors.depth_distortion import DepthDistortion
from framework.sensors.noise_models import SensorKind
from framework.tables.experiment_tables import write_tables
from framework.tracking.keyframes import read_keyframes
from framework.vocabulary.label_spaces import ClassNames

__all__ = [
    "BackEnd",
    "Camera",
    "ClosedLoop",
    "ClusterRefiner",
    "ConfigError",
    "DataError",
    "DepthCalibrator",
    "DepthDistortion",
    "Detections",
    "Detector",
    "Frame",
    "FrameError",
    "FrameMasking",
    "FrameResult",
    "GraphAnchor",
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
    "SensorKind",
    "StageTimer",
    "Structure",
    "SubmapChange",
    "SubmapGraph",
    "SubmapSurfaces",
    "View",
    "Viewer",
    "configure_process",
    "edit",
    "export",
    "import_map",
    "load_map",
    "load_runs",
    "open_dataset",
    "query",
    "report",
    "run",
    "tables",
    "untimed",
]

OF_COMMAND_LINE = ("experiment", "hydra", "launcher")
"""Config groups that only the command line supports."""

LATEST_TIME = 1e11  # s, maximum absolute timestamp, in the year 5138; timestamps in ms, us or ns are larger

log = logging.getLogger(__name__)


def begin(config: DictConfig) -> Pipeline:
    """Build the pipeline of a config, and compile the kernels.

    With `resume_from` or `localize_in`, the stored map is loaded. The tracker then reports lost poses until it
    relocalizes.

    Raises:
        ConfigError: The stages are incompatible with the stored map.
        DataError: The stored map cannot be read.
    """
    fuser, refiner = build(MapFuser, config.get("fuser")), build(ClusterRefiner, config.get("refiner"))
    tracker = build(PoseTracker, config.get("tracker"))
    masking, backend = build(FrameMasking, config.get("masking")), build(BackEnd, config.get("backend"))
    viewer = build(Viewer, config.get("viewer"))
    classes: tuple[str, ...] = ()
    resumed, distortion = False, None
    chosen = {key: config.get(key) for key in ("resume_from", "localize_in") if config.get(key) is not None}
    if len(chosen) > 1:
        raise ConfigError("resume_from and localize_in: expected at most one of these keys, got both; remove one")
    for key, value in chosen.items():
        run = checked_path(key, value)
        scene = scene_of(key, run)
        if key == "resume_from":
            fuser.resume(scene)
            backend.resume()
            classes, resumed = scene.classes, True
        distortion = read_depth_distortion(run / DEPTH_DISTORTION)
        keyframes = read_keyframes(run / KEYFRAMES)
        with errors_of(run / KEYFRAMES):
            tracker.load_keyframes(keyframes, scene)
    if config.get("depth_distortion_from") is not None:
        run = checked_path("depth_distortion_from", config.depth_distortion_from)
        distortion = read_depth_distortion(run / DEPTH_DISTORTION)
        if distortion is None:
            raise DataError(
                f"depth_distortion_from: expected a run directory with {DEPTH_DISTORTION}, got {run} without it; name "
                "a run whose log reports a correction of depth"
            )
    detector = build(Detector, config.get("detector"))  # last, because loading a network is slow
    detector = with_cache(with_classes_of_map(detector, classes), config)
    compile_for_run()
    pipeline = Pipeline(
        detector, tracker, refiner, fuser, config.prefetch, viewer, config.detection_interval, masking, backend
    )
    pipeline.resumed, pipeline.depth_distortion = resumed, distortion
    return pipeline


def scene_of(key: str, run: Path) -> SceneMap:
    """Read the map of a stored run.

    Args:
        key: Config key or command, for error messages.
        run: Run directory.

    Raises:
        DataError: The map is missing or cannot be read.
    """
    finish_replacement(run)
    if not (run / MAP).is_file():
        raise DataError(
            f"{key}: expected a run directory with {MAP}, got {run} without it (imported maps have only a mesh)"
        )
    return load_scene(run / MAP)


@dataclass(frozen=True)
class FrameResult(Pose):
    """The pose of a frame, its tracking state, and the new and removed objects."""

    new: tuple[int, ...] = ()  # ids of objects added by this frame
    removed: tuple[int, ...] = ()  # ids of objects removed by this frame: merged, or no longer confirmed


class Mapper(Map):
    """Incremental mapping, frame by frame.

    Example: `Mapper("fuser.voxel_size=0.02", detector="mask_rcnn")`. The arguments are the overrides of a run on the
    command line, as strings or as keywords. The defaults are those of a run.

    Overrides of `dataset` are not supported. `prefetch` and `skip_completed` have no effect. `resume_from=DIR` resumes
    the map of a run. `viewer="rerun"` records or shows the map until the mapper is deleted.

    All methods are thread-safe. While another thread may call `add`, hold the lock to read `scene` itself:
    `with mapper.lock: mesh = mapper.scene.mesh()`. A process that was forked after mapping began cannot use a mapper
    or map; start it with the multiprocessing method "spawn".

    Raises:
        ConfigError: A name is unknown, or a value is invalid.
        DataError: The map of `resume_from` or `localize_in` cannot be read.
    """

    def __init__(self, *overrides: str, **named: object) -> None:
        words = _overrides("Mapper", overrides, named)
        for override in words:
            if override.lstrip("+~").startswith(("dataset", "sequences", *OF_COMMAND_LINE)):
                raise ConfigError(
                    f"Mapper: expected an override of a stage or setting, got {override}; use dataset, experiment, "
                    "sequences, launcher and hydra overrides only on the command line"
                )
        config = composed("~dataset", *words)
        self._threads = Settings.of(config).threads
        check_not_forked()
        self.pipeline = begin(config)
        warn_outside_domain(self.pipeline.detector, None)
        super().__init__(self.pipeline.fuser.scene)
        self._journal = Journal(self.scene, 0, self.pipeline.tracker.pose_source)
        with ExitStack() as viewing:
            viewing.enter_context(watched_run(self.pipeline.viewer, Path(), resolved(config)))
            viewing.enter_context(watched(self.pipeline.viewer, self.scene, "frames from Python", Path()))
            finalize(self, viewing.pop_all().close)  # when the mapper is deleted, or at exit
        self._camera: Camera | None = None  # camera of the last frame
        self._sensor = SensorKind.KINECT_V1  # kind of depth sensor of the last frame
        self._T_world_color: Float64 | None = None  # (4, 4) pose of the color image of the last mapped frame
        self._frames = 0  # number of calls of `add`
        self._posed_frames = 0  # number of calls of `add` with a pose

    def add(
        self,
        color: UInt8 | Frame,
        depth: Float32 | None = None,
        pose: Float64 | None = None,
        camera: Camera | Float64 | None = None,
        timestamp: float | None = None,
        up: Float64 | None = None,
        depth_timestamp: float | None = None,
        sensor: SensorKind | None = None,
        odometry: Float64 | None = None,
    ) -> FrameResult:
        """Detect, track, refine and fuse the next frame of a video. A lost frame is not fused.

        Args:
            color: RGB image (H, W, 3), uint8, or a Frame, which replaces all other arguments.
            depth: Depth image (H, W), float32, m along z; 0 = no reading.
            pose: Camera pose T_world_camera (4, 4) or (3, 4), m; None = unknown. Most trackers use only the pose of
                the first frame, which defines the world frame. `tracker="ground_truth"` uses all poses.
            camera: The camera, or the intrinsic matrix (3, 3) of this image, px, also padded to (3, 4) or (4, 4);
                None = the camera of the last frame.
            timestamp: Time of the color image, s; None = the frame number (from 0) / 30.
            up: Up direction (3,) in the camera frame, a unit vector; None = unknown.
            depth_timestamp: Time of the depth image, s; None = the time of the color image.
            sensor: The kind of depth sensor; None = the kind of the last frame, initially KINECT_V1.
            odometry: (4, 4) T_odom_camera, the pose of the camera in any fixed frame by odometry; None = unknown.

        Returns:
            The pose of the frame, and the new and removed objects.

        Raises:
            FrameError: The frame is unusable, for example because a required pose is missing. The map is unchanged.
            DataError: The arrays do not form a frame, or the index of the Frame is not larger than those before.
            MapFullError: The map has reached `fuser.max_blocks`.
        """
        with self.lock, limited_threads(self._threads):
            if isinstance(color, Frame):
                frame = color
            else:
                if depth is None:
                    raise DataError(
                        f"Mapper.add: expected a Frame, or color and depth, got only {type(color).__name__}"
                    )
                used = self._camera if camera is None else camera_of(camera, color)
                if used is None:
                    raise DataError(
                        "Mapper.add: expected a camera in the first call, got none; pass camera=Camera(width, height, "
                        "fx, fy, cx, cy) or camera=K"
                    )
                if used != self._camera:
                    warn_of_camera(used)
                index = max(self._frames, self._journal.last_index + 1)  # a Frame of the caller may be ahead
                T_world_camera, T_odom_camera = (
                    None if T is None else pose_of(f"frame {index}", T) for T in (pose, odometry)
                )
                time = index / FRAME_RATE if timestamp is None else timestamp
                frame = Frame(
                    index, time, color, depth, used, T_world_camera, up=up, depth_timestamp=depth_timestamp,
                    sensor=sensor or self._sensor, T_odom_camera=T_odom_camera,
                )  # fmt: skip
                if pose is not None:
                    self._warn_of_ignored_pose()
            if max(abs(frame.timestamp), abs(frame.color_time), abs(frame.depth_time)) > LATEST_TIME:
                raise DataError(
                    f"frame {frame.index}: timestamp: expected a time within {LATEST_TIME:g} s, got "
                    f"{frame.timestamp:g} s; pass seconds, such as nanoseconds / 1e9"
                )
            self._camera, self._sensor = frame.camera, frame.sensor
            self._frames += 1
            self._journal.forget_frames()  # they would grow without limit for a live camera
            before = self.scene.instance_ids()
            found = self._map(frame)
            if found.lost:
                return FrameResult(found.T_world_camera, lost=True, reason=found.reason)
            self._T_world_color = self.pipeline.T_world_color
            now = self.scene.instance_ids()
        if now is before:  # usual case
            return FrameResult(found.T_world_camera, covariance=found.covariance)
        return FrameResult(
            found.T_world_camera, covariance=found.covariance,
            new=tuple(sorted(now - before)), removed=tuple(sorted(before - now)),
        )  # fmt: skip

    def finish(self) -> None:
        """Apply the last correction of the map. Call it after the last frame.

        The back end corrects the map some frames after the camera has returned to a place. Poses that `add` returned
        before a correction are not corrected.

        Raises:
            MapFullError: The map has reached `fuser.max_blocks`.
        """
        with self.lock, limited_threads(self._threads):
            self.pipeline.finish(self._journal)
            if self._journal.stopped_by is not None:
                raise self._journal.stopped_by

    def _warn_of_ignored_pose(self) -> None:
        """Log a warning at the second pose that the tracker ignores."""
        tracker = self.pipeline.tracker
        self._posed_frames += 1
        if self._posed_frames == 2 and tracker.pose_source != "ground_truth":
            log.warning(
                "Mapper.add: pose: expected a tracker that uses given poses, got %s, which uses only the first; "
                'set tracker="ground_truth", or omit pose after the first frame',
                type(tracker).__name__,
            )

    def _map(self, frame: Frame) -> Pose:
        pipeline, journal = self.pipeline, self._journal
        try:
            frame = pipeline.corrected(frame)
            detections, times = pipeline.detect(frame, self._frames - 1)
            journal.record(times)
            return pipeline.map_frame(frame, detections, journal)
        except FrameError as error:
            pipeline.viewer.skip(str(error))
            raise

    def at_pixel(
        self, u: int, v: int, camera: Camera | None = None, T_world_camera: Float64 | None = None
    ) -> Instance | None:
        """Return the object at a pixel of the last mapped frame, or of the view from another camera or pose.

        Args:
            u: The column of the pixel, px.
            v: The row of the pixel, px.
            camera: The camera; None = the camera of the last frame.
            T_world_camera: The pose (4, 4); None = the pose of the color image of the last mapped frame.

        Returns:
            The object; None = no object.

        Raises:
            DataError: The pixel is outside of the image, or no frame has been mapped.
        """
        camera = camera or self._camera
        T_world_camera = self._T_world_color if T_world_camera is None else T_world_camera
        if camera is None or T_world_camera is None:
            raise DataError("Mapper.at_pixel: expected a mapped frame, got none; call add first")
        return super().at_pixel(u, v, camera, T_world_camera)


def _overrides(where: str, overrides: Sequence[str], named: Mapping[str, object]) -> list[str]:
    words = [*overrides, *(_override(name, value) for name, value in named.items())]
    _check_overrides(where, words)
    with config_errors():
        return literal(words, text_kind)


def _check_overrides(where: str, words: Sequence[str]) -> None:
    for override in words:
        if not isinstance(cast(object, override), str):
            raise ConfigError(f"{where}: expected overrides such as 'fuser.voxel_size=0.02', got {override!r:.60}")


def _override(name: str, value: object) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float):
        return f"{name}={'null' if value is None else value}"
    if isinstance(value, str | Path):
        text = without_interpolation(str(value))  # a value in Python is no reference
        return f"{name}={QuotedString(text, Quote.single).with_quotes()}"
    raise ConfigError(f"{name}: expected a string, path, number, bool or None, got {value!r:.60}")


def open_dataset(name: str, **parameters: object) -> RGBDSequence:
    """Open an RGB-D sequence.

    Example: `open_dataset("rgbd_folder", root="DIR", stride=2)`.

    Args:
        name: An option of `dataset=` on the command line.
        parameters: The parameters of the option.

    Returns:
        The sequence.

    Raises:
        ConfigError: The option or a parameter is unknown.
        DataError: The sequence cannot be read.
    """
    words = [_override("dataset", name), *(_override(f"dataset.{key}", value) for key, value in parameters.items())]
    return build(RGBDSequence, composed(*words).dataset)


def run(directory: Path | str, *overrides: str, **named: object) -> Path:
    """Map a sequence and write a run directory, like the command `instancemap`.

    The global random generators of Python, numpy and torch are seeded, because plugins may use them.

    Example: `run("outputs/demo", "fuser.voxel_size=0.02", dataset="desk")`.

    Args:
        directory: The new run directory.
        overrides: The overrides of the command line, such as "dataset.root=DIR". Experiments, launchers and Hydra's own
            settings are not supported.
        named: Overrides as keywords.

    Returns:
        The run directory.

    Raises:
        ConfigError: A name is unknown, or a value is invalid.
        DataError: The directory is not empty, the sequence cannot be read, or no frame could be mapped.
        PartialRunError: An error ended the run early. The outputs are those of the mapped frames.
    """
    from framework.files.folders.restartable_folder import check_new

    words = _overrides("run", overrides, named)
    for override in words:
        if override.lstrip("+~").startswith(OF_COMMAND_LINE):
            raise ConfigError(
                f"run: expected an override of a single run, got {override}; use {', '.join(OF_COMMAND_LINE)} "
                "overrides only on the command line"
            )
    target = usable_path("directory", directory)
    check_new(target)
    config, choices = composed_with_choices(*words)
    settings = Settings.of(config)
    with locked(target), limited_threads(settings.threads):
        check_new(target)  # another process may have finished a run
        settings.seed_generators()
        write_run(begin(config), config, target, choices).check()
    return target


def report(run: Path | str, out: Path | str | None = None) -> Path:
    """Write an interactive HTML report of a run.

    Args:
        run: The run directory.
        out: The file; None = `report.html` in the run directory.

    Returns:
        The path of the file.

    Raises:
        DataError: The run cannot be read, or the file cannot be written.
    """
    from framework.reporting.markup import write_page
    from framework.reporting.run_contents import RunContents
    from framework.reporting.run_page import RunReport

    source = usable_path("run", run)
    path = source / REPORT if out is None else usable_path("out", out)
    page = RunReport.of(RunContents.read(source)).html()
    write_page(path, page)
    return path


def tables(directory: Path | str, *overrides: str) -> str:
    """Write table.md, table.tex and table.csv of the runs below a folder, and return the Markdown text.

    Args:
        directory: The folder. The runs are in this folder and its subfolders.
        overrides: Settings of the table, such as "table.columns=[instances.ap50]".

    Raises:
        DataError: No run is complete.
        ConfigError: A setting is invalid.
    """
    _check_overrides("tables", overrides)
    return write_tables(usable_path("directory", directory), overrides)


def load_map(path: Path | str) -> Map:
    """Read a map of any fuser, written by a run or `Map.save`.

    Args:
        path: The file, such as map.npz of a run.

    Returns:
        The map.

    Raises:
        DataError: The file is missing, damaged or not a map.
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
    """Export a run to standard 3D and map formats.

    Example: `export("outputs/demo", "glb", objects=["chair", 7])`.

    Args:
        run: The run directory.
        formats: "glb", "ply", "usd", "obj", "floorplan" or "graph", or predictions for benchmarks: "scannet" or "npz".
        out: The output folder; None = `export` in the run directory.
        objects: Classes or ids of the exported objects; () = the whole scene.
        up: The up direction (3,) in the world frame; None = the up direction of the run.
        floor: The floor height along the up direction, m; None = the floor height of the run, or unknown if `up` is
            given.
        choices: min_probability, triangles, coloring, collision, resolution, robot_height, label_space, points; see
            `instancemap export --help`.

    Returns:
        The paths of the files.

    Raises:
        ConfigError: A name is unknown, or a value is invalid.
        DataError: The run cannot be exported.
    """
    from framework.exporting import exports

    kinds = [exports.one_of(exports.ExportFormat, "a format", one) for one in formats]
    chosen = exports.Chosen.named(objects, **choices)
    target = None if out is None else usable_path("out", out)
    return exports.export(usable_path("run", run), kinds, target, chosen, up, floor)


def edit(run: Path | str, edits: Sequence[Mapping[str, Any]] | Path | str, out: Path | str | None = None) -> Path:
    """Merge, split, rename and delete instances of a run, and write a new run directory with the edited map.

    Example: `edit("outputs/demo", [{"merge": [3, 7]}, {"rename": [4, "chair"]}])`.

    Args:
        run: The run directory.
        edits: The edits, in order: entries as in the file format of `instancemap edit --edits`, or such a file.
        out: The new run directory; None = the run directory with the suffix `_edited`.

    Returns:
        The new run directory.

    Raises:
        DataError: The new run directory is not empty, the run cannot be edited, or an edit is invalid.
    """
    from framework.editing import edited_run
    from framework.editing.edits import edits_of, read_edits
    from framework.editing.opened_run import check_empty

    source = usable_path("run", run)
    directory = edited_run.default_directory(source) if out is None else usable_path("out", out)
    check_empty(directory)
    entries = read_edits(usable_path("edits", edits)) if isinstance(edits, str | Path) else edits_of("edits", edits)
    edited_run.EditedRun.of(source, entries).write(directory)
    return directory


def import_map(
    mesh: Path | str,
    directory: Path | str,
    *overrides: str,
    name: str | None = None,
    labels: Path | str | None = None,
    label_space: Path | str | None = None,
    class_names: str = "AUTO",
    instance_property: str | None = None,
    class_property: str | None = None,
    no_instance: int = 0,
    scale: float = 1.0,
    transform: Float64 | Path | str | None = None,
    up: Sequence[float] | None = None,
) -> Path:
    """Convert the map of another system to a run directory for tables, reports, `load_runs` and `export`.

    Changes and assumptions, such as instances that are left out, are logged as warnings.

    Example: `import_map("other.ply", "outputs/other", "dataset=desk", label_space="nyu40")`.

    Args:
        mesh: A PLY file, or points (V, 3) in an NPY file, in the world frame of the ground truth.
        directory: The new run directory.
        overrides: The dataset to compare with, as on the command line: "dataset=NAME", "dataset.KEY=VALUE",
            "evaluation.KEY=VALUE", "seed=N".
        name: The name of the row in tables; None = the name of the directory.
        labels: A JSON or CSV file with the class and confidence of each instance id, ScanNet predictions (text file or
            its folder), or a mask folder; None = properties of the mesh.
        label_space: The names of class ids: a label space such as "nyu40", or a text or JSON file; None = NYU40 for
            ScanNet predictions, otherwise none.
        class_names: "COCO" (instances of other classes are left out), "OWN" (the given names), or "AUTO" (OWN if a name
            is in no known label space, if none has a COCO class, or if `evaluation.label_space` is not COCO; otherwise
            COCO).
        instance_property: The property of the PLY file with instance ids; None = detected by name.
        class_property: The property with class ids; None = detected by name; "" = no classes.
        no_instance: The id of points without an instance.
        scale: The number of meters per unit of the mesh, > 0.
        transform: T_world_map (4, 4), applied after `scale`, or a text file; None = identity.
        up: The up direction (3,) in the world frame; None = unknown.

    Returns:
        The run directory.

    Raises:
        ConfigError: An argument is invalid.
        DataError: The directory is not empty, a file is missing or invalid, or no instance is left.
    """
    from framework.runs.external_maps.map_import import MapImport
    from framework.runs.external_maps.ply_instances import LabelProperties

    if class_names not in ClassNames.__members__:
        known = ", ".join(ClassNames.__members__)
        raise ConfigError(f"class_names: expected one of {known}, got {class_names!r:.60}")
    chosen = MapImport(
        mesh=usable_path("mesh", mesh),
        labels=None if labels is None else usable_path("labels", labels),
        label_space=None if label_space is None else str(label_space),
        class_names=ClassNames[class_names],
        properties=LabelProperties(instance_property, class_property, no_instance),
        scale=scale,
        transform=usable_path("transform", transform) if isinstance(transform, str) else transform,
        up=up,
    )
    target = usable_path("directory", directory)
    _check_overrides("import_map", overrides)
    found = chosen.write(target, name, overrides)
    log.info("import_map: %s; %s", found.source, found.title)
    for remark in found.remarks:
        log.warning("import_map: %s", remark)
    return target


def query(run: Map | Path | str, words: str, by: str | None = None, model: Path | str | None = None) -> QueryResult:
    """Rank the objects of a run or map by a text query.

    Example: `query("outputs/demo", "a red chair").objects`.

    Args:
        run: The run directory, or a map.
        words: The text query.
        by: "embeddings" of images, or "names" of classes and colors; None = embeddings if available.
        model: Folder or huggingface.co id of the embedding model; None = the model of the detector of the run.

    Returns:
        The matching objects, best match first, and the ranking method.

    Raises:
        ConfigError: The query is invalid.
        DataError: The run has no map, a word of the query is unknown, or embeddings are missing.
    """
    question = TextQuery(words, by, None if model is None else str(model))
    if isinstance(run, Map):
        return search(run, question)
    directory = usable_path("run", run)
    return search(Map(scene_of("query", directory)), question, directory)


def load_scene(path: Path | str) -> SceneMap:
    """Read a map as a SceneMap, without the queries of `Map`.

    Raises:
        DataError: The file is not a map.
    """
    from framework.baselines import object_map, open3d_map, semantic_map
    from framework.mapping import instance_map
    from framework.mapping.storage.map_file import read_format

    kinds: dict[str, type[SceneMap]] = {
        str(instance_map.FORMAT): instance_map.InstanceMap,
        object_map.FORMAT: object_map.ObjectMap,
        open3d_map.FORMAT: open3d_map.Open3DMap,
        semantic_map.FORMAT: semantic_map.SemanticMap,
    }
    check_not_forked()
    return kinds.get(read_format(path), instance_map.InstanceMap).load(path)
