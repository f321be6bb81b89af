"""The interfaces between the pipeline and its plugins.

    frame --> Detector --> FrameMasking --> lift to 3D --> ClusterRefiner --> MapFuser --> SceneMap
                               |                ^                                |            |
                               '-------> PoseTracker <----- view of the map -----'            |
                                             ^                                                |
                                             '--------- changes of submaps <--- BackEnd <-----'

A plugin is a dataclass that implements one of these interfaces. Its fields are its parameters, of type bool, int,
float, str, Path, Enum or list[str]. Document the unit and bounds next to each default. Validate the values in
`__post_init__`, and assign other state there as plain attributes. A field may also be a part (a dataclass whose fields
become parameters of the plugin), another plugin, or a mapping of plugins by name. A YAML file in the stage's config
group registers the plugin.
"""

from __future__ import annotations

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from framework.data import (
    Array,
    Camera,
    Detections,
    Float32,
    Float64,
    Frame,
    Instance,
    InstanceMesh,
    PointClusters,
    Pose,
    SceneTruth,
    SurfaceView,
    View,
    check_rigid,
)
from framework.errors import ConfigError, DataError, FrameError
from framework.sensors.depth_distortion import DepthDistortion
from framework.sensors.noise_models import SensorKind

FrameReader = Callable[[], Frame]
"""Reader of one available frame. Raises FrameError if the frame is unusable."""

FusionStage = Literal["association", "update", "integration"]

StageTimer = Callable[[FusionStage], AbstractContextManager[None]]
"""Timer of a fuser stage: `with timer("association"): ...`. Several times of one stage in a frame are summed."""


def untimed(stage: FusionStage) -> AbstractContextManager[None]:
    """Return a context manager that measures nothing.

    Args:
        stage: The stage; ignored.

    Returns:
        The context manager.
    """
    return nullcontext()


class RGBDVideo(ABC):
    """A source of frames: a stored sequence (`RGBDSequence`) or a running camera (`LiveVideo`)."""

    name: str  # name of the scene, for tables
    annotation: str = ""  # release of the ground truth, for tables; "" = only one release exists
    domain: str = ""  # image domain, such as "rendered rooms", for `Detector.domain`; "" = photographs or unknown
    # origin of the world frame of the poses in the world frame of the recording, m; nonzero for distant coordinates
    world_origin: tuple[float, ...] = (0.0, 0.0, 0.0)

    def has_poses(self) -> bool:
        """Return True if frames may have ground-truth poses. Called before any frame is read."""
        return True

    def scene_truth(self) -> SceneTruth | None:
        """Return the ground-truth instances visible in the selected frames; None = no annotation."""
        return None

    def constant_color_delay(self) -> float | None:
        """Return the delay of color relative to depth, s; positive = color captured later; None = to be estimated.

        The capture time of a color image is its timestamp plus this delay, on the clock of the depth images.
        """
        return 0.0


class RGBDSequence(RGBDVideo):
    """A recorded or rendered RGB-D sequence with random access.

    Every implementation has the parameters `start`, `stop`, `stride` and `frame_fraction`, which select the frames.
    """

    camera: Camera

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of selected frames."""

    @abstractmethod
    def __getitem__(self, k: int) -> Frame:
        """Return the selected frame k, 0 <= k < len.

        The pipeline requests frames in order, from any thread. Other callers use random access.

        Raises:
            FrameError: The frame is unusable.
        """

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def image_names(self) -> Mapping[int, str]:
        """Return `Frame.image_name` by `Frame.index`, also for frames that are not selected; empty = unknown."""
        return {}


class LiveVideo(RGBDVideo):
    """The stream of a running camera. If mapping falls behind, frames are dropped."""

    @abstractmethod
    def frames(self) -> Generator[FrameReader | FrameError | None]:
        """Yield a reader for each new frame, and None at least ten times per second while there is no new frame.

        A frame whose damage is known without reading it is yielded as its FrameError. It is skipped and counted, and
        does not replace a usable frame that waits.

        Frame indices increase. Timestamps are capture times, s since 1970 on this computer's clock. Each reader is
        called at most once, in another thread, while the generator waits. The first `next` opens the device. Closing
        the generator, which may happen at any yield, closes the device.

        Raises:
            DataError: The device cannot be opened, or fails.
        """

    def has_poses(self) -> bool:
        return False


class Detector(ABC):
    """Detector of object instances in one image."""

    classes: tuple[str, ...]  # names of the columns of Detections.class_probabilities; set by the constructor
    concurrent: bool = False  # True = threads may call `detect` at the same time; each call uses about one core
    domain: str = ""  # `RGBDVideo.domain` that the detector was trained for; "" = any
    calibration: Path | None = None  # file with the calibration of the instances; None = generic calibration

    @abstractmethod
    def detect(self, frame: Frame) -> Detections:
        """Return the objects in `frame`. The result depends on the frame alone, not on the order of frames.

        A detector that reads the ground truth of the frame raises DataError for a frame without it.
        """

    def check_sequence(self, sequence: RGBDSequence) -> None:  # noqa: B027  # optional
        """Check that the detector fits a sequence. Called before its first frame. By default, accept any sequence.

        Raises:
            DataError: The detector does not fit, for example because its detections belong to another sequence.
        """


class FrameMasking:
    """Masking of moving objects, such as people, in frames.

    This class masks nothing.
    """

    def mask(self, frame: Frame, detections: Detections) -> tuple[Frame, Detections]:
        """Return `frame` without the depth of moving objects, and `detections` without these objects.

        Called once per frame, in order, before tracking. Depth without a reading is 0. Return `frame` itself if nothing
        is masked. If `detections.detected` is false, the detector did not run.
        """
        return frame, detections


class PoseTracker(ABC):
    """Tracker of the camera pose."""

    pose_source: str = "tracked"  # source of the poses, for tables; `ground_truth` = the poses of the sequence
    poses_given: bool = False  # True = the poses are read, not estimated; the pipeline compares them with the map

    @abstractmethod
    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """Return the pose of `frame`. Called once per frame, in order. `scene` is read-only.

        Set `Pose.lost` if the pose cannot be estimated; the frame is then not integrated. The first frame defines the
        world frame: its ground-truth pose if known, otherwise the identity. If the result depends on the ground truth
        of later frames, return their ground-truth poses and set `pose_source` to `ground_truth`.

        Raises:
            NoPoseError: The tracker requires the poses of the sequence, but this frame has none. The frame is skipped.
        """

    def given_pose(self, frame: Frame) -> Float64 | None:
        """Return the pose (4, 4) of a frame in any fixed frame, as read; None = unknown. Called in any order.

        Trackers with `poses_given` implement it, so that the poses can be compared with the images before the run.
        """
        return None

    def correct(self, change: SubmapChange) -> None:
        """Move the poses of earlier frames with their submaps: the last pose, keyframes and predictions.

        Called after the map is changed, before the next frame. Earlier frames belong to the submap of the change before
        them, and to submap 0 before the first change.

        Raises:
            ConfigError: The poses of the tracker cannot be corrected.
        """
        raise ConfigError(
            f"tracker: expected a tracker with corrections, got {type(self).__name__}; set backend=none, or implement "
            "correct()"
        )

    def renew_colors(self) -> None:  # noqa: B027  # optional
        """Discard the color images of earlier frames, which were displaced relative to depth. By default, keep them.

        Called once, when the estimated color delay is used for the first time.
        """

    def keyframes(self) -> Mapping[str, Array]:
        """Return the arrays of the keyframes by name, for `load_keyframes`; empty if the tracker has no keyframes."""
        return {}

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """Resume from stored keyframes. Poses are lost until relocalization in `scene` succeeds.

        Args:
            keyframes: The arrays returned by `keyframes`; may be empty.
            scene: The map in which these keyframes were recorded.

        Raises:
            ConfigError: The tracker cannot relocalize with these keyframes.
            DataError: The arrays are not keyframes.
        """
        raise ConfigError(
            f"tracker: expected a tracker with relocalization in a stored map, got {type(self).__name__}; "
            "set tracker=voxel_hashing_icp"
        )


class ClusterRefiner(ABC):
    """Refiner of the point clusters of one frame. A refiner cleans, splits or merges the clusters."""

    @abstractmethod
    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        """Return the refined clusters; their number may change. Each point has its pixel in `frame`.

        `framework.refinement.refine` does not call this method for `exact` clusters.
        """


class MapFuser(ABC):
    """Fuser of clusters and frames into the map. No other stage writes the map."""

    scene: SceneMap
    has_submaps: bool = False  # True = the map consists of submaps, which `correct` changes

    @abstractmethod
    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters, timer: StageTimer = untimed) -> None:
        """Integrate `frame`, captured at `pose`, and the evidence of its `clusters`.

        If `clusters.detected` is false, `clusters` is empty and instances in view do not lose confidence.
        `timer` measures data association, the update of labels and instances, and the integration of depth and color.
        If a fuser does not use `timer`, the total time is reported as `fusion`.

        Raises:
            MapFullError: The map has reached its maximum number of blocks.
        """

    def renew_colors(self) -> None:  # noqa: B027  # optional
        """Let later observations replace the colors of the map, which were displaced. By default, colors are averaged.

        Called once, when the estimated color delay is used for the first time.
        """

    def correct(self, change: SubmapChange) -> Mapping[int, int]:
        """Change the submaps of the map.

        Fusers with `has_submaps` implement it. Instances of submaps that become visible are associated again.

        Returns:
            The remaining instance by merged instance. The older instance, with the smaller id, remains.
        """
        raise ConfigError(f"fuser: expected a fuser with submaps, got {type(self).__name__}; set backend=none")

    def resume(self, scene: SceneMap) -> None:
        """Resume a stored map instead of starting with an empty map.

        Raises:
            ConfigError: The fuser cannot resume this map.
        """
        raise ConfigError(
            f"fuser: expected a fuser with support for stored maps, got {type(self).__name__}; set fuser=bayesian_tsdf"
        )


@dataclass(frozen=True)
class SubmapChange:
    """A change of the submaps of a map.

    A submap consists of the voxels that were last observed in its part of the trajectory. Hidden submaps are invisible
    to the tracker and the fuser, so that a drifted camera maps a place again instead of blending two surfaces. Changes
    are applied in the order of the fields.
    """

    motions: Mapping[int, Float64] = field(default_factory=dict)  # T_new_old (4, 4) by number, in the world frame
    shown: frozenset[int] = frozenset()  # hidden submaps that become visible
    hidden: frozenset[int] = frozenset()  # submaps that become hidden
    submap: int = 0  # submap of the next frames

    def moved(self, submap: int, T_world_a: Float64) -> Float64:
        """Return the pose T_world_a (4, 4) in a submap after the change."""
        T_new_old = self.motions.get(submap)
        return T_world_a if T_new_old is None else T_new_old @ T_world_a


@dataclass(frozen=True)
class GraphAnchor:
    """The anchor of a submap, a node of a pose graph."""

    first_frame: int | None  # Frame.index of the first frame of the submap; None = a stored map
    T_world_anchor: Float64  # (4, 4) after all corrections

    def __post_init__(self) -> None:
        if self.first_frame is not None and self.first_frame < 0:
            raise DataError(f"GraphAnchor.first_frame: expected at least 0, got {self.first_frame}")
        check_rigid("GraphAnchor.T_world_anchor", self.T_world_anchor)


@dataclass(frozen=True)
class ClosedLoop:
    """A loop of a pose graph: a frame that observes the place of an earlier frame again."""

    earlier_frame: int  # Frame.index
    frame: int  # Frame.index
    submaps: tuple[int, int]  # numbers of the submaps of the earlier frame and of the frame
    path: float  # m, length of the path that the loop closes
    correction_mm: float  # motion of the submap of the frame that the loop implied when it was closed
    correction_deg: float

    def __post_init__(self) -> None:
        if not 0 <= self.earlier_frame <= self.frame:
            raise DataError(
                f"ClosedLoop: expected 0 <= earlier_frame <= frame, got {self.earlier_frame} and {self.frame}"
            )
        for name in ("path", "correction_mm", "correction_deg"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise DataError(f"ClosedLoop.{name}: expected a finite value >= 0, got {getattr(self, name)}")


@dataclass(frozen=True)
class SubmapGraph:
    """The pose graph of a run after all corrections."""

    anchors: tuple[GraphAnchor, ...]  # by number of the submap
    odometry: tuple[tuple[int, int], ...]  # pairs of submaps that are connected by tracked motion
    loops: tuple[ClosedLoop, ...]  # in the order in which they were closed; those that were removed later are omitted

    def __post_init__(self) -> None:
        for pair in (*self.odometry, *(loop.submaps for loop in self.loops)):
            if not all(0 <= number < len(self.anchors) for number in pair):
                last = len(self.anchors) - 1
                raise DataError(f"SubmapGraph: expected edges between submaps 0 to {last}, got one between {pair}")


class DepthCalibrator(ABC):
    """Self-calibration of depth with the first frames of a sequence, which are mapped before the run."""

    @abstractmethod
    def frames(self, available: int) -> int:
        """Return the number of first frames to map, of the `available` ones; 0 = no calibration."""

    @abstractmethod
    def add(self, frame: Frame, pose: Pose) -> None:
        """Add a tracked frame. Called in the order of the frames."""

    @abstractmethod
    def distortion(self) -> DepthDistortion | None:
        """Return the correction of depth for the run; None = no correction. Called after the last frame."""


class BackEnd:
    """Back end, which corrects the map when the camera returns to a place.

    This class changes nothing.
    """

    @property
    def calibrator(self) -> DepthCalibrator | None:
        """Self-calibration of depth before a run; None = no calibration."""
        return None

    def update(self, frame: Frame, pose: Pose, scene: SceneMap) -> SubmapChange | None:
        """Return the change of the map after a fused frame; None = no change. Called in the order of the frames.

        Frames before the first change belong to submap 0. `scene` is read-only.
        """
        return None

    def resume(self) -> None:
        """Prepare for the frames of a stored map. It is submap 0, which must neither move nor be hidden.

        Called before the first frame. The frames belong to other submaps from the first change on.
        """

    def finish(self, scene: SceneMap) -> SubmapChange | None:
        """Return the last change of the map; None = no change. Called after the last frame."""
        return None

    def graph(self) -> SubmapGraph | None:
        """Return the pose graph, for viewers and reports; None = no graph. Called after a change and after `finish`."""
        return None


@dataclass(frozen=True)
class MapStatistics:
    """The size of a map."""

    voxels: int  # number of allocated voxels
    bytes: int  # size of the map's arrays, bytes
    evictions: int = 0  # number of label slots reassigned to another label


@dataclass(frozen=True)
class Gravity:
    """The direction of gravity in the world frame of a map."""

    up: Float64 | None = None  # (3,) unit vector opposite to gravity; None = unknown
    source: str = ""  # "sensor" or "surfaces"; "" = unknown


class SubmapSurfaces(ABC):
    """The surfaces of hidden submaps at one time. One thread at a time may render them, also while the map changes."""

    @abstractmethod
    def render(
        self, camera: Camera, T_world_camera: Float64, submaps: Collection[int], depth: Float32 | None = None
    ) -> SurfaceView:
        """Return the view of submaps.

        Args:
            camera: The camera.
            T_world_camera: The pose (4, 4) of the camera.
            submaps: The numbers of the submaps. Submaps that are not hidden are ignored.
            depth: (H, W) float32, m along z, 0 = no measurement; only the surface near or in front of it is searched.
                None = the entire surface.
        """


class SceneMap(ABC):
    """The map of a fuser.

    Implement `classes` and the six abstract members. Override the other members to provide more data or a faster
    implementation.
    """

    classes: tuple[str, ...]  # the label space; empty until the first frame is fused

    @property
    @abstractmethod
    def statistics(self) -> MapStatistics:
        """The size of the map; read once per frame."""

    @property
    def depth_range(self) -> tuple[float, float]:
        """Minimum and maximum depth of integrated readings, m."""
        return 0.0, float("inf")

    @property
    def embedding_space(self) -> str:
        """The space of `Instance.embedding`, as in `Detections.embedding_space`; "" = no embeddings."""
        return ""

    def digest(self) -> int:
        """Return a checksum of the state of the map, to locate differences between runs; called once per frame.

        The default is a CRC-32 of the statistics.
        """
        return zlib.crc32(repr(self.statistics).encode())

    def calibrate(self, calibration: Path | None) -> None:  # noqa: B027  # optional
        """Set the value of `Detector.calibration`, before the first frame. By default, it is ignored."""

    def instance_ids(self) -> frozenset[int]:
        """Return the ids of the objects in the map. A `Mapper` calls it before and after each frame."""
        return frozenset(self.instances())

    def most_likely_classes(self) -> Mapping[int, tuple[int, float]]:
        """Return the most likely class of each object (an index into `classes`) and its probability to exist, by id.

        Viewers call it about once per second.
        """
        found = self.instances().values()
        return {one.id: (int(one.class_probabilities.argmax()), one.probabilities[0]) for one in found}

    def gravity(self) -> Gravity:
        """Return the direction of gravity in the world frame."""
        return Gravity()

    @abstractmethod
    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the view of the map from `camera` at T_world_camera (4, 4).

        Raises DataError if T_world_camera is not a rigid transform.
        """

    def render_visible(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the view of the visible submaps, for tracking and data association.

        Maps of fusers with `has_submaps` implement it.
        """
        return self.render(camera, T_world_camera)

    def instance_at(self, u: int, v: int, camera: Camera, T_world_camera: Float64) -> int:
        """Return the instance at a pixel of the view from `camera` at T_world_camera (4, 4), 0 = none.

        The implementation may render only a part of the view.
        """
        return int(self.render(camera, T_world_camera).instance_ids[v, u])

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        """Return the view of the surface near the measured depth, for tracking.

        The implementation may start its search at the measured depth, and omit pixels without a measurement and
        surfaces far behind the measured depth.

        Args:
            camera: The camera.
            T_world_camera: The pose (4, 4) of the camera.
            depth: (H, W) float32, m along z; 0 = no measurement.
            sensor: The kind of depth sensor, which determines the noise model.
        """
        return self.render(camera, T_world_camera)

    def hidden_surfaces(self) -> SubmapSurfaces:
        """Return the surfaces of the hidden submaps, for the detection of loops.

        Later changes of the map do not affect them. Maps of fusers with `has_submaps` implement it.
        """
        raise NotImplementedError(f"{type(self).__name__} has no submaps")

    @abstractmethod
    def mesh(self) -> InstanceMesh:
        """Return the surface as a mesh, with color, instance and class of each vertex."""

    @abstractmethod
    def instances(self) -> Mapping[int, Instance]:
        """Return the objects in the map by id. Their vertex indices refer to `mesh()`."""

    @abstractmethod
    def save(self, path: Path | str) -> None:
        """Write the map to one file, atomically."""

    @classmethod
    @abstractmethod
    def load(cls, path: Path | str) -> SceneMap:
        """Read a map written by `save`. Raises DataError if the file is damaged or has another format."""


class Viewer:
    """Viewer of a run in progress, or logger of runs to an experiment tracker.

    This class shows nothing; override the methods that a viewer needs. The order of the calls is `begin_run`, `begin`,
    `show` or `skip` for each frame, `end`, `end_run`. The pipeline waits for each call, so do slow work in a thread
    (`framework.live_view.drawing_thread`). Read the map only during a call, and not after `end`. A viewer must not
    change results.
    """

    def begin_run(self, directory: Path, config: Mapping[str, Any]) -> None:
        """Start a run.

        Args:
            directory: The output folder.
            config: The resolved config; empty if a program has built the stages without a config.

        Raises:
            ConfigError: The viewer cannot start.
        """

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        """Start showing the run of the video named `video`. `directory` is the folder for files.

        Raises ConfigError if the viewer cannot start.
        """

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        """Show a mapped frame, or a frame with a lost pose. `stage_ms` contains the stage times by name, ms."""

    def skip(self, reason: str) -> None:
        """Show the reason for a skipped frame."""

    def correct(self, change: SubmapChange, graph: SubmapGraph | None) -> None:
        """Move the poses of earlier frames with their submaps.

        Called after the map is changed, before `show` of the last fused frame, whose pose is corrected. Frames up to
        this one belong to the submap of the change before, and to submap 0 before the first change.

        Args:
            change: The change of the map.
            graph: The pose graph after the change; None = unknown.
        """

    def end(self) -> None:
        """Finish showing the video. Called once after `begin`, also after an error of the run."""

    def end_run(self, metrics: Mapping[str, Any], error: str) -> None:
        """Finish the run, whose outputs are written. Called once after `begin_run`, also after an error of the run.

        Args:
            metrics: The content of metrics.json, or metrics.partial.json; empty without outputs.
            error: The reason for an early end; "" = the run is complete.
        """
