"""Instances of a map, their confirmation and their boxes."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Bool, Box, Float32, Float64, Instance, Int32
from framework.interfaces import SceneMap
from framework.mapping.instances.association import agreed_classes
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
        for record in table.records.values():
            counts[record.id] = self.is_met(record)
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

    @property
    def embedding_space(self) -> str:
        return self.table.embedding_space

    def digest(self) -> int:
        return zlib.crc32(repr(sorted(self.instance_ids())).encode(), super().digest())

    def instance_ids(self) -> frozenset[int]:
        return frozenset(np.flatnonzero(self.confirmation.counts(self.table)).tolist())

    def most_likely_classes(self) -> Mapping[int, tuple[int, float]]:
        evidence = self.class_evidence()
        return {k: (int(evidence[k].argmax()), self.table.records[k].confidence) for k in evidence}

    def class_evidence(self) -> dict[int, Float64]:
        """Return the class evidence (C,) of each confirmed instance by id, from its detections."""
        confirmed = filter(self.confirmation.is_met, self.table.records.values())
        return {record.id: record.class_evidence for record in confirmed}

    def begin(self, classes: tuple[str, ...]) -> None:
        """Set the label space of the map.

        Raises:
            DataError: If the map has a different label space.
            ConfigError: If the map does not support the label space.
        """
        self.check_classes(classes)
        self.classes = agreed_classes(self.classes, classes)

    def instances(self) -> Mapping[int, Instance]:
        """Return the instances that have mesh vertices, in ascending order of their ids.

        Oriented boxes are upright if the gravity direction is known.
        """
        mesh, up, instances = self.mesh(), self.gravity().up, {}
        class_evidence = self.class_evidence()
        for k, vertices in vertices_by_id(mesh.instance_ids).items():
            record, points = self.table.records[k], mesh.vertices[vertices]
            instances[k] = Instance(
                id=k,
                class_probabilities=self.table.distribution(class_evidence[k]),
                confidence=record.confidence,
                observations=record.observations,
                first_frame=record.first_frame,
                last_frame=record.last_frame,
                vertices=vertices,
                aabb=aligned_box(points),
                obb=box_around(points, up),
                embedding=None if record.embedding is None else record.embedding.mean,
                embedding_spread=None if record.embedding is None else record.embedding.spread,
            )
        return instances


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
    order = np.argsort(instance_ids, kind="stable").astype(np.int32)
    ids, starts = np.unique(instance_ids[order], return_index=True)
    return {int(k): vertices for k, vertices in zip(ids, np.split(order, starts[1:]), strict=False) if k > 0}


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
