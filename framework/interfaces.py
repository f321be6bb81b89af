"""The contracts: four stages that plugins fill in, the map that they build, the video that feeds them, who watches.

    frame --> Detector --> lift to 3D --> ClusterRefiner --> MapFuser --> SceneMap
      '-----> PoseTracker ----'                                 |
                  ^                                             |
                  '------------- view of the map ---------------'

A plugin is a dataclass that implements one of these interfaces. Its dataclass fields are its parameters (bool, int,
float, str, Path, Enum or list[str], with unit and bounds beside the default), checked in `__post_init__`; whatever else
it keeps is assigned there as a plain attribute, never declared as a field. What several plugins do by the same
parameters is a part, a field of another dataclass that has these and the methods; in a config they are the plugin's
own. A field may be another plugin, or several by name. One YAML file in the stage's config group registers it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path

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
)
from framework.errors import ConfigError

FrameReader = Callable[[], Frame]
"""Reads a frame that is there. Raises FrameError when it cannot be used."""


class RGBDVideo(ABC):
    """Where frames come from: a recording (`RGBDSequence`), or a camera that runs (`LiveVideo`)."""

    name: str  # for tables: the scene
    annotation: str = ""  # for tables: which release of the true instances; "" = there is but one
    domain: str = ""  # what its pictures are, as a detector may ask: "rendered rooms"; "" = photographs, or not known

    def has_poses(self) -> bool:
        """Whether any of the frames may have a true pose; some of them may lack it. Asked before any frame is read."""
        return True

    def scene_truth(self) -> SceneTruth | None:
        """The true instances of the chosen frames' scene, None where nobody labelled it."""
        return None


class RGBDSequence(RGBDVideo):
    """A recorded or rendered RGB-D video, read frame by frame.

    Every one has the parameters `start`, `stop`, `stride` and `frame_fraction`, which choose from the frames that
    there are.
    """

    camera: Camera

    @abstractmethod
    def __len__(self) -> int:
        """The number of frames chosen."""

    @abstractmethod
    def __getitem__(self, k: int) -> Frame:
        """Frame k of the chosen ones, 0 <= k < len. Raises FrameError when that frame cannot be read.

        A run asks for one after the other in their order, from whatever thread.
        """

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))


class LiveVideo(RGBDVideo):
    """An RGB-D video that goes on while it is mapped. What comes while nobody has time for it is dropped."""

    @abstractmethod
    def frames(self) -> Generator[FrameReader | None]:
        """The frames as they come, and None at least ten times a second while none does; ends with the video.

        Frames have growing numbers, and for a timestamp the time when they were there, s since 1970 by this computer's
        clock. Each is read once or not at all, in another thread, while the iterator waits for the next one. The device
        or folder is opened when the first is asked for, and given back when the iterator is closed, which may happen
        wherever it yields. Raises DataError when it cannot be opened, or fails.
        """

    def has_poses(self) -> bool:
        return False


class Detector(ABC):
    """Finds object instances in one image."""

    classes: tuple[str, ...]  # names of the columns of class_probabilities; known once the detector is built
    concurrent: bool = False  # whether several threads may call `detect` at once; each then keeps about a core busy

    @abstractmethod
    def detect(self, frame: Frame) -> Detections:
        """The objects in `frame`. The same frame gives the same detections, in whatever order frames come."""


class PoseTracker(ABC):
    """Estimates the camera pose."""

    pose_source: str = "tracked"  # for tables; `ground_truth` of a tracker that returns the sequence's own poses

    @abstractmethod
    def track(self, frame: Frame, scene: SceneMap) -> Pose:
        """The pose of `frame`; called once per frame, in order. `scene` is read only.

        `Pose.lost` says that the tracker cannot tell; the frame is then not integrated. The first frame defines the
        world: its true pose where known, else the identity. A tracker of given poses raises NoPoseError for a frame
        that has none: the frame is skipped.
        """

    def keyframes(self) -> Mapping[str, Array]:
        """Return the arrays of the keyframes, for `load_keyframes`; empty if the tracker keeps none."""
        return {}

    def load_keyframes(self, keyframes: Mapping[str, Array], scene: SceneMap) -> None:
        """Resume from stored keyframes; poses are lost until relocalization in `scene` succeeds.

        Args:
            keyframes: The arrays that `keyframes` returned; empty if there were none.
            scene: The map in which these keyframes were recorded.

        Raises:
            ConfigError: the tracker cannot relocalize with these keyframes.
            DataError: the arrays are not keyframes.
        """
        raise ConfigError(f"tracker: {type(self).__name__} cannot relocalize in a stored map; choose another tracker")


class ClusterRefiner(ABC):
    """Cleans, splits or merges this frame's point clusters."""

    @abstractmethod
    def refine(self, clusters: PointClusters, frame: Frame) -> PointClusters:
        """Points in, points out. `pixels` say where in `frame` each point was seen; N may change.

        Clusters that are `exact` never get here: `framework.refinement.refine` passes them on.
        """


class MapFuser(ABC):
    """Associates clusters with map instances and integrates the frame. The only stage that writes the map."""

    scene: SceneMap

    @abstractmethod
    def fuse(self, frame: Frame, pose: Pose, clusters: PointClusters) -> None:
        """Integrates `frame`, seen from `pose`, with the evidence of its `clusters`.

        Raises MapFullError when the map's block budget is reached.
        """

    def resume(self, scene: SceneMap) -> None:
        """Continue a stored map instead of the empty one.

        Raises:
            ConfigError: the fuser cannot write this map.
        """
        raise ConfigError(f"fuser: {type(self).__name__} cannot resume a stored map; choose another fuser")


class SceneMap(ABC):
    """What a fuser builds."""

    classes: tuple[str, ...]  # the label space; empty until the first frame is fused

    @property
    @abstractmethod
    def voxel_count(self) -> int:
        """Voxels allocated."""

    @property
    @abstractmethod
    def byte_count(self) -> int:
        """Bytes that the map's arrays take."""

    @property
    def depth_range(self) -> tuple[float, float]:
        """m: readings that are nearer or farther leave nothing in the map."""
        return 0.0, float("inf")

    @property
    def evictions(self) -> int:
        """How often a voxel had to forget a label for want of room; a map that never forgets leaves it at 0."""
        return 0

    @property
    def embedding_space(self) -> str:
        """What the `embedding` of its objects is of, as in Detections; "" where none has one."""
        return ""

    @property
    def instance_count(self) -> int:
        """The number of objects found so far; asked often, for the progress bar: override it where it can be cheap."""
        return len(self.instances())

    def instance_ids(self) -> frozenset[int]:
        """Their ids; asked after each frame by who maps frames as they come: override it where it can be cheap."""
        return frozenset(self.instances())

    def most_likely_classes(self) -> Mapping[int, tuple[int, float]]:
        """Return the most likely class of each object (an index into `classes`) and its confidence, by id.

        Viewers call it about once per second; override it if the map has a faster way.
        """
        found = self.instances().values()
        return {one.id: (int(one.class_probabilities.argmax()), one.confidence) for one in found}

    @abstractmethod
    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        """What `camera` would see of the map, by ray-casting. Raises DataError where T_world_camera is no pose."""

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        """The surface that `camera` would see where it reads `depth` (H, W) m: what a tracker compares a frame with.

        A map may begin its search at the readings, and show nothing where there is none and nothing far behind them.
        """
        return self.render(camera, T_world_camera)

    @abstractmethod
    def mesh(self) -> InstanceMesh:
        """The surface, with colour, instance and class for each vertex."""

    def up(self) -> Float64 | None:
        """The unit vector (3,) against gravity in the world, None where the map does not tell."""
        return None

    @property
    def up_is_sensed(self) -> bool:
        """Whether `up` is what a sensor told of the frames, and not found in the surface."""
        return False

    def up_source(self) -> str:
        """What tells `up`: "sensor" or "surfaces"; "" where nothing does."""
        if self.up() is None:
            return ""
        return "sensor" if self.up_is_sensed else "surfaces"

    @abstractmethod
    def instances(self) -> Mapping[int, Instance]:
        """The objects found so far, by id. Vertex indices refer to `mesh()` of the same map."""

    @abstractmethod
    def save(self, path: Path | str) -> None:
        """Writes the map to one file, whole or not at all."""

    @classmethod
    @abstractmethod
    def load(cls, path: Path | str) -> SceneMap:
        """The map that `save` wrote. Raises DataError when the file is not such a map or was damaged."""


class Viewer:
    """Shows a run while it goes on. This one shows nothing; a viewer has the verbs that it needs.

    All are called by the loop, which waits for them: what takes time belongs into a thread of its own
    (`framework.live_view.drawing_thread`). Read the map only within a call, while it is not being written.
    Whatever a viewer does, it changes no result.
    """

    def begin(self, scene: SceneMap, video: str, directory: Path) -> None:
        """A video begins; files go to `directory`. Raises ConfigError where it cannot be shown."""

    def show(self, frame: Frame, detections: Detections, pose: Pose, stage_ms: Mapping[str, float]) -> None:
        """A frame is in the map, or its pose is lost. `stage_ms`: what each stage took, by its name."""

    def skip(self, reason: str) -> None:
        """A frame cannot be used."""

    def end(self) -> None:
        """No frame follows, however the run ended; called once after `begin`."""
