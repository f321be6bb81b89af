"""Instances of a map, their confirmation and their boxes."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Box, Float32, Float64, Instance, InstanceMesh, Int32
from framework.interfaces import SceneMap
from framework.mapping.instances.association import agreed_classes
from framework.mapping.instances.instance_calibration import InstanceCalibration
from framework.mapping.instances.instance_table import InstanceRecord, InstanceTable
from framework.mapping.storage.map_header import MapHeader

MIN_VERTICES = 4  # minimum number of mesh vertices of an instance, enough to span a box


class InstanceClass(Enum):
    """Source of the class distribution of an instance.

    The paper does not specify the source.
    """

    DETECTIONS = "the evidence of its detections"
    VOXELS = "the evidence of its voxels, summed"


@dataclass(frozen=True)
class Confirmation:
    """Conditions for an instance to be part of the results.

    Other instances are tentative. The default of `min_confidence` is low because unlikely instances reduce precision
    less than missing instances reduce recall.
    """

    min_observations: int = 3  # minimum number of frames with a detection to confirm an instance, >= 1
    # minimum confidence to confirm an instance (mean score times detection rate while visible), in [0, 1]
    min_confidence: float = 0.05
    min_area: float = 0.01  # minimum surface area of a confirmed instance, m^2, >= 0; voxel_size^2 per mesh vertex

    def __post_init__(self) -> None:
        check_bounds(self, min_observations=(1, 2**31), min_confidence=(0.0, 1.0), min_area=(0.0, 1000.0))

    @classmethod
    def of(cls, saved: MapHeader) -> Confirmation:
        """Return the conditions in the header of a map file.

        Raises:
            DataError: If a value is missing or has the wrong type.
            ConfigError: If a value is out of range.
        """
        return cls(saved.whole("min_observations"), saved.number("min_confidence"), saved.number("min_area"))

    def is_met(self, record: InstanceRecord) -> bool:
        """Return True if an instance meets all conditions but the minimum area."""
        return record.observations >= self.min_observations and record.confidence >= self.min_confidence

    def counts(self, table: InstanceTable) -> Bool:
        """Return a Boolean array (last id + 1,), True for instances that meet all conditions but the minimum area."""
        counts = np.zeros(table.last_id + 1, np.bool_)
        counts[[*table.confirmed(self)]] = True
        return counts

    def min_vertices(self, voxel_size: float) -> int:
        """Return the number of mesh vertices of an instance with the minimum area, given the voxel size, m."""
        return vertices_of_area(self.min_area, voxel_size)

    def too_small(self, instance_ids: Int32, voxel_size: float) -> Bool:
        """Return a Boolean array (V,), True for the vertices of instances with less than the minimum area.

        Args:
            instance_ids: The instance (V,) of each vertex, 0 = none.
            voxel_size: The voxel size, m.
        """
        return np.asarray((np.bincount(instance_ids) < self.min_vertices(voxel_size))[instance_ids])


class InstanceTableMap(SceneMap):
    """A map with an instance table.

    `mesh` and `instances` contain only confirmed instances, and `render` contains all instances. `instance_ids` and
    `most_likely_classes` do not create a mesh. Therefore, they ignore the minimum area.
    """

    table: InstanceTable
    confirmation: Confirmation
    listed: ListedInstances  # the instances of the current mesh

    @property
    def embedding_space(self) -> str:
        return self.table.embedding_space

    def digest(self) -> int:
        return zlib.crc32(_checksum(self.instance_ids()).to_bytes(4, "little"), super().digest())

    def calibrate(self, calibration: Path | None) -> None:
        """Set the calibration of the instances.

        Raises:
            DataError: The file is missing or invalid.
        """
        self.table.calibration = InstanceCalibration() if calibration is None else InstanceCalibration.read(calibration)

    def instance_ids(self) -> frozenset[int]:
        return self.table.confirmed(self.confirmation)

    def most_likely_classes(self) -> Mapping[int, tuple[int, float]]:
        records = self.table.records
        return {
            k: (int(evidence.argmax()), self.table.probabilities(records[k], evidence).exists)
            for k, evidence in self.class_evidence().items()
        }

    def class_evidence(self) -> dict[int, Float64]:
        """Return the class evidence (C,) of each confirmed instance by id, from its detections."""
        confirmed = self.table.confirmed(self.confirmation)
        return {k: record.class_evidence for k, record in self.table.records.items() if k in confirmed}

    def begin(self, classes: tuple[str, ...]) -> None:
        """Set the label space of the map.

        Raises:
            DataError: If the map has a different label space.
        """
        self.classes = agreed_classes(self.classes, classes)

    def instances(self) -> Mapping[int, Instance]:
        """Return the instances that have mesh vertices, in ascending order of their ids.

        Oriented boxes are upright if the gravity direction is known.
        """
        return self.listed.of(self.mesh(), self._list)

    def _list(self, mesh: InstanceMesh) -> InstanceList:
        up, known, class_ids = self.gravity().up, {}, {}
        for k, evidence in self.class_evidence().items():
            record, distribution = self.table.records[k], self.table.distribution(evidence)
            class_ids[k] = int(distribution.argmax())
            probabilities = self.table.probabilities(record, evidence)
            known[k] = partial(
                Instance,
                id=k,
                class_probabilities=distribution,
                confidence=record.confidence,
                observations=record.observations,
                first_frame=record.first_frame,
                last_frame=record.last_frame,
                embedding=None if record.embedding is None else record.embedding.mean,
                embedding_spread=None if record.embedding is None else record.embedding.spread,
                exists=probabilities.exists,
                class_probability=probabilities.class_probability,
                expected_iou=probabilities.expected_iou,
            )

        def create(k: int, vertices: Int32) -> Instance:
            points = mesh.vertices[vertices]
            return known[k](vertices=vertices, aabb=aligned_box(points), obb=box_around(points, up))

        return InstanceList(mesh, vertices_by_id(mesh.instance_ids), class_ids, create)


class InstanceList(Mapping[int, Instance]):
    """The instances of a mesh by id, in ascending order. Each is created when it is first accessed.

    Later changes to the map have no effect.
    """

    def __init__(
        self,
        mesh: InstanceMesh,
        vertices: Mapping[int, Int32],
        class_ids: Mapping[int, int],
        create: Callable[[int, Int32], Instance],
    ) -> None:
        """List instances of a mesh.

        Args:
            mesh: The mesh.
            vertices: The ascending vertex indices (M,) of each instance by id.
            class_ids: The most likely class of each instance by id.
            create: Function that returns an instance, given its id and its vertices (M,). It must not read the map,
                which may have changed.
        """
        self._mesh, self._vertices, self._class_ids, self._create = mesh, vertices, class_ids, create
        self._created: dict[int, Instance] = {}
        self._of_class: dict[int, InstanceList] = {}

    def __getitem__(self, key: int) -> Instance:
        if key not in self._created:
            created = self._create(key, self._vertices[key])
            self._created.setdefault(key, created)  # another thread may have created it
        return self._created[key]

    def __contains__(self, key: object) -> bool:
        return key in self._vertices

    def __iter__(self) -> Iterator[int]:
        return iter(self._vertices)

    def __len__(self) -> int:
        return len(self._vertices)

    def __reduce__(self) -> tuple[type, tuple[dict[int, Instance]]]:
        return dict, (dict(self),)

    def of_class(self, class_id: int) -> InstanceList:
        """Return the instances with the given most likely class."""
        if class_id not in self._of_class:
            chosen = {key: vertices for key, vertices in self._vertices.items() if self._class_ids[key] == class_id}
            self._of_class[class_id] = InstanceList(self._mesh, chosen, self._class_ids, lambda key, _: self[key])
        return self._of_class[class_id]

    def mesh_of(self, key: int) -> InstanceMesh:
        """Return the mesh of an instance: its vertices, in order, and the triangles between them."""
        triangles = self._triangles.get(key, np.zeros(0, np.int32))
        return self._mesh.part(self._vertices[key], self._mesh.triangles[triangles])

    @cached_property
    def _triangles(self) -> dict[int, Int32]:
        """Ascending indices of the triangles of each instance."""
        a, b, c = (self._mesh.instance_ids[self._mesh.triangles[:, k]] for k in range(3))
        return vertices_by_id(np.where((a == b) & (b == c), a, np.int32(0)))

    @cached_property
    def bounds(self) -> tuple[Float64, Float64]:
        """Minimum and maximum coordinates (N, 3) of the vertices of each instance in the world frame, m."""
        if not self._vertices:
            return np.zeros((0, 3)), np.zeros((0, 3))
        vertices = list(self._vertices.values())
        points = self._mesh.vertices[np.concatenate(vertices)].astype(np.float64)
        starts = np.cumsum([0, *map(len, vertices[:-1])])
        return np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)


def bounds_of(instances: Mapping[int, Instance]) -> tuple[Float64, Float64]:
    """Return the minimum and maximum coordinates (N, 3) of each instance in the world frame, m."""
    if isinstance(instances, InstanceList):  # without creating the instances
        return instances.bounds
    centers, extents = (
        np.array([getattr(one.aabb, side) for one in instances.values()], np.float64).reshape(-1, 3)
        for side in ("center", "extent")
    )
    return centers - extents / 2, centers + extents / 2


class ListedInstances:
    """The instances of a map, listed again when the map has another mesh.

    A map has another mesh after each change to its labels, its instances or its surface.
    """

    def __init__(self) -> None:
        self._mesh: InstanceMesh | None = None
        self._instances: Mapping[int, Instance] = {}

    def __reduce__(self) -> tuple[type[ListedInstances], tuple[()]]:
        return ListedInstances, ()

    def of(self, mesh: InstanceMesh, list_: Callable[[InstanceMesh], Mapping[int, Instance]]) -> Mapping[int, Instance]:
        """Return the instances of the current mesh, which `list_` returns for a mesh."""
        if mesh is not self._mesh:
            self._instances, self._mesh = list_(mesh), mesh
        return self._instances


@lru_cache(maxsize=16)
def _checksum(instance_ids: frozenset[int]) -> int:
    """Return a CRC-32 of ids. It is cached, because they change in few frames."""
    return zlib.crc32(repr(sorted(instance_ids)).encode())


def vertices_of_area(area: float, voxel_size: float) -> int:
    """Return the approximate number of mesh vertices of a surface.

    Args:
        area: The area of the surface, m^2.
        voxel_size: The voxel size, m.
    """
    # Exact for surfaces parallel to the grid. The mesh has one vertex per voxel that the surface crosses, so other
    # surfaces have up to sqrt(3) times as many vertices.
    return max(MIN_VERTICES, round(area / voxel_size**2))


def vertices_by_id(instance_ids: Int32) -> dict[int, Int32]:
    """Return the ascending vertex indices of each instance by id, given the instance (V,) of each vertex.

    Id 0 is omitted.
    """
    labeled = np.flatnonzero(instance_ids > 0).astype(np.int32)
    ids = instance_ids[labeled]
    # NumPy uses the faster radix sort for 16-bit keys
    order = np.argsort(ids.astype(np.uint16) if ids.max(initial=0) < 2**16 else ids, kind="stable")
    ids, vertices = ids[order], labeled[order]
    starts = np.flatnonzero(np.diff(ids, prepend=0))
    return dict(zip(ids[starts].tolist(), np.split(vertices, starts[1:]), strict=False))


def aligned_box(points: Float32) -> Box:
    """Return the axis-aligned bounding box of points (M, 3), m."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    return Box((low + high) / 2, high - low, np.eye(3))


def box_around(points: Float32, up: Float64 | None) -> Box:
    """Return the upright bounding box of points (M, 3), m, or their oriented box if `up` is None."""
    return oriented_box(points) if up is None else upright_box(points, up)


def upright_box(points: Float32, up: Float64) -> Box:
    """Return the bounding box of points (M, 3), m, with its third axis along `up` and the smallest base.

    `up` is a unit vector (3,).
    """
    ground_axes = np.linalg.svd(up[None])[2][1:]  # (2, 3)
    center = points.mean(axis=0, dtype=np.float64)
    ground, heights = (points - center) @ ground_axes.T, (points - center) @ up
    (u, v), (width, depth), angle = cv2.minAreaRect(ground.astype(np.float32))
    cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    x_axis = cosine * ground_axes[0] + sine * ground_axes[1]
    rotation = np.stack([x_axis, np.cross(up, x_axis), up], axis=1)
    low, high = float(heights.min()), float(heights.max())
    middle = center + u * ground_axes[0] + v * ground_axes[1] + (low + high) / 2 * up
    return Box(middle, np.array([width, depth, high - low], np.float64), rotation)


def oriented_box(points: Float32) -> Box:
    """Return the bounding box along the principal axes of points (M, 3), m.

    The points may be coplanar.
    """
    import open3d as o3d  # takes 0.5 s and 170 MB; maps with known gravity do not need it

    four = np.resize(points, (max(len(points), 4), 3))  # Qhull needs four points; repeated points do not change the box
    box = o3d.geometry.OrientedBoundingBox.create_from_points(
        o3d.utility.Vector3dVector(four.astype(np.float64)), robust=True
    )
    return Box(np.asarray(box.center), np.asarray(box.extent), np.asarray(box.R))
