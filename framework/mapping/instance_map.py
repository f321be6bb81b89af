"""The map of object instances: voxels, label evidence and the table of instances, as one SceneMap."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import open3d as o3d

from framework.atomic_files import written_whole
from framework.data import Bool, Box, Camera, Float32, Float64, Instance, InstanceMesh, Int32, SurfaceView, View
from framework.errors import DataError
from framework.interfaces import SceneMap
from framework.mapping.evidence import Combine, Evidence, EvidenceRows, Storage
from framework.mapping.instance_table import InstanceRecord, InstanceTable
from framework.mapping.meshing import SurfaceNets
from framework.mapping.raycasting import render, render_near
from framework.mapping.sensor import Sensor
from framework.mapping.vertex_labels import vertex_labels
from framework.mapping.voxel_grid import BLOCK_VOXELS, VoxelGrid, find_solid_blocks

FORMAT = 3  # of the saved file; a change of meaning counts it up
BLOCK_ARRAYS = ("block_coords", "tsdf", "weight", "color", "label_row")  # of the grid, that are saved
NO_BLOCKS = np.zeros(0, np.int32)
ARRAYS = (*BLOCK_ARRAYS, *Evidence._fields)


class InstanceMap(SceneMap):
    """A TSDF with instance and class evidence in its voxels. Fusers write its parts; everybody else reads.

    An instance counts, in `mesh` and `instances`, once it has been observed `min_observations` times, its confidence
    is `min_confidence` and it has `min_vertices` vertices; before, it is tentative: `render` shows it, as association
    needs it.
    """

    def __init__(
        self,
        voxel_size: float,
        sensor: Sensor,
        max_blocks: int,
        min_observations: int,
        min_confidence: float,
        min_vertices: int,
        combine: Combine = Combine.SUM,
        logarithmic: bool = True,
        storage: Storage = Storage.COMPACT,
    ) -> None:
        self.classes: tuple[str, ...] = ()
        self.sensor = sensor
        self.min_observations = min_observations
        self.min_confidence = min_confidence
        self.min_vertices = min_vertices
        self.voxels = VoxelGrid(voxel_size, sensor.max_truncation, max_blocks)
        self.labels = EvidenceRows(self.voxels, combine, storage)
        self.table = InstanceTable(combine, logarithmic)

    @property
    def voxel_size(self) -> float:
        """m"""
        return float(self.voxels.grid.voxel_size)

    @property
    def voxel_count(self) -> int:
        return self.voxels.block_count * BLOCK_VOXELS

    @property
    def byte_count(self) -> int:
        return self.voxels.byte_count + self.labels.byte_count

    @property
    def evictions(self) -> int:
        return self.labels.evicted

    @property
    def instance_count(self) -> int:
        """Without the condition on vertices, which takes a mesh."""
        return int(self._counts().sum())

    def begin(self, classes: tuple[str, ...]) -> None:
        """Takes the first frame's label space for the map's."""
        self.classes = classes
        self.labels.begin(len(classes))

    def changed(self, blocks: Int32 | None = None) -> None:
        """To be called after the map was written: what was derived from it is out of date.

        `blocks` (A,) are the numbers of those whose voxels were written; None = perhaps all.
        """
        self.__dict__.pop("_mesh", None)
        if blocks is None:
            self.__dict__.pop("_surface", None)
        elif "_surface" in self.__dict__:
            self._surface.changed(blocks)

    def merge(self, kept: int, dropped: int) -> None:
        """Makes instance `dropped` a part of `kept`, in the table and in every voxel."""
        self.table.merge(kept, dropped)
        self.labels.merge_instances(kept, dropped)
        self.changed(NO_BLOCKS)

    def render(self, camera: Camera, T_world_camera: Float64) -> View:
        return render(self.voxels, self.labels.evidence, self.sensor, camera, T_world_camera)

    def render_near(self, camera: Camera, T_world_camera: Float64, depth: Float32) -> SurfaceView:
        return render_near(self.voxels, self.sensor, camera, T_world_camera, depth)

    def mesh(self) -> InstanceMesh:
        return self._mesh

    @cached_property
    def _surface(self) -> SurfaceNets:
        """Made when a mesh is first asked for: who never asks pays nothing."""
        return SurfaceNets(self.voxels)

    @cached_property
    def _mesh(self) -> InstanceMesh:
        surface = self._surface.extract()
        counts = self._counts()
        colors, instance_ids, class_ids = vertex_labels(self.voxels.grid, self.labels.evidence, counts, surface)
        too_small = np.bincount(instance_ids, minlength=len(counts)) < self.min_vertices
        dropped = too_small[instance_ids]
        instance_ids[dropped] = 0
        class_ids[dropped] = -1
        return InstanceMesh(surface.vertices, surface.triangles, colors, instance_ids, class_ids, self.classes)

    def _counts(self) -> Bool:
        """(ids + 1,) whether an instance has been observed often enough, by id."""
        counts = np.zeros(self.table.last_id + 1, np.bool_)
        for record in self.table.records.values():
            enough = record.observations >= self.min_observations
            counts[record.id] = enough and record.confidence >= self.min_confidence
        return counts

    def instances(self) -> Mapping[int, Instance]:
        mesh = self.mesh()
        order = np.argsort(mesh.instance_ids, kind="stable").astype(np.int32)
        ids, starts = np.unique(mesh.instance_ids[order], return_index=True)
        ends = [*starts[1:], len(order)]
        return {
            int(k): self._instance(self.table.records[int(k)], order[start:end], mesh.vertices[order[start:end]])
            for k, start, end in zip(ids, starts, ends, strict=False)
            if k > 0
        }

    def _instance(self, record: InstanceRecord, vertices: Int32, points: Float32) -> Instance:
        low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
        return Instance(
            id=record.id,
            class_probabilities=self.table.class_probabilities(record),
            confidence=record.confidence,
            observations=record.observations,
            first_frame=record.first_frame,
            last_frame=record.last_frame,
            vertices=vertices,
            aabb=Box((low + high) / 2, high - low, np.eye(3)),
            obb=_oriented_box(points),
        )

    def save(self, path: Path) -> None:
        grid, evidence = self.voxels.grid, self.labels.evidence
        b, r = self.voxels.block_count, self.labels.row_count
        header = {
            "format": FORMAT,
            "voxel_size": self.voxel_size,
            "sensor": {name: float(value) for name, value in self.sensor._asdict().items()},
            "max_blocks": self.voxels.max_blocks,
            "min_observations": self.min_observations,
            "min_confidence": self.min_confidence,
            "min_vertices": self.min_vertices,
            "combine": self.labels.combine.name,
            "logarithmic": self.table.logarithmic,
            "storage": self.labels.storage.name,
            "classes": self.classes,
            "last_id": self.table.last_id,
            "evicted": self.labels.evicted,
            "instances": [
                {
                    **asdict(record),
                    "class_evidence": record.class_evidence.tolist(),
                    "observed_in": sorted(record.observed_in),
                }
                for record in self.table.records.values()
            ],
        }
        arrays: dict[str, npt.NDArray[Any]] = {
            "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
            **{name: getattr(grid, name)[:b] for name in BLOCK_ARRAYS},
            **{name: array[:r] for name, array in evidence._asdict().items()},
        }
        with written_whole(path) as temporary:
            _write(temporary, arrays)

    @classmethod
    def load(cls, path: Path) -> InstanceMap:
        header, arrays = _read(path)
        scene = cls(
            header["voxel_size"],
            Sensor(**{name: np.float32(value) for name, value in header["sensor"].items()}),
            header["max_blocks"],
            header["min_observations"],
            header["min_confidence"],
            header["min_vertices"],
            Combine[header["combine"]],
            header["logarithmic"],
            Storage[header["storage"]],
        )
        scene.begin(tuple(header["classes"]))
        scene.voxels.allocate(arrays["block_coords"])
        b = scene.voxels.block_count
        for name in BLOCK_ARRAYS:
            getattr(scene.voxels.grid, name)[:b] = arrays[name]
        find_solid_blocks(scene.voxels.grid, b)
        scene.labels.evidence = Evidence(**{name: arrays[name] for name in Evidence._fields})
        scene.labels.row_count = len(scene.labels.evidence.instance_ids)
        scene.labels.evicted = header["evicted"]
        scene.table.last_id = header["last_id"]
        for entry in header["instances"]:
            evidence, observed_in = np.array(entry.pop("class_evidence")), set(entry.pop("observed_in"))
            record = InstanceRecord(class_evidence=evidence, observed_in=observed_in, **entry)
            scene.table.records[record.id] = record
        return scene


def _write(path: Path, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Writes an .npz as np.load reads it: the same arrays give the same bytes, and light compression.

    Label rows are mostly zeros and distances far from the surface all alike: level 1 makes a map a fifth of its size,
    at about the speed of a disk.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            file = io.BytesIO()
            np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), file.getbuffer(), zipfile.ZIP_DEFLATED, compresslevel=1)


def _read(path: Path) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The header and the arrays of a saved map. Raises DataError for another format or a checksum that fails."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise DataError(f"{path}: the checksum of {damaged} does not hold; the file is damaged, map again")
        with np.load(path, allow_pickle=False) as file:
            header = json.loads(file["header"].tobytes())
            if header.get("format") != FORMAT:  # its arrays may have other names
                raise DataError(f"{path} has map format {header.get('format')}, this version reads {FORMAT}; map again")
            arrays = {name: file[name] for name in ARRAYS}
    except (OSError, EOFError, ValueError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path} is not a map that can be read: {error}") from error
    return header, arrays


def _oriented_box(points: Float32) -> Box:
    """The box along the principal axes of the points' convex hull (Open3D); `robust` lets flat and thin sets pass."""
    four = np.resize(points, (max(len(points), 4), 3))  # Qhull refuses fewer; repeated points change nothing
    box = o3d.geometry.OrientedBoundingBox.create_from_points(
        o3d.utility.Vector3dVector(four.astype(np.float64)), robust=True
    )
    return Box(np.asarray(box.center), np.asarray(box.extent), np.asarray(box.R))
