"""A map that knows classes and no instances: these are found, when asked for, as connected surface of one class."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.baselines.class_evidence import ClassEvidence, ClassRows
from framework.baselines.connected_components import component_statistics, connected_components, vertex_classes
from framework.baselines.semantic_map_kernels import label_view
from framework.data import Camera, Float32, Float64, Instance, InstanceMesh, SurfaceView, View
from framework.interfaces import SceneMap
from framework.mapping.instances.association import agreed_classes
from framework.mapping.instances.instance_list import aligned_box, box_around, vertices_by_id, vertices_of_area
from framework.mapping.storage.map_file import faults_of, read_map, write_map
from framework.mapping.voxels.integration_parameters import pinhole
from framework.mapping.voxels.meshing import UnlabeledMesh
from framework.mapping.voxels.tsdf_volume import BLOCK_ARRAYS, TsdfVolume

MISSED, AREA = (1e-6, 1.0), (0.0, 1000.0)  # bounds of what a map is made with; m^2
FORMAT = "semantic 3"  # of the saved file; a change of meaning counts it up


class SemanticMap(SceneMap):
    """A TSDF with a distribution over the classes and the background in its voxels.

    `missed` is the probability that a surface of any class lies under no mask of a frame that sees it. An instance has
    an id only in the mesh as it is now: more frames may give the same object another one.
    """

    def __init__(self, volume: TsdfVolume, missed: float, min_area: float) -> None:
        self.classes: tuple[str, ...] = ()
        self.volume = volume
        self.missed = missed
        self.min_area = min_area
        self.labels = ClassRows(volume.voxels)

    def begin(self, classes: tuple[str, ...]) -> None:
        """Takes the first frame's label space for the map's. Raises DataError for another one later."""
        if not self.classes:
            self.labels.begin(len(classes))
        self.classes = agreed_classes(self.classes, classes)

    @property
    def voxel_count(self) -> int:
        return self.volume.voxel_count

    @property
    def byte_count(self) -> int:
        return self.volume.voxels.byte_count + self.labels.byte_count

    @property
    def depth_range(self) -> tuple[float, float]:
        return self.volume.sensor.depth_range

    @property
    def evictions(self) -> int:
        return self.labels.evicted

    @property
    def instance_count(self) -> int:
        """Without their boxes."""
        return int(self.mesh().instance_ids.max(initial=0))

    @property
    def _log_missed(self) -> np.float32:
        return np.float32(np.log(self.missed))

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        """Surface and classes. Voxels know no instance, so that it shows none."""
        surface = self.volume.render(camera, T_world_camera)
        class_ids = np.empty(camera.shape, np.int32)
        view = pinhole(camera, T_world_camera)
        label_view(self.volume.voxels.grid, self.labels.evidence, self._log_missed, view, surface.depth, class_ids)
        return View(**vars(surface), instance_ids=np.zeros(camera.shape, np.int32), class_ids=class_ids)

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        return self.volume.render_near(camera, T_world_camera, depth)

    def mesh(self) -> InstanceMesh:
        return self.volume.mesh(self._labeled)

    def _labeled(self, surface: UnlabeledMesh) -> InstanceMesh:
        colors, class_ids = vertex_classes(self.volume.voxels.grid, self.labels.evidence, self._log_missed, surface)
        least = vertices_of_area(self.min_area, self.volume.voxel_size)
        instance_ids = connected_components(surface.triangles, class_ids, least)
        class_ids[instance_ids == 0] = -1
        return InstanceMesh(surface.vertices, surface.triangles, colors, instance_ids, class_ids, self.classes)

    def instances(self) -> Mapping[int, Instance]:
        """The components of the mesh.

        A component's distribution is the mean of those of its vertices' nearest voxels, without the background; its
        confidence is the mean probability of its class, background included: what share of its surface the map
        believes to be of that class. Observations are the most frames in which one of these voxels was under a mask.
        """
        mesh = self.mesh()
        surface = self.volume.surface()
        statistics = component_statistics(
            self.volume.voxels.grid,
            self.labels.evidence,
            self._log_missed,
            surface,
            mesh.instance_ids,
            len(self.classes),
        )
        instances, up = {}, self.up()
        for k, vertices in vertices_by_id(mesh.instance_ids).items():
            sums, points = statistics.probability_sums[k], mesh.vertices[vertices]
            instances[k] = Instance(
                id=k,
                class_probabilities=(sums / sums.sum()).astype(np.float32),
                confidence=float(sums[mesh.class_ids[vertices[0]]] / statistics.vertices[k]),
                observations=int(statistics.masked[k]),
                first_frame=int(statistics.first_frame[k]),
                last_frame=int(statistics.last_frame[k]),
                vertices=vertices,
                aabb=aligned_box(points),
                obb=box_around(points, up),
            )
        return instances

    def up(self) -> Float64 | None:
        return self.volume.up()

    @property
    def up_is_sensed(self) -> bool:
        return self.volume.gravity.sensed() is not None

    def save(self, path: Path | str) -> None:
        header, arrays = self.volume.saved()
        header |= {
            "format": FORMAT,
            "missed": self.missed,
            "min_area": self.min_area,
            "classes": self.classes,
            "evicted": self.labels.evicted,
        }
        write_map(path, header, arrays | self.labels.saved())

    @classmethod
    def load(cls, path: Path | str) -> SemanticMap:
        header, arrays = read_map(path, FORMAT, (*BLOCK_ARRAYS, *ClassEvidence._fields))
        with faults_of(path):
            volume = TsdfVolume.load(header, arrays, len(arrays["rest"]))
            scene = cls(volume, header.number("missed", MISSED), header.number("min_area", AREA))
            classes = header.classes()
            scene.begin(classes)
            scene.labels.fill(arrays, len(classes))
            scene.labels.evicted = header.whole("evicted")
        return scene
