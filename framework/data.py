"""The data types of the pipeline.

Conventions, used everywhere:

- meters, seconds, radians;
- camera axes x right, y down, z forward; pixel centers at integer coordinates: the image covers
  [-0.5, width - 0.5] x [-0.5, height - 0.5];
- `T_a_b` maps coordinates in b to coordinates in a, so that adjacent names cancel:
  `p_world = T_world_camera @ p_camera`;
- depth is float32 meters along z, not along the ray; 0 = no reading;
- color is uint8 RGB;
- instance 0 = no instance; class index -1 = no class; cluster -1 = the point belongs to no cluster;
- `None` for a pose or for ground truth = unknown.

Every dataclass here is frozen. The types of input data validate shapes, dtypes and finiteness, and later stages do not
repeat these checks.
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from numbers import Integral, Real
from typing import cast

import numpy as np
import numpy.typing as npt

from framework.errors import DataError
from framework.sensors.noise_models import SensorKind

Array = npt.NDArray[np.generic]
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Int32 = npt.NDArray[np.int32]
Int64 = npt.NDArray[np.int64]
UInt8 = npt.NDArray[np.uint8]
UInt16 = npt.NDArray[np.uint16]
Bool = npt.NDArray[np.bool_]

ROTATION_TOLERANCE = 1e-3  # maximum entry of |R R^T - I| of a rigid transform; some published poses have 4 digits
COVARIANCE_TOLERANCE = 1e-9  # maximum rounding error of a covariance, relative to its largest entry
MAX_PIXELS = 2**25  # maximum number of pixels of an image; a frame of 8K video is smaller
WIDEST = 10.0  # maximum ratio of lateral distance to depth: half of a field of view of 168.6 degrees
LONGEST_FOCAL_LENGTH = 1e6  # maximum focal length, px
UNIT_TOLERANCE = 1e-3  # maximum | |v| - 1 | of a unit vector
LONGEST_EMBEDDING = 65_536  # maximum number of dimensions; published networks have 500 to 4,000
MAX_CLASSES = 2**16 - 1  # maximum number of classes of a label space; maps store class ids in two bytes; LVIS has 1,203
LONGEST_CLASS_NAME = 200  # maximum number of characters of a class name
LONGEST_SPACE = 300  # maximum number of characters of an embedding space name
# maximum number of points of a frame per pixel of the image; the masks of three networks in six real scenes have at
# most 2.8; the default refiner and fuser need 80 bytes and 0.2 us per point
MAX_COVERAGE = 8
LARGEST_INDEX = 2**53  # limit of frame numbers; smaller numbers are exact in double precision and in JSON files
LATEST = 1e19  # s, maximum absolute timestamp; stored timestamps in ns, of which `check` warns, have up to 2^63
SAME_TIME = 1e-5  # s, maximum difference of equal timestamps; rounding: trajectory.txt 1e-9 s, Unix time 2e-7 s
PROBABILITY_TOLERANCE = 1e-3  # maximum error of a sum of probabilities, due to softmax in half precision


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px, pixel centers at integers
    cy: float  # px, pixel centers at integers

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            kind: type = Integral if name in ("width", "height") else Real
            if isinstance(value, bool) or not isinstance(value, kind):
                expected = "an integer number of px" if kind is Integral else "a number of px"
                raise DataError(f"Camera.{name}: expected {expected}, got {value!r}")
        if self.width < 1 or self.height < 1:
            raise DataError(f"Camera: expected an image of at least 1x1 px, got {self.width}x{self.height}")
        if self.width * self.height > MAX_PIXELS:
            raise DataError(f"Camera: expected an image of at most {MAX_PIXELS} px, got {self.width}x{self.height}")
        try:
            numbers = (float(self.fx), float(self.fy), float(self.cx), float(self.cy))
        except OverflowError:
            raise DataError("Camera: expected fx, fy, cx, cy in px, got an integer beyond double precision") from None
        for name, number in zip(("fx", "fy", "cx", "cy"), numbers, strict=True):
            if not isinstance(getattr(self, name), int | float | np.number):  # kernels do not support other types
                object.__setattr__(self, name, number)
        if not np.isfinite(numbers).all() or self.fx <= 0 or self.fy <= 0:
            raise DataError(f"Camera: expected positive fx, fy and finite cx, cy, got fx, fy, cx, cy = {numbers}")
        if max(self.fx, self.fy) > LONGEST_FOCAL_LENGTH:
            raise DataError(
                f"Camera: expected fx, fy of at most {LONGEST_FOCAL_LENGTH:g} px, got fx, fy, cx, cy = {numbers}"
            )
        # px, distances of the outermost pixels from the principal point
        horizontal = max(self.cx, self.width - 1 - self.cx, -self.cx)
        vertical = max(self.cy, self.height - 1 - self.cy, -self.cy)
        if horizontal > WIDEST * self.fx or vertical > WIDEST * self.fy:
            slopes = (WIDEST, max(horizontal / self.fx, vertical / self.fy))
            widest, found = (2 * math.degrees(math.atan(slope)) for slope in slopes)
            raise DataError(
                f"Camera: expected a field of view of at most {widest:.1f} degrees, got {found:.1f} degrees "
                f"({self.width}x{self.height} px with fx, fy, cx, cy = {numbers}); set fx, fy, cx, cy in px, not as "
                "fractions of width and height"
            )

    @property
    def K(self) -> Float64:
        """The intrinsic matrix (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def shape(self) -> tuple[int, int]:
        """Image shape (height, width), px."""
        return self.height, self.width

    def scaled(self, factor: float) -> Camera:
        """Return the camera of the image resized by `factor`. Width and height are rounded to integers.

        Raises DataError unless `factor` is a positive number.
        """
        if not isinstance(cast(object, factor), Real) or not 0 < factor < math.inf:
            raise DataError(f"Camera.scaled: factor: expected a positive number, got {factor!r:.60}")
        width, height = round(self.width * factor), round(self.height * factor)
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5)

    def cropped(self, u0: int, v0: int, u1: int, v1: int) -> Camera:
        """Return the camera of the part of the image from pixel (u0, v0) to (u1, v1), exclusive."""
        return replace(self, width=u1 - u0, height=v1 - v0, cx=self.cx - u0, cy=self.cy - v0)


@dataclass(frozen=True)
class FrameTruth:
    """The ground-truth instances visible in a frame, for simulated detectors and evaluation only."""

    instance_ids: Int32 = field(repr=False)  # (H, W), 0 = no instance
    class_names: Mapping[int, str | None]  # class name by instance id; None = unknown class, not evaluated
    of_depth: bool = False  # True = ids at the pose of the depth image, False = ids at the pose of the color image

    def __post_init__(self) -> None:
        check_array("FrameTruth.instance_ids", self.instance_ids, (None, None), np.int32)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape (height, width) of `instance_ids`, px."""
        return self.instance_ids.shape


class DeferredTruth(FrameTruth):
    """Ground truth of a frame whose ids are rendered or decoded on first access, once for all threads.

    Access raises the errors of `render`, and DataError if `render` does not return int32 ids of `shape`.
    """

    def __init__(
        self,
        render: Callable[[], Int32],
        shape: tuple[int, int],  # (height, width) of the ids
        class_names: Mapping[int, str | None],
        origin: str,  # hash of all inputs of `render`, which identifies the ids without rendering them
        of_depth: bool = True,
    ) -> None:
        self._render = render
        self._shape = shape
        self._ids: Int32 | None = None
        self._lock = threading.Lock()
        self.origin = origin
        object.__setattr__(self, "class_names", class_names)  # fields of the frozen base class
        object.__setattr__(self, "of_depth", of_depth)

    @property
    def shape(self) -> tuple[int, ...]:
        return self._shape

    @property
    def instance_ids(self) -> Int32:
        with self._lock:
            if self._ids is None:
                ids = self._render()
                check_array("DeferredTruth.instance_ids", ids, self._shape, np.int32)
                self._ids = ids
            return self._ids


@dataclass(frozen=True)
class Frame:
    """One RGB-D image with registered color and depth."""

    index: int  # position in the full sequence, before start, stop and stride select frames
    timestamp: float  # s
    color: UInt8  # (H, W, 3) RGB
    depth: Float32  # (H, W) m along z, 0 = no reading
    camera: Camera
    T_world_camera: Float64 | None = None  # (4, 4) ground-truth pose; None = unknown
    truth: FrameTruth | None = None  # ground-truth instances; None = unknown
    up: Float64 | None = None  # (3,) unit vector opposite to measured gravity, camera frame; None = no sensor
    color_timestamp: float | None = None  # s, of the color image; None = timestamp
    depth_timestamp: float | None = None  # s, of the depth image; None = timestamp
    sensor: SensorKind = SensorKind.KINECT_V1  # kind of depth sensor, which determines the noise model
    T_odom_camera: Float64 | None = None  # (4, 4) pose of odometry, at the time of depth; None = unknown
    image_name: str = ""  # file name of the color image, without folders; "" = no file of its own

    def __post_init__(self) -> None:
        index, camera = cast(object, self.index), cast(object, self.camera)  # the caller may pass any type
        if isinstance(index, bool) or not isinstance(index, int | np.integer) or not 0 <= index < LARGEST_INDEX:
            raise DataError(f"Frame.index: expected an integer of at least 0 and below 2^53, got {index!r:.60}")
        where = f"frame {self.index}: "
        if not isinstance(camera, Camera):
            raise DataError(f"{where}camera: expected a Camera, got {type(camera).__name__}")
        times = {"timestamp": self.timestamp, "color_timestamp": self.color_time, "depth_timestamp": self.depth_time}
        for name, time in times.items():
            number = isinstance(time, int | float | np.integer | np.floating)
            number &= not isinstance(time, bool | np.timedelta64)
            if not number or not -LATEST <= time <= LATEST:
                raise DataError(
                    f"{where}{name}: expected a number of seconds in [{-LATEST:g}, {LATEST:g}], got {time!r:.60}"
                )
        check_array(where + "color", self.color, (*self.camera.shape, 3), np.uint8)
        check_array(where + "depth", self.depth, self.camera.shape, np.float32)
        if self.depth.size and self.depth.min() < 0:
            raise DataError(f"{where}depth: expected values of at least 0 m, got {self.depth.min()} m")
        if self.T_world_camera is not None:
            check_rigid(where + "T_world_camera", self.T_world_camera)
        if self.T_odom_camera is not None:
            check_rigid(where + "T_odom_camera", self.T_odom_camera)
        if self.up is not None:
            check_array(where + "up", self.up, (3,), np.float64)
            if abs(np.linalg.norm(self.up) - 1) > UNIT_TOLERANCE:
                raise DataError(
                    f"{where}up: expected a unit vector, got a vector of length {np.linalg.norm(self.up):.4g}"
                )
        if not isinstance(cast(object, self.sensor), SensorKind):
            raise DataError(
                f"{where}sensor: expected a SensorKind, got {self.sensor!r}; pass a member such as SensorKind.KINECT_V1"
            )
        object.__setattr__(self, "_depth_cache", {})
        # kernels require contiguous writable arrays; views such as bgr[..., ::-1] and read-only arrays are copied
        object.__setattr__(self, "color", np.require(np.asarray(self.color), requirements=("C", "W")))
        object.__setattr__(self, "depth", np.require(np.asarray(self.depth), requirements=("C", "W")))
        if self.truth is not None and not isinstance(cast(object, self.truth), FrameTruth):
            raise DataError(f"{where}truth: expected a FrameTruth, got {type(self.truth).__name__}")
        if self.truth is not None and self.truth.shape != self.camera.shape:
            raise DataError(f"{where}truth.instance_ids: expected shape {self.camera.shape}, got {self.truth.shape}")

    def with_color(self, color: UInt8) -> Frame:
        """Return the frame with another color image (H, W, 3) of the same size. Depth is shared.

        Raises DataError for another shape or dtype.
        """
        check_array(f"frame {self.index}: color", color, (*self.camera.shape, 3), np.uint8)
        frame = copy.copy(self)
        object.__setattr__(frame, "color", np.require(color, requirements=("C", "W")))
        return frame

    @property
    def depth_cache(self) -> dict[str, Array]:
        """Arrays computed from depth and camera alone, by name; shared with the frames that `with_color` returns."""
        cache: dict[str, Array] = vars(self)["_depth_cache"]
        return cache

    @property
    def color_time(self) -> float:
        """Timestamp of the color image, s."""
        return self.timestamp if self.color_timestamp is None else self.color_timestamp

    @property
    def depth_time(self) -> float:
        """Timestamp of the depth image, s."""
        return self.timestamp if self.depth_timestamp is None else self.depth_timestamp


@dataclass(frozen=True)
class Pose:
    """The camera pose estimated by a tracker. Frames with a lost pose are never integrated."""

    T_world_camera: Float64  # (4, 4); if lost, the last reliable pose
    lost: bool = False
    reason: str = ""  # reason for the loss, for the log
    covariance: Float64 | None = None  # (6, 6) m, rad, in the camera frame; None = unknown
    """The covariance of the pose error xi = (translation, rotation); the true pose is T_world_camera exp(xi).

    The covariance does not include the drift of the map. It is 0 for the pose that defines the world frame.
    """

    def __post_init__(self) -> None:
        check_rigid("Pose.T_world_camera", self.T_world_camera)
        if self.covariance is not None:
            _check_covariance("Pose.covariance", self.covariance)


@dataclass(frozen=True)
class DelayEstimate:
    """An estimate of the delay between color and depth."""

    seconds: float  # delay of color relative to depth at equal timestamps, s; positive = color captured later
    deviation: float  # standard deviation, s; infinite = unknown
    frames: int  # number of compared frames

    @property
    def known(self) -> bool:
        """True if the delay has been estimated. The estimate may be inaccurate; see `deviation`."""
        return math.isfinite(self.deviation)


@dataclass(frozen=True)
class Detections:
    """The N objects detected in one image, best first. Masks may overlap; N may be 0."""

    masks: Bool  # (N, H, W)
    boxes: Float32  # (N, 4) x1 y1 x2 y2, px; the first and the last pixels inside
    scores: Float32  # (N,) in [0, 1]
    class_probabilities: Float32  # (N, C), each row a distribution over `classes`
    classes: tuple[str, ...]  # names of the C columns
    exact: bool = False  # True = ground-truth masks, which refiners do not change
    embeddings: Float32 | None = None  # (N, D) unit vectors; a zero row = not computed; None = no embeddings
    embedding_space: str = ""  # "MODEL@REVISION"; embeddings of different spaces are not comparable; "" = none
    detected: bool = True  # False = the detector did not run, so a missing object is no evidence of absence

    def __post_init__(self) -> None:
        check_array("Detections.scores", self.scores, (None,), np.float32)
        n, c = len(self.scores), len(self.classes)
        check_array("Detections.masks", self.masks, (n, None, None), np.bool_)
        check_array("Detections.boxes", self.boxes, (n, 4), np.float32)
        _check_objects(self, n, c)

    def __len__(self) -> int:
        return len(self.scores)

    @classmethod
    def none(cls, shape: tuple[int, int], classes: tuple[str, ...], detected: bool = True) -> Detections:
        """Return empty detections for an image of `shape` (height, width)."""
        return cls(
            masks=np.zeros((0, *shape), np.bool_),
            boxes=np.zeros((0, 4), np.float32),
            scores=np.zeros(0, np.float32),
            class_probabilities=np.zeros((0, len(classes)), np.float32),
            classes=classes,
            detected=detected,
        )


@dataclass(frozen=True)
class PointClusters:
    """The detections of one frame lifted to 3D: P points in N clusters, one for each mask.

    A pixel under several masks has a point in each cluster.
    """

    points_world: Float32  # (P, 3) m
    pixels: Int32  # (P, 2) (u, v) of each point
    cluster: Int32  # (P,) in [0, N), -1 = none
    class_probabilities: Float32  # (N, C), each row a distribution over `classes`
    scores: Float32  # (N,) in [0, 1]
    classes: tuple[str, ...]  # names of the C columns
    exact: bool = False  # as in Detections
    structure: Bool | None = None  # (H, W) True on floors and walls, which belong to no object; None = unknown
    embeddings: Float32 | None = None  # (N, D), as in Detections
    embedding_space: str = ""  # as in Detections
    detected: bool = True  # as in Detections
    omitted: int = 0  # number of detections that exceed the limit of points of a frame; their clusters are empty

    def __post_init__(self) -> None:
        check_array("PointClusters.points_world", self.points_world, (None, 3), np.float32)
        check_array("PointClusters.scores", self.scores, (None,), np.float32)
        p, n, c = len(self.points_world), len(self.scores), len(self.classes)
        check_array("PointClusters.pixels", self.pixels, (p, 2), np.int32)
        check_array("PointClusters.cluster", self.cluster, (p,), np.int32)
        _check_objects(self, n, c)
        if p and (self.cluster.min() < -1 or self.cluster.max() >= n):
            raise DataError(
                f"PointClusters.cluster: expected values in [-1, {n}), got {self.cluster.min()} to {self.cluster.max()}"
            )
        if self.structure is not None:
            check_array("PointClusters.structure", self.structure, (None, None), np.bool_)

    def __len__(self) -> int:
        return len(self.scores)


@dataclass(frozen=True)
class SurfaceView:
    """The surface of a map as seen from a camera pose, for tracking."""

    camera: Camera
    T_world_camera: Float64  # (4, 4)
    depth: Float32  # (H, W) m along z, 0 = no surface
    normals_world: Float32  # (H, W, 3) unit vectors toward the camera; 0 where depth is 0
    color: UInt8  # (H, W, 3) RGB


@dataclass(frozen=True)
class View(SurfaceView):
    """The surface of a map as seen from a camera pose, with labels."""

    instance_ids: Int32  # (H, W), 0 = no instance
    class_ids: Int32  # (H, W) index into the map's classes, -1 = no class


@dataclass(frozen=True)
class Box:
    """An oriented box. The columns of `rotation` are its axes in the world frame (the identity if axis-aligned)."""

    center: Float64  # (3,) m
    extent: Float64  # (3,) m, full side lengths
    rotation: Float64  # (3, 3)


LIKELY = 0.5  # minimum probability that an instance exists, for figures and logs; files contain all instances


@dataclass(frozen=True)
class Instance:
    """One object of the map."""

    id: int  # positive 32-bit integer
    class_probabilities: Float32  # (C,) a distribution over the map's classes
    confidence: float  # in [0, 1], ranks instances in the evaluation
    observations: int  # number of frames in which it was detected
    first_frame: int  # `Frame.index` of the first detection
    last_frame: int  # `Frame.index` of the last detection
    vertices: Int32  # (M,) indices of its vertices in the map's InstanceMesh
    aabb: Box  # axis-aligned bounding box in the world frame
    obb: Box  # oriented bounding box in the world frame
    embedding: Float32 | None = None  # (D,) unit vector in the map's `embedding_space`; None = no embedding
    embedding_spread: float | None = None  # in [0, 1], 1 - |mean of the unit vectors|: 0 = all equal
    exists: float | None = None  # probability that it is an object, i.e. matches one at IoU 0.5; None = not calibrated
    class_probability: float | None = None  # probability that its most probable class is right, if it exists
    expected_iou: float | None = None  # expected IoU of its surface with that of the object, if it exists

    @property
    def probabilities(self) -> tuple[float, float]:
        """The probabilities that it exists and that its class is right.

        They are the confidence and the largest class probability if they are not calibrated.
        """
        return (
            self.confidence if self.exists is None else self.exists,
            float(self.class_probabilities.max(initial=0.0))
            if self.class_probability is None
            else self.class_probability,
        )


class Structure(IntEnum):
    """Parts of a building in a map, which belong to no instance, except for furniture fronts."""

    NONE = 0
    FLOOR = 1
    WALL = 2
    CEILING = 3
    FRONT = 4  # large vertical front of furniture, such as a cupboard; it may belong to an instance


@dataclass(frozen=True)
class InstanceMesh:
    """The surface of a map as a mesh with labeled vertices."""

    vertices: Float32  # (V, 3) m, world frame
    triangles: Int32  # (F, 3) vertex indices
    colors: UInt8  # (V, 3) RGB
    instance_ids: Int32  # (V,), 0 = no instance
    class_ids: Int32  # (V,) index into `classes`, -1 = no class
    classes: tuple[str, ...]
    structure: UInt8 | None = None  # (V,) `Structure` of each vertex; None = not determined

    def __post_init__(self) -> None:
        v = len(self.vertices)
        check_array("InstanceMesh.vertices", self.vertices, (v, 3), np.float32)
        check_array("InstanceMesh.triangles", self.triangles, (None, 3), np.int32)
        check_array("InstanceMesh.colors", self.colors, (v, 3), np.uint8)
        check_array("InstanceMesh.instance_ids", self.instance_ids, (v,), np.int32)
        check_array("InstanceMesh.class_ids", self.class_ids, (v,), np.int32)
        if self.structure is not None:
            check_array("InstanceMesh.structure", self.structure, (v,), np.uint8)

    def of(self, instance: Instance) -> InstanceMesh:
        """Return the mesh of an instance: its vertices, in order, and the triangles between them."""
        own = np.zeros(len(self.vertices), np.bool_)
        own[instance.vertices] = True
        triangles = self.triangles[own[self.triangles[:, 0]]]
        triangles = triangles[own[triangles].all(axis=1)]
        return self.part(instance.vertices, triangles)

    def part(self, vertices: Int32, triangles: Int32) -> InstanceMesh:
        """Return a part of the mesh.

        Args:
            vertices: The indices (M,) of the vertices of the part, in order.
            triangles: The triangles (N, 3) of the part, as indices of vertices in this mesh.
        """
        new_index = np.empty(len(self.vertices), np.int32)
        new_index[vertices] = np.arange(len(vertices), dtype=np.int32)
        return InstanceMesh(
            self.vertices[vertices],
            new_index[triangles],
            self.colors[vertices],
            self.instance_ids[vertices],
            self.class_ids[vertices],
            self.classes,
            None if self.structure is None else self.structure[vertices],
        )


@dataclass(frozen=True)
class ReferenceTrajectory:
    """The camera poses in the world frame of the ground truth. Maps in other world frames are aligned to them."""

    timestamps: Float64  # (F,) s, increasing
    T_world_camera: Float64  # (F, 4, 4)
    given: bool  # True = the run uses these poses; its map is not aligned if it starts at one of them

    def __post_init__(self) -> None:
        f = len(self.timestamps)
        check_array("ReferenceTrajectory.timestamps", self.timestamps, (f,), np.float64)
        check_array("ReferenceTrajectory.T_world_camera", self.T_world_camera, (f, 4, 4), np.float64)

    def at(self, timestamps: Float64) -> Int64:
        """Return the indices (N,) of the poses at `timestamps` (N,), s; -1 = no pose."""
        if not len(self.timestamps):
            return np.full(len(timestamps), -1)
        last = len(self.timestamps) - 1
        nearest = np.clip(np.searchsorted(self.timestamps, timestamps - SAME_TIME), 0, last)
        return np.where(np.abs(self.timestamps[nearest] - timestamps) <= SAME_TIME, nearest, -1)


@dataclass(frozen=True)
class AnnotatedObjects:
    """All annotated objects of a scene, including those without a COCO class, with their names in label spaces."""

    instance_ids: Int32  # (V,) at SceneTruth.points_world, 0 = no object
    own_names: Mapping[int, str | None]  # names in the annotation by instance id; None = no name
    names: Mapping[str, Mapping[int, str]]  # names by label space and instance id; objects of other classes are missing


@dataclass(frozen=True)
class SceneTruth:
    """The ground-truth instances of a sequence as labeled surface points, for evaluation."""

    points_world: Float32  # (V, 3) m, on the visible surface
    instance_ids: Int32  # (V,), 0 = no instance
    class_names: Mapping[int, str | None] = field(default_factory=dict)  # as in FrameTruth; None = not evaluated
    classes: tuple[str, ...] | None = None  # all annotated classes; None = unknown
    trajectory: ReferenceTrajectory | None = None  # None = all maps share the world frame of the points
    annotated: AnnotatedObjects | None = None  # None = class_names are the names of the annotation
    structure: UInt8 | None = None  # (V,) true `Structure` of each point, without FRONT; None = unknown

    def __post_init__(self) -> None:
        v = len(self.points_world)
        check_array("SceneTruth.points_world", self.points_world, (v, 3), np.float32)
        check_array("SceneTruth.instance_ids", self.instance_ids, (v,), np.int32)
        if self.structure is not None:
            check_array("SceneTruth.structure", self.structure, (v,), np.uint8)


def check_rigid(name: str, T: Float64) -> None:
    """Raise DataError unless `T` is a finite float64 rigid transform (4, 4). The message begins with `name`."""
    check_array(name, T, (4, 4), np.float64)
    R = T[:3, :3]
    error = float(np.abs(R @ R.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise DataError(
            f"{name}: expected a rigid transform, got |R R^T - I| = {error:.2g}, det R = {np.linalg.det(R):.2g}"
        )
    if not np.allclose(T[3], (0, 0, 0, 1)):
        raise DataError(f"{name}: expected the last row 0 0 0 1, got {T[3].tolist()}")


def check_view(camera: Camera, T_world_camera: Float64) -> None:
    """Raise DataError unless `camera` is a Camera and T_world_camera (4, 4) is a rigid transform."""
    if not isinstance(cast(object, camera), Camera):
        raise DataError(f"camera: expected a Camera, got {type(camera).__name__}")
    check_rigid("T_world_camera", T_world_camera)


def check_label_space(classes: tuple[str, ...]) -> None:
    """Raise DataError unless a map can store the classes."""
    if len(classes) > MAX_CLASSES:
        raise DataError(
            f"detector: expected at most {MAX_CLASSES} classes, got {len(classes)}; remove classes that the scene "
            "cannot contain"
        )
    long = max(classes, key=len, default="")
    if len(long) > LONGEST_CLASS_NAME:
        raise DataError(
            f"detector: expected class names of at most {LONGEST_CLASS_NAME} characters, got {len(long)}: "
            f"{long!r:.60}; shorten the name"
        )


def check_array(name: str, array: Array, shape: tuple[int | None, ...], dtype: npt.DTypeLike) -> None:
    """Raise DataError unless `array` has the shape (None = any length), the dtype, and finite values."""
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        found = array.dtype if isinstance(array, np.ndarray) else type(array).__name__
        raise DataError(f"{name}: expected an array of {np.dtype(dtype)}, got {found}")
    variable = name.rpartition(" ")[2]
    if isinstance(array, np.matrix):  # products and slices of matrices have other shapes
        raise DataError(f"{name}: expected an array, got a matrix; pass np.asarray({variable})")
    if isinstance(array, np.ma.MaskedArray):
        raise DataError(f"{name}: expected an array without a mask, got a masked array; pass {variable}.filled(0)")
    matches = len(array.shape) == len(shape) and all(
        want in (None, have) for have, want in zip(array.shape, shape, strict=True)
    )
    if not matches:
        wanted = "(" + ", ".join("any" if want is None else str(want) for want in shape) + ")"
        raise DataError(f"{name}: expected shape {wanted}, got {array.shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise DataError(f"{name}: expected finite values, got NaN or infinity")


def _check_covariance(name: str, C: Float64) -> None:
    check_array(name, C, (6, 6), np.float64)
    tolerance = COVARIANCE_TOLERANCE * float(np.abs(C).max())
    asymmetry, least = float(np.abs(C - C.T).max()), float(np.linalg.eigvalsh(C)[0])
    if asymmetry > tolerance or least < -tolerance:
        raise DataError(
            f"{name}: expected a symmetric, positive semidefinite matrix, got |C - C^T| = {asymmetry:.2g}, minimum "
            f"eigenvalue {least:.2g}"
        )


def _check_objects(found: Detections | PointClusters, n: int, c: int) -> None:
    """Raise DataError unless scores, class probabilities and embeddings are valid for n objects and c classes."""
    name, scores = type(found).__name__, found.scores
    check_array(f"{name}.scores", scores, (n,), np.float32)
    if n and (scores.min() < 0 or scores.max() > 1):
        raise DataError(f"{name}.scores: expected values in [0, 1], got {scores.min()} to {scores.max()}")
    _check_distributions(f"{name}.class_probabilities", found.class_probabilities, (n, c))
    _check_embeddings(f"{name}.embeddings", found.embeddings, found.embedding_space, n)


def _check_embeddings(name: str, rows: Float32 | None, space: str, n: int) -> None:
    if not isinstance(cast(object, space), str) or len(space) > LONGEST_SPACE:
        raise DataError(f"{name}: expected a space name of at most {LONGEST_SPACE} characters, got {space!r:.60}")
    if rows is None:
        if space:
            raise DataError(f"{name}: expected embeddings for embedding_space {space!r}, got none; pass both")
        return
    if not space:
        raise DataError(f"{name}: expected a name in embedding_space, got an empty string; set it to MODEL@REVISION")
    check_array(name, rows, (n, None), np.float32)
    if not 1 <= rows.shape[1] <= LONGEST_EMBEDDING:
        raise DataError(f"{name}: expected 1 to {LONGEST_EMBEDDING} columns, got {rows.shape[1]}")
    lengths = np.linalg.norm(rows, axis=1)
    wrong = (lengths != 0) & (np.abs(lengths - 1) > UNIT_TOLERANCE)
    if wrong.any():
        raise DataError(
            f"{name}: expected a unit vector or zeros in each row, got a row of length {lengths[wrong][0]:.4g}"
        )


def _check_distributions(name: str, rows: Float32, shape: tuple[int, int]) -> None:
    check_array(name, rows, shape, np.float32)
    if shape[0] and not shape[1]:
        raise DataError(f"{name}: expected at least one class for {shape[0]} rows, got none")
    if rows.size and (rows.min() < 0 or np.abs(rows.sum(axis=1) - 1).max() > PROBABILITY_TOLERANCE):
        worst = rows.sum(axis=1)[np.abs(rows.sum(axis=1) - 1).argmax()]
        raise DataError(
            f"{name}: expected a probability distribution in each row, got a sum of {worst:.4f} and a minimum of "
            f"{rows.min():.4f}"
        )
