"""Frames of the desk video for round trips through file formats, and the comparison of what was read with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from framework.api import open_dataset
from framework.data import Frame
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from tests.support.recordings.phone_exports import PhoneFrame, seen_by_phone


@cache
def desk_frames(count: int = 3) -> tuple[PhoneFrame, ...]:
    """Return every tenth frame of the desk video, at the resolution of its depth."""
    frames = list(open_dataset("desk", stop=10 * count, stride=10))
    return tuple(seen_by_phone(frames, frames[0].depth.shape))


def half_size(frames: Sequence[PhoneFrame]) -> tuple[PhoneFrame, ...]:
    """Return the frames with depth of half the resolution of color."""
    return tuple(
        replace(frame, depth_mm=frame.depth_mm[::2, ::2], confidence=frame.confidence[::2, ::2]) for frame in frames
    )


def imported(source, folder) -> list[str]:
    """Import a recording into a folder and return the errors of its frames."""
    return write_folder(open_source(source), folder, Writing(confidence=0)).errors


def check_round_trip(
    written: Sequence[PhoneFrame],
    read: Iterable[Frame],
    *,
    time_tolerance: float = 1e-6,
    pose_tolerance: float = 1e-6,
    depth_tolerance: float = 6e-4,
    same_camera: bool = True,
) -> None:
    """Compare timestamps, s, poses, m and unitless, depth, m, cameras and color of the frames that were read."""
    seen = list(read)
    assert len(seen) == len(written)
    for old, new in zip(written, seen, strict=True):
        assert abs((new.timestamp - seen[0].timestamp) - (old.timestamp - written[0].timestamp)) <= time_tolerance
        np.testing.assert_allclose(new.T_world_camera, old.T_world_camera, atol=pose_tolerance)
        if same_camera:
            np.testing.assert_allclose(new.camera.K, old.camera.K, rtol=1e-5)
        np.testing.assert_allclose(new.depth, old.depth_mm / np.float32(1000), atol=depth_tolerance)
        assert np.abs(new.color.astype(int) - old.color).mean() < 3
