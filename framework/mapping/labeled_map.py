"""What a fuser needs of a map to keep instances in it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

from framework.data import Float64, Frame, Instance, Int32
from framework.interfaces import SceneMap
from framework.mapping.instance_list import Confirmation, list_instances
from framework.mapping.instance_table import InstanceTable


class LabeledMap(SceneMap):
    """A map whose voxels know the instance that they belong to, and a table of these instances.

    `mesh` and `instances` have the instances that count; `render` and `instances_seen` the tentative ones too.
    """

    def __init__(self, table: InstanceTable, confirmation: Confirmation) -> None:
        self.classes: tuple[str, ...] = ()
        self.table = table
        self.confirmation = confirmation

    def begin(self, classes: tuple[str, ...]) -> None:
        """Takes the first frame's label space for the map's."""
        self.classes = classes

    @abstractmethod
    def instances_seen(self, frame: Frame, T_world_camera: Float64, stride: int) -> Int32:
        """(ceil(H / stride), ceil(W / stride)) the instance that the map has at the measured surface, 0 = none.

        Looked up at every stride-th reading of every stride-th row of `frame.depth`. Unlike a ray-cast, this cannot see
        an instance behind an object that is new.
        """

    @abstractmethod
    def merge(self, kept: int, dropped: int) -> None:
        """Makes instance `dropped` a part of `kept`, in the table and in every voxel."""

    @property
    def instance_count(self) -> int:
        """Without the condition on their area, which takes a mesh."""
        return int(self.confirmation.counts(self.table).sum())

    def instances(self) -> Mapping[int, Instance]:
        return list_instances(self.mesh(), self.table)
