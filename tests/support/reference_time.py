"""Processor time of a computation of constant cost, for comparisons on a busy machine."""

from __future__ import annotations

import time

from framework.api import Mapper
from framework.data import Frame


class Reference:
    """A computation of constant cost: rendering a map of one frame.

    Other programs on the machine slow it down as they slow down mapping.
    """

    def __init__(self, frame: Frame) -> None:
        self._mapper = Mapper("detector=none")
        self._camera, self._T_world_camera = frame.camera, self._mapper.add(frame).T_world_camera

    def milliseconds(self) -> float:
        """Run the computation and return its processor time, ms."""
        began = time.process_time()
        self._mapper.scene.render(self._camera, self._T_world_camera)
        return 1e3 * (time.process_time() - began)
