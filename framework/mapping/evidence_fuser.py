"""What the fusers of our own voxel map share: integration, and labels as evidence. They differ in the label rule."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from framework.data import Float32, Float64, Frame, Int32, PointClusters, Pose
from framework.mapping.association import PixelLists, keep_on_top
from framework.mapping.evidence import MOST_GAIN, MOST_UNITS, Combine, Measurement, Storage, named_classes
from framework.mapping.instance_fuser import InstanceFuser
from framework.mapping.instance_map import InstanceMap
from framework.mapping.integration import Integrator
from framework.mapping.tsdf_fuser import VoxelHashingFuser
from framework.parameters import check_bounds

EXACT_BITS = 16  # by which exact storage's units are finer


def only_best(clusters: PointClusters, weights: npt.NDArray[np.floating]) -> Float64:
    """(N, C) the weight (N,) of each cluster at its most likely class, 0 elsewhere."""
    votes = np.zeros(clusters.class_probabilities.shape)
    if len(clusters):
        votes[np.arange(len(clusters)), clusters.class_probabilities.argmax(axis=1)] = weights
    return votes


@dataclass
class EvidenceFuser(VoxelHashingFuser, InstanceFuser):
    """A TSDF whose voxels carry evidence for instances and classes. A subclass says what counts as evidence."""

    on_top: float = 0.25  # in [0, 1]: where clusters overlap, one smaller than this share of another takes the pixels
    storage: Storage = Storage.COMPACT  # COMPACT: the best few labels a voxel; EXACT: all of them, for comparison

    combine = Combine.SUM  # how new evidence for a label meets the old one
    logarithmic = True  # whether evidence is the logarithm of what it says, or proportional to it
    units = 64  # that class evidence of 1 has in compact storage

    def __post_init__(self) -> None:
        super().__post_init__()
        check_bounds(self, on_top=(0.0, 1.0))
        sensor = self.sensor
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
        if self.on_top > 0:
            points = keep_on_top(clusters, points, instance_ids, self.on_top)
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
