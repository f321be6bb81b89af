"""The parameters of maps that keep a signed distance: those of any, and those of our own voxel blocks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from framework.config.validation import check_bounds
from framework.mapping.voxels.integration_parameters import BOUNDS, Sensor
from framework.mapping.voxels.tsdf_volume import TsdfVolume
from framework.mapping.voxels.voxel_grid import MOST_BLOCKS


@dataclass
class Tsdf:
    """A signed distance, truncated; its voxels near the measured surface are labelled."""

    voxel_size: float = 0.01  # m, > 0
    truncation: float = 4.0  # voxels, >= 1: the width of the band at depth 0
    min_depth: float = 0.2  # m, > 0
    max_depth: float = 5.0  # m, > min_depth: beyond it a structured-light sensor is off by voxels
    label_band: float = 2.0  # voxels, >= 1: labels go to voxels within this distance of the measured surface

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
    """A signed distance in our own voxel blocks."""

    tsdf: Tsdf = field(default_factory=Tsdf)
    truncation_slope: float = 0.01  # m more for each m of depth, >= 0: noise grows with depth (VoxelHashing's value)
    max_weight: float = 200.0  # observations, 1 to 255: how slowly an old surface gives way
    full_weight_depth: float = 1.5  # m, > 0: farther readings weigh (full_weight_depth / depth)^2
    max_blocks: int = 400_000  # blocks of 8^3 voxels, > 0: 1.7 GB, about 1000 m^2 of surface at 1 cm

    def __post_init__(self) -> None:
        check_bounds(
            self,
            truncation_slope=BOUNDS["truncation_slope"],
            max_weight=BOUNDS["max_weight"],
            full_weight_depth=BOUNDS["full_weight_depth"],
            max_blocks=(1, MOST_BLOCKS),
        )

    def new_volume(self) -> TsdfVolume:
        """An empty one, to make a map with."""
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
        """m from the measured surface within which voxels are labelled."""
        return self.tsdf.label_band * self.tsdf.voxel_size
