"""Submaps of a map.

A submap consists of the blocks that were last observed in one part of the trajectory. The submaps around the camera are
visible: their blocks are in the volume of the map. All others are hidden. They are stored in compact form, so that the
memory of the volume depends on the part in view. Submaps move rigidly, as in voxgraph (Reijgwart et al., 2020).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from framework.data import Float64, Int32
from framework.mapping.instances.instance_table import InstanceTable
from framework.mapping.labels.evidence_rows import EvidenceRows
from framework.mapping.submaps.fusion import fuse, shared_instances
from framework.mapping.submaps.hidden_submap import HiddenSubmap
from framework.mapping.submaps.hidden_surfaces import HiddenSurfaces
from framework.mapping.submaps.layer import Layer
from framework.mapping.submaps.resampling import resampled
from framework.mapping.voxels.tsdf_volume import TsdfVolume
from framework.mapping.voxels.voxel_grid import grown
from framework.mapping.voxels.voxel_grid_kernels import BLOCK_VOXELS, OUTDATED


class Submaps:
    """The submaps of a map.

    Changes apply to the volume and the labels of the map. The caller merges the instances.
    """

    def __init__(self, volume: TsdfVolume, labels: EvidenceRows, table: InstanceTable) -> None:
        self.volume = volume
        self.visible = Layer(volume.voxels, labels)
        self.table = table
        self.current = 0  # submap of the next frame
        self.hidden: dict[int, HiddenSubmap] = {}
        self._numbers = np.zeros(0, np.int32)  # (B,) submap of each block of the volume
        self._merged: dict[int, int] = {}  # remaining instance by instance merged while submaps were hidden
        self._surfaces: HiddenSurfaces | None = None  # of the hidden submaps, when they were last used

    @property
    def byte_count(self) -> int:
        """Size of the hidden submaps, bytes."""
        return sum(one.byte_count for one in self.hidden.values())

    @property
    def voxel_count(self) -> int:
        """Number of voxels of the hidden submaps."""
        return BLOCK_VOXELS * sum(len(one.block_coords) for one in self.hidden.values())

    def observe(self, blocks: Int32) -> None:
        """Add the blocks (A,) of a frame to the current submap."""
        if self.current or len(self._numbers):  # otherwise, all blocks belong to submap 0
            self._grow()
            self._numbers[blocks] = self.current

    def merged(self, kept: int, dropped: int) -> None:
        """Record that instance `dropped` was merged into `kept`, for the evidence in hidden submaps."""
        if self.hidden:
            self._merged[dropped] = kept

    def renew_colors(self) -> None:
        """Mark all colors of hidden submaps, so that the next observation of each voxel replaces its color."""
        for number, hidden in self.hidden.items():
            voxels = hidden.voxels._replace(color=hidden.voxels.color | OUTDATED)
            self.hidden[number] = hidden._replace(voxels=voxels)

    def move(self, motions: Mapping[int, Float64]) -> None:
        """Move submaps by T_new_old (4, 4), by number.

        Raises:
            MapFullError: If the volume needs too many blocks. A part of the moved submaps is then lost.
        """
        for number in sorted(motions.keys() & self.hidden.keys()):
            self.hidden[number] = self.hidden[number].moved(motions[number])
        moved = {number: self._blocks_of(number) for number in sorted(motions)}
        parts = {number: self.visible.part(blocks) for number, blocks in moved.items() if len(blocks)}
        if parts:
            self._remove(np.concatenate([moved[number] for number in parts]))
            for number, part in parts.items():
                self._add(number, resampled(part, motions[number]))

    def show(self, number: int, min_overlap: float, min_voxels: int) -> list[tuple[int, int]]:
        """Make a hidden submap visible, and return the pairs of instances that are the same object.

        The arguments are explained at `shared_instances`.

        Raises:
            MapFullError: If the volume needs too many blocks. The submap stays hidden.
        """
        if number not in self.hidden:
            return []
        pairs = self.add(number, self._opened(number), min_overlap, min_voxels)
        del self.hidden[number]
        return pairs

    def add(self, number: int, layer: Layer, min_overlap: float, min_voxels: int) -> list[tuple[int, int]]:
        """Add a layer to a visible submap, and return the pairs of instances that are the same object.

        The arguments are explained at `shared_instances`.

        Raises:
            MapFullError: If the volume needs too many blocks.
        """
        pairs = shared_instances(self.visible, layer, min_overlap, min_voxels)
        self._add(number, layer)
        return pairs

    def hide(self, numbers: Collection[int]) -> None:
        """Hide submaps."""
        blocks = {number: self._blocks_of(number) for number in sorted(numbers)}
        for number, own in blocks.items():
            if len(own):
                part = self.visible.part(own)
                if number in self.hidden:
                    fuse(part, self._opened(number), self._max_weight)
                self.hidden[number] = HiddenSubmap.of(part)
        if any(map(len, blocks.values())):
            self._remove(np.concatenate([*blocks.values()]))

    def surfaces(self) -> HiddenSurfaces:
        """Return the surfaces of the hidden submaps.

        See `SceneMap.hidden_surfaces`.
        """
        if self._surfaces is None or not self._surfaces.are_of(self.hidden):
            self._surfaces = HiddenSurfaces(self.hidden, self.visible.voxels, self.volume.sensor, self._surfaces)
        return self._surfaces

    def fuse_into(self, layer: Layer) -> None:
        """Add all submaps to an empty layer."""
        fuse(layer, self.visible, self._max_weight)
        for number in self.hidden:
            fuse(layer, self._opened(number), self._max_weight)

    @property
    def _max_weight(self) -> float:
        return float(self.volume.sensor.max_weight)

    def _opened(self, number: int) -> Layer:
        """Return a hidden submap, with the instances that were merged or removed since it was hidden."""
        hidden = self.hidden[number]
        layer = hidden.layer(self.visible)
        instance_ids = hidden.instance_ids()
        for k in instance_ids:
            if (kept := remaining(k, self._merged)) != k:
                layer.labels.merge_instances(kept, k)
        removed = sorted({remaining(k, self._merged) for k in instance_ids} - self.table.records.keys())
        if removed:
            layer.labels.remove_instances(removed)
        return layer

    def _add(self, number: int, layer: Layer) -> None:
        """Add a layer to the visible layer. Its new blocks belong to the given submap."""
        before = self.visible.voxels.block_count
        fuse(self.visible, layer, self._max_weight)
        self._grow()
        self._numbers[before : self.visible.voxels.block_count] = number
        self.volume.changed()

    def _remove(self, blocks: Int32) -> None:
        """Remove blocks from the visible layer."""
        kept = np.ones(self.visible.voxels.block_count, np.bool_)
        kept[blocks] = False
        rest = np.flatnonzero(kept).astype(np.int32)
        self._grow()
        numbers = self._numbers[rest]
        self.visible.keep(rest)
        self._numbers[:] = 0
        self._numbers[: len(rest)] = numbers
        self.volume.renumbered()

    def _blocks_of(self, number: int) -> Int32:
        """Return the visible blocks of a submap."""
        self._grow()
        return np.flatnonzero(self._numbers[: self.visible.voxels.block_count] == number).astype(np.int32)

    def _grow(self) -> None:
        capacity = len(self.volume.voxels.grid.block_coords)
        if len(self._numbers) < capacity:
            self._numbers = grown(self._numbers, capacity, zeros=True)


def remaining(instance_id: int, merged: Mapping[int, int]) -> int:
    """Return the instance into which an instance was merged, or its own id.

    Args:
        instance_id: The instance.
        merged: The instance into which each merged instance was merged, which may be merged, too.
    """
    while instance_id in merged:
        instance_id = merged[instance_id]
    return instance_id
