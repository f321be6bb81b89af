"""TSDF volume and its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from framework.config.validation import check_bounds
from framework.data import Array, Camera, Float32, Float64, Frame, InstanceMesh, Int32, SurfaceView
from framework.interfaces import Gravity
from framework.mapping.gravity import GravityEstimator
from framework.mapping.storage.map_file import check_blocks, check_like, check_memory, check_numbers
from framework.mapping.storage.map_header import MapHeader
from framework.mapping.voxels.integration import Integrator, SeenBlocks
from framework.mapping.voxels.integration_parameters import BOUNDS, Sensor
from framework.mapping.voxels.meshing import SurfaceNets, UnlabeledMesh
from framework.mapping.voxels.packed_voxels import PackedVoxels, checked_voxels, pack_voxels, unpack_voxels
from framework.mapping.voxels.raycasting import render_surface
from framework.mapping.voxels.voxel_grid import MAX_BLOCKS, VoxelGrid
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, find_solid_blocks, mark_outdated
from framework.sensors.noise_models import SensorKind

BLOCK_ARRAYS = ("block_coords", "tsdf", "weight", "color", "label_row")  # arrays of the grid
VOLUME_ARRAYS = ("block_coords", "label_row", *PackedVoxels._fields)  # arrays of a map file
BLOCK_BYTES = 8 * BLOCK_VOXELS + 64  # size of a block of the grid, approximately
NO_BLOCKS = np.zeros(0, np.int32)


class TsdfVolume:
    """A TSDF volume: voxels, integration, surface, ray casting and saving."""

    def __init__(self, voxel_size: float, sensor: Sensor, max_blocks: int) -> None:
        self.sensor = sensor
        self.voxels = VoxelGrid(voxel_size, sensor.max_truncation, max_blocks)
        self.integrator = Integrator(self.voxels, sensor)
        self.gravity_estimator = GravityEstimator()
        self._nets: SurfaceNets | None = None  # created by the first mesh
        self._mesh: InstanceMesh | None = None
        self._gravity: Gravity | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state without data derived from the voxels."""
        return {**vars(self), "_nets": None, "_mesh": None}

    def like(self, max_blocks: int) -> TsdfVolume:
        """Return an empty volume with the parameters and the gravity direction of this volume."""
        other = TsdfVolume(self.voxel_size, self.sensor, max_blocks)
        other.voxels.grid = other.voxels.grid._replace(
            voxel_size=self.voxels.grid.voxel_size, tsdf_unit=self.voxels.grid.tsdf_unit
        )
        other.integrator.frames = self.integrator.frames
        other.gravity_estimator = self.gravity_estimator
        return other

    @property
    def voxel_size(self) -> float:
        """Side of a voxel, m."""
        return float(self.voxels.grid.voxel_size)

    @property
    def voxel_count(self) -> int:
        return self.voxels.block_count * BLOCK_VOXELS

    def integrate(self, frame: Frame, T_world_camera: Float64, near: float) -> SeenBlocks:
        """Integrate one frame, and return the updated blocks and their voxels near the measured surface.

        Args:
            frame: The frame.
            T_world_camera: The camera pose (4, 4).
            near: The maximum distance of the listed voxels from the measured surface, m.

        Raises:
            MapFullError: If the map needs too many blocks. The frame is then not integrated.
        """
        seen = self.integrator.integrate(frame, T_world_camera, near)
        self.gravity_estimator.add_frame(T_world_camera, frame.up)
        self.changed(seen.blocks)
        return seen

    def renew_colors(self) -> None:
        """Mark all colors, so that the next observation of each voxel replaces its color."""
        mark_outdated(self.voxels.grid.color, self.voxels.block_count)

    def changed(self, blocks: Int32 | None = None) -> None:
        """Invalidate the cached surface after a change to voxels in the given blocks, None = any block."""
        self._mesh = self._gravity = None
        if blocks is None:
            self._nets = None
        elif self._nets is not None:
            self._nets.changed(blocks)

    def renumbered(self) -> None:
        """Discard the data derived from block indices after the blocks were renumbered."""
        self.integrator.renumbered()
        self.changed()

    @property
    def nets(self) -> SurfaceNets:
        """The surface nets of the voxels."""
        self._nets = self._nets or SurfaceNets(self.voxels)
        return self._nets

    def surface(self) -> UnlabeledMesh:
        """Return the current surface without labels."""
        return self.nets.extract()

    def gravity(self) -> Gravity:
        """Return the gravity direction, cached until the volume changes."""
        if self._gravity is None:
            surface = self.surface()
            self._gravity = self.gravity_estimator.estimate(surface.vertices, surface.triangles)
        return self._gravity

    def mesh(self, label: Callable[[UnlabeledMesh], InstanceMesh]) -> InstanceMesh:
        """Return the surface with the labels from `label`, cached until the volume changes."""
        if self._mesh is None:
            self._mesh = label(self.surface())
        return self._mesh

    def render(self, camera: Camera, T_world_camera: Float64) -> SurfaceView:
        return render_surface(self.voxels, self.sensor, camera, T_world_camera)

    def render_near(
        self, camera: Camera, T_world_camera: Float64, depth: Float32, sensor: SensorKind = SensorKind.KINECT_V1
    ) -> SurfaceView:
        return render_surface(self.voxels, self.sensor, camera, T_world_camera, depth, sensor)

    def saved(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """Return the header entries and the arrays for a map file."""
        header = {
            "voxel_size": self.voxel_size,
            "sensor": {name: float(value) for name, value in self.sensor._asdict().items()},
            "max_blocks": self.voxels.max_blocks,
            "frames": self.integrator.frames,
            **self.gravity_estimator.saved(),
        }
        return header, self.arrays() | pack_voxels(self.voxels)._asdict()

    def arrays(self) -> dict[str, Array]:
        """Return the arrays of the grid without unused capacity."""
        return {name: getattr(self.voxels.grid, name)[: self.voxels.block_count] for name in BLOCK_ARRAYS}

    @classmethod
    def load(cls, header: MapHeader, arrays: dict[str, Any], rows: int) -> TsdfVolume:
        """Return the volume in a map file.

        Args:
            header: The header of the file.
            arrays: The arrays of the file.
            rows: The number of evidence rows in the file.

        Raises:
            DataError: If the file is invalid.
        """
        saved = header.part("sensor")
        sensor = Sensor(**{name: np.float32(saved.number(name, BOUNDS[name])) for name in Sensor._fields})
        max_blocks = header.whole("max_blocks", 1, MAX_BLOCKS)
        volume = cls(header.number("voxel_size", BOUNDS["voxel_size"]), sensor, max_blocks)
        volume.integrator.frames = header.whole("frames")  # determines the rounding of the next frame
        volume.gravity_estimator = GravityEstimator.of(header)
        blocks = {name: volume.arrays()[name] for name in ("block_coords", "label_row")}
        check_like(arrays, blocks, len(arrays["block_coords"]))
        check_numbers("label_row", arrays["label_row"], rows)
        packed = checked_voxels(arrays)
        check_memory(BLOCK_BYTES * len(packed.observed))
        volume._allocate(arrays["block_coords"])
        volume.voxels.grid.label_row[: volume.voxels.block_count] = arrays["label_row"]
        unpack_voxels(packed, volume.voxels)
        find_solid_blocks(volume.voxels.grid, volume.voxels.block_count)
        return volume

    def fill(self, arrays: dict[str, Any]) -> None:
        """Copy the arrays of another volume into this empty volume.

        The caller must check their types and shapes.
        """
        self._allocate(arrays["block_coords"])
        b = self.voxels.block_count
        for name in arrays.keys() & set(BLOCK_ARRAYS):
            getattr(self.voxels.grid, name)[:b] = arrays[name]
        find_solid_blocks(self.voxels.grid, b)

    def _allocate(self, coords: Int32) -> None:
        check_blocks(coords)
        self.voxels.allocate(coords)


@dataclass
class Tsdf:
    """Parameters of a TSDF with labels near the measured surface."""

    voxel_size: float = 0.01  # side of a voxel, m, > 0
    truncation: float = 4.0  # truncation distance at depth 0, in voxels, in [1, 100]
    min_depth: float = 0.2  # minimum depth of integrated readings, m, > 0
    max_depth: float = 5.0  # maximum depth of integrated readings, m, > min_depth
    # maximum distance of labeled voxels from the measured surface, in voxels, in [1, truncation]
    label_band: float = 2.0

    def __post_init__(self) -> None:
        check_bounds(
            self,
            voxel_size=BOUNDS["voxel_size"],
            truncation=(1.0, 100.0),
            min_depth=BOUNDS["min_depth"],
            max_depth=(self.min_depth, BOUNDS["max_depth"][1]),
            label_band=(1.0, self.truncation),
        )


@dataclass
class VoxelHashing:
    """Parameters of a TSDF in voxel blocks."""

    tsdf: Tsdf = field(default_factory=Tsdf)
    truncation_slope: float = 0.01  # increase of the truncation distance with depth, m per m, >= 0
    # maximum TSDF weight (number of observations), in [1, 255]; limits the influence of old readings
    max_weight: float = 200.0
    # maximum depth with full weight, m, > 0; farther readings have weight (full_weight_depth / depth)^2
    full_weight_depth: float = 1.5
    # maximum number of blocks of 8^3 voxels, > 0; 4.1 KiB each, plus about 40 KiB for blocks with labels
    max_blocks: int = 400_000

    def __post_init__(self) -> None:
        check_bounds(
            self,
            truncation_slope=BOUNDS["truncation_slope"],
            max_weight=BOUNDS["max_weight"],
            full_weight_depth=BOUNDS["full_weight_depth"],
            max_blocks=(1, MAX_BLOCKS),
        )

    def new_volume(self) -> TsdfVolume:
        """Return an empty volume."""
        tsdf = self.tsdf
        sensor = Sensor(
            truncation=np.float32(tsdf.truncation * tsdf.voxel_size),
            truncation_slope=np.float32(self.truncation_slope),
            min_depth=np.float32(tsdf.min_depth),
            max_depth=np.float32(tsdf.max_depth),
            max_weight=np.float32(self.max_weight),
            full_weight_depth=np.float32(self.full_weight_depth),
        )
        return TsdfVolume(tsdf.voxel_size, sensor, self.max_blocks)

    @property
    def near(self) -> float:
        """Maximum distance of labeled voxels from the measured surface, m."""
        return self.tsdf.label_band * self.tsdf.voxel_size
