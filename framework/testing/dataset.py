"""The contract of a recording."""

from __future__ import annotations

from framework.interfaces import RGBDSequence
from framework.testing.assertions import same


class SequenceContract:
    """What every recording keeps, here of one with poses."""

    stage = "dataset"

    def plugin(self) -> RGBDSequence:
        raise NotImplementedError("the recording that is tested")

    def test_dataset_gives_frames_of_its_camera(self) -> None:
        sequence = self.plugin()
        assert sequence.name
        assert len(sequence) > 0
        frame = sequence[0]
        assert frame.T_world_camera is not None, "the tests' recordings have poses"
        assert frame.camera == sequence.camera
        assert (frame.depth > 0).any()
        assert same(frame, sequence[0])

    def test_dataset_is_in_order(self) -> None:
        sequence = self.plugin()
        first, last = sequence[0], sequence[len(sequence) - 1]
        assert len(sequence) == 1 or (last.index > first.index and last.timestamp > first.timestamp)
