"""What the fusers of our own voxel map share: integration, and labels as evidence. They differ in the label rule."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from framework.data import Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.mapping.association import PixelLists
from framework.mapping.evidence import MOST_GAIN, MOST_UNITS, Combine, Measurement, Storage, named_classes
from framework.mapping.instance_fuser import InstanceFuser
from framework.mapping.instance_map import InstanceMap
from framework.mapping.integration import Integrator
from framework.mapping.sensor import Sensor
from framework.parameters import check_bounds

EXACT_BITS = 16  # by which exact storage's units are finer


def only_best(clusters: PointClusters, weights: npt.NDArray[np.floating]) -> Float64:
    """(N, C) the weight (N,) of each cluster at its most likely class, 0 elsewhere."""
    votes = np.zeros(clusters.class_probabilities.shape)
    if len(clusters):
        votes[np.arange(len(clusters)), clusters.class_probabilities.argmax(axis=1)] = weights
    return votes


@dataclass
class EvidenceFuser(InstanceFuser):
    """A TSDF whose voxels carry evidence for instances and classes. A subclass says what counts as evidence."""

    truncation_slope: float = 0.01  # m more for each m of depth, >= 0: noise grows with depth (VoxelHashing's value)
    max_weight: float = 200.0  # observations, 1 to 255: how slowly an old surface gives way
    full_weight_depth: float = 1.5  # m, > 0: farther readings weigh (full_weight_depth / depth)^2
    max_blocks: int = 400_000  # blocks of 8^3 voxels, > 0: 1.7 GB, about 1000 m^2 of surface at 1 cm
    storage: Storage = Storage.COMPACT  # COMPACT: the best few labels a voxel; EXACT: all of them, for comparison

    combine = Combine.SUM  # how new evidence for a label meets the old one
    logarithmic = True  # whether evidence is the logarithm of what it says, or proportional to it
    units = 64  # that class evidence of 1 has in compact storage

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(
            self,
            truncation_slope=(0.0, 1.0),
            max_weight=(1.0, 255.0),
            full_weight_depth=(1e-3, 1000.0),
            max_blocks=(1, 2**31 // 512),
        )
        sensor = Sensor(
            truncation=np.float32(self.truncation * self.voxel_size),
            truncation_slope=np.float32(self.truncation_slope),
            min_depth=np.float32(self.min_depth),
            max_depth=np.float32(self.max_depth),
            max_weight=np.float32(self.max_weight),
            full_weight_depth=np.float32(self.full_weight_depth),
        )
        self.scene: InstanceMap = InstanceMap(
            self.voxel_size,
            sensor,
            self.max_blocks,
            self.confirmation,
            self.combine,
            self.logarithmic,
            self.storage,
        )
        self._integrator = Integrator(self.scene.voxels, sensor)

    @abstractmethod
    def instance_evidence(self, clusters: PointClusters) -> Float32:
        """(N,) what each cluster says for the instance that it is matched with, over any other."""

    def absence_evidence(self) -> float:
        """Not above 0: for a matched instance, where it is not seen."""
        return 0.0

    def integrate(
        self, frame: Frame, pose: Pose, clusters: PointClusters, points: PixelLists, instance_ids: Int32
    ) -> None:
        seen = self._integrator.integrate(frame, pose.T_world_camera, self.label_band * self.voxel_size)
        self.scene.labels.update(seen, self._measurement(clusters, points, instance_ids))
        self.scene.changed(seen.blocks)

    def _measurement(self, clusters: PointClusters, points: PixelLists, instance_ids: Int32) -> Measurement:
        """What the clusters say, as the voxels take it."""
        matched = np.zeros(self.scene.table.last_id + 1, np.bool_)
        matched[instance_ids] = True
        class_gain, named, bits = named_classes(self.class_evidence(clusters), self.logarithmic)
        compact = self.storage is Storage.COMPACT
        units = self.units if compact else self.units << EXACT_BITS
        if compact and self.combine is Combine.SUM:
            class_gain = np.clip(class_gain, -MOST_GAIN / units, MOST_GAIN / units)
        return Measurement(
            first_point=points.first,
            next_point=points.next,
            cluster=clusters.cluster,
            instance_id=instance_ids,
            instance_gain=self.instance_evidence(clusters),
            absence=np.float32(self.absence_evidence()),
            matched=matched,
            class_gain=np.rint(class_gain * units).astype(np.int64),
            named_classes=named,
            named_bit=bits,
            combine=int(self.combine),
            most_units=MOST_UNITS if compact else 1 << 62,
        )
