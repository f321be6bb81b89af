"""Semantic map: voxels store classes, and instances are connected components of one class in the mesh."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array

from framework.baselines.class_evidence import ClassEvidence, ClassRows
from framework.baselines.semantic_map_kernels import (
    connect_vertices,
    label_classes,
    label_view,
    smooth_classes,
    sum_components,
)
from framework.data import Camera, Float32, Float64, Instance, InstanceMesh, Int32, SurfaceView, View
from framework.interfaces import Gravity, MapStatistics, SceneMap
from framework.mapping.instances.association import agreed_classes
from framework.mapping.instances.instance_list import (
    InstanceList,
    ListedInstances,
    aligned_box,
    box_around,
    vertices_by_id,
    vertices_of_area,
)
from framework.mapping.storage.map_file import map_contents, write_map
from framework.mapping.voxels.integration_parameters import pinhole
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.packed_voxels import STORED_VOXELS
from framework.mapping.voxels.tsdf_volume import VOLUME_ARRAYS, TsdfVolume
from framework.sensors.noise_models import SensorKind

ABSENCE, AREA, SMOOTHNESS = (1e-6, 1.0), (0.0, 1000.0), (0.0, 1000.0)  # bounds
SWEEPS = 20  # maximum number of sweeps of the regularization
FORMAT = "semantic 5"  # format of the map file; increment it when the meaning of the contents changes


class Elections(NamedTuple):
    """Parameters for the classes and instances of the mesh."""

    absence_likelihood_ratio: float  # likelihood ratio P(no mask | any class) / P(no mask | background)
    min_area: float  # minimum surface area of an instance, m^2
    smoothness: float  # log-odds for each neighboring vertex of the same class


class ComponentStatistics(NamedTuple):
    """Statistics of K instances, indexed by id.

    The statistics are over the voxels nearest to the vertices. Entry 0 is unused.
    """

    probability_sums: Float64  # (K + 1, C) sums of P(class) over the vertices
    masked: Int32  # (K + 1,) maximum, over the voxels, of the number of frames under a mask
    first_frame: Int32  # (K + 1,) first frame in which any of the voxels was under a mask, -1 = none
    last_frame: Int32  # (K + 1,) last frame in which any of the voxels was under a mask, -1 = none


class SemanticMap(SceneMap):
    """A TSDF volume with a distribution over classes and background in each voxel.

    Instance ids are valid for the current mesh only.
    """

    def __init__(self, volume: TsdfVolume, elections: Elections) -> None:
        self.classes: tuple[str, ...] = ()
        self.volume = volume
        self.elections = elections
        self.labels = ClassRows(volume.voxels)
        self.listed = ListedInstances()

    def begin(self, classes: tuple[str, ...]) -> None:
        """Set the label space of the map.

        Raises:
            DataError: If the map has a different label space, or if there are too many classes.
        """
        if not self.classes:
            self.labels.begin(len(classes))
        self.classes = agreed_classes(self.classes, classes)

    @property
    def statistics(self) -> MapStatistics:
        size = self.volume.voxels.byte_count + self.labels.byte_count
        return MapStatistics(self.volume.voxel_count, size, self.labels.evicted)

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.volume.sensor.depth_range

    def instance_ids(self) -> frozenset[int]:
        return frozenset(range(1, 1 + int(self.mesh().instance_ids.max(initial=0))))

    @property
    def _log_missed(self) -> np.float32:
        return np.float32(np.log(self.elections.absence_likelihood_ratio))

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        """Return the view with classes.

        All instance ids are 0, because voxels have no instances.
        """
        surface = self.volume.render(camera, T_world_camera)
        class_ids = np.empty(camera.shape, np.int32)
        view = pinhole(camera, T_world_camera)
        label_view(self.volume.voxels.grid, self.labels.evidence, self._log_missed, view, surface.depth, class_ids)
        return View(**vars(surface), instance_ids=np.zeros(camera.shape, np.int32), class_ids=class_ids)

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        return self.volume.render_near(camera, T_world_camera, depth, sensor)

    def mesh(self) -> InstanceMesh:
        return self.volume.mesh(self._labeled)

    def _labeled(self, surface: UnlabeledMesh) -> InstanceMesh:
        """Return the mesh with instances and classes."""
        colors, class_ids = np.empty((len(surface.voxels), 3), np.uint8), np.empty(len(surface.voxels), np.int32)
        label_classes(self.volume.voxels.grid, self.labels.evidence, self._log_missed, surface, colors, class_ids)
        if self.elections.smoothness > 0:
            self._smooth(surface, class_ids)
        min_vertices = vertices_of_area(self.elections.min_area, self.volume.voxel_size)
        instance_ids = connected_components(surface.triangles, class_ids, min_vertices)
        class_ids[instance_ids == 0] = -1
        return InstanceMesh(surface.vertices, surface.triangles, colors, instance_ids, class_ids, self.classes)

    def _smooth(self, surface: UnlabeledMesh, class_ids: Int32) -> None:
        """Regularize the classes (V,) in place with a Potts model over the edges of the mesh."""
        # iterated conditional modes (Besag, 1986)
        starts, neighbors = vertex_neighbors(surface.triangles, len(class_ids))
        grid, evidence = self.volume.voxels.grid, self.labels.evidence
        smoothness = np.float32(self.elections.smoothness)
        for _ in range(SWEEPS):
            if not smooth_classes(
                grid, evidence, self._log_missed, surface.voxels, starts, neighbors, smoothness, class_ids
            ):
                break

    def instances(self) -> Mapping[int, Instance]:
        """Return the connected components of the mesh as instances.

        The class distribution is the mean over the voxels nearest to the vertices, renormalized without the background.
        The confidence is the mean probability of the class of the instance before this normalization. The number of
        observations is the maximum, over these voxels, of the number of frames under a mask.
        """
        return self.listed.of(self.mesh(), self._list)

    def _list(self, mesh: InstanceMesh) -> InstanceList:
        up = self.gravity().up
        found = self._sum_components(self.volume.surface().voxels, mesh.instance_ids)

        vertices_of = vertices_by_id(mesh.instance_ids)
        sums_of = {k: found.probability_sums[k] for k in vertices_of}
        distributions = {k: (sums / sums.sum()).astype(np.float32) for k, sums in sums_of.items()}

        def create(k: int, vertices: Int32) -> Instance:
            sums, points = sums_of[k], mesh.vertices[vertices]
            return Instance(
                id=k,
                class_probabilities=distributions[k],
                confidence=float(sums[mesh.class_ids[vertices[0]]] / len(vertices)),
                observations=int(found.masked[k]),
                first_frame=int(found.first_frame[k]),
                last_frame=int(found.last_frame[k]),
                vertices=vertices,
                aabb=aligned_box(points),
                obb=box_around(points, up),
            )

        class_ids = {k: int(distribution.argmax()) for k, distribution in distributions.items()}
        return InstanceList(mesh, vertices_of, class_ids, create)

    def _sum_components(self, voxels: Int32, instance_ids: Int32) -> ComponentStatistics:
        entries = 1 + int(instance_ids.max(initial=0))
        masked, first_frame, last_frame = np.zeros(entries, np.int32), *np.full((2, entries), -1, np.int32)
        found = ComponentStatistics(np.zeros((entries, len(self.classes))), masked, first_frame, last_frame)
        grid = self.volume.voxels.grid
        sum_components(grid, self.labels.evidence, self._log_missed, voxels, instance_ids, found)
        return found

    def gravity(self) -> Gravity:
        return self.volume.gravity()

    def save(self, path: Path | str) -> None:
        header, arrays = self.volume.saved()
        header |= {
            "format": FORMAT,
            **self.elections._asdict(),
            "classes": self.classes,
            "evicted": self.labels.evicted,
        }
        write_map(path, header, arrays | self.labels.saved(), stored=STORED_VOXELS)

    @classmethod
    def load(cls, path: Path | str) -> SemanticMap:
        with map_contents(path, FORMAT, (*VOLUME_ARRAYS, *ClassEvidence._fields)) as (header, arrays):
            volume = TsdfVolume.load(header, arrays, len(arrays["rest"]))
            bounds = {"absence_likelihood_ratio": ABSENCE, "min_area": AREA, "smoothness": SMOOTHNESS}
            scene = cls(volume, Elections(**{name: header.number(name, limits) for name, limits in bounds.items()}))
            classes = header.classes()
            scene.begin(classes)
            scene.labels.fill(arrays, len(classes))
            scene.labels.evicted = header.whole("evicted")
        return scene


def connected_components(triangles: Int32, class_ids: Int32, min_vertices: int) -> Int32:
    """Return the component (V,) of each vertex, 0 = none.

    Components are numbered from 1 in the order of their first vertices.

    Args:
        triangles: The triangles (F, 3).
        class_ids: The class (V,) of each vertex, -1 = none.
        min_vertices: The minimum number of vertices of a component.
    """
    components = np.empty(len(class_ids), np.int32)
    connect_vertices(triangles, class_ids, components)
    counts = np.bincount(components[class_ids >= 0], minlength=len(components)) >= min_vertices
    return np.where((class_ids >= 0) & counts[components], np.cumsum(counts)[components], 0).astype(np.int32)


def vertex_neighbors(triangles: Int32, count: int) -> tuple[Int32, Int32]:
    """Return the neighbors of each vertex along the edges of triangles (F, 3).

    The neighbors of vertex v are indices[starts[v] : starts[v + 1]], where `starts` (count + 1,) and `indices` are the
    results.
    """
    a, b = (triangles[:, sides].ravel() for sides in ([0, 1, 2], [1, 2, 0]))
    both = np.concatenate([a, b]), np.concatenate([b, a])
    edges = coo_array((np.ones(len(both[0]), np.bool_), both), (count, count)).tocsr()
    return edges.indptr.astype(np.int32), edges.indices.astype(np.int32)
