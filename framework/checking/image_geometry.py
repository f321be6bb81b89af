"""Checks of the camera's principal point and of the orientation tags of color images."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.registration import color_gradient, depth_edges
from framework.data import Camera, Frame
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import FrameError
from framework.files.image_files import UPRIGHT, exif_orientation, rotation_command
from framework.interfaces import RGBDSequence
from framework.tracking.color_delay import MAX_GRADIENT

MAX_OFFSET = 0.2  # fraction of the image size, maximum distance of the principal point from the image center
MAX_SWAPPED_OFFSET = 0.04  # fraction of the image size, the same for exchanged cx and cy
FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 1.0, 3 / 2, 2.0, 2.25, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Usual ratios of two resolutions of a camera."""
MAX_FACTOR_ERROR = 0.1  # maximum relative difference from a usual ratio; cameras have principal points within 8 %
SUBJECT = "camera"
log = logging.getLogger(__name__)
TURNS = {2: "a mirror image", 3: "a rotation by 180 degrees", 4: "a vertical mirror image", 5: "a transposition"}
TURNS |= {6: "a rotation by 90 degrees", 7: "a transposition", 8: "a rotation by 270 degrees"}
MIN_EDGE_RATIO = 1.2  # minimum ratio of the edge agreement after and before the rotation


def check_principal_point(camera: Camera) -> Finding | None:
    """Return an error if the principal point is far from the image center, or None."""
    x, y = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height  # 0.5 = center
    where = f"cx {camera.cx:.4g} px and cy {camera.cy:.4g} px"
    expected = f"expected a principal point near the center of {camera.width}x{camera.height} px, got {where}"
    swapped = (camera.cy + 0.5) / camera.width, (camera.cx + 0.5) / camera.height
    if _is_near_center(*swapped, MAX_SWAPPED_OFFSET) and not _is_near_center(x, y, 2 * MAX_SWAPPED_OFFSET):
        fix = "exchange cx and cy; also exchange fx and fy if these intrinsics are of images rotated by 90 degrees"
        return Finding(Verdict.ERROR, SUBJECT, f"{expected}; cx and cy are exchanged: {fix}")
    if _is_near_center(x, y, MAX_OFFSET):
        return None
    both = _nearest_factor(x, y)
    factors = (both, both) if both else (_nearest_factor(x) or round(2 * x, 2), _nearest_factor(y) or round(2 * y, 2))
    size = f"{factors[0] * camera.width:.0f}x{factors[1] * camera.height:.0f} px"
    if factors[0] == factors[1]:
        fix = f"multiply fx, fy, cx, cy by {1 / factors[0]:.4g}"
    else:
        fix = f"multiply fx, cx by {1 / factors[0]:.4g} and fy, cy by {1 / factors[1]:.4g}"
    return Finding(Verdict.ERROR, SUBJECT, f"{expected}; these intrinsics are of images of {size}: {fix}")


def warn_of_camera(camera: Camera) -> None:
    """Log a warning if the principal point of a camera is far from the image center."""
    finding = check_principal_point(camera)
    if finding is not None:
        log.warning("%s: %s", finding.subject, finding.text)


def _is_near_center(x: float, y: float, distance: float) -> bool:
    """Return True if a relative position is within a distance of the image center along both axes."""
    return max(abs(x - 0.5), abs(y - 0.5)) <= distance


def _nearest_factor(*centers: float) -> float | None:
    """Return the usual ratio of resolutions that explains all relative principal points, or None."""
    factor = min(FACTORS, key=lambda one: max(abs(2 * center / one - 1) for center in centers))
    return factor if all(abs(2 * center / factor - 1) <= MAX_FACTOR_ERROR for center in centers) else None


def check_orientation(sequence: RGBDSequence, chosen: Sequence[int]) -> Finding | None:
    """Return the result for color images with an EXIF orientation, or None without one.

    Tagged images are an error if their edges match the depth edges only after the rotation.

    Args:
        sequence: The sequence.
        chosen: Indices of the checked frames in the sequence.
    """
    if not isinstance(sequence, Recording):
        return None
    names = [sequence.contents.frames[sequence.chosen[k]].images.color_name for k in chosen]
    tags = Counter(exif_orientation(name) if isinstance(name, Path) else UPRIGHT for name in names)
    tags = Counter({tag: count for tag, count in tags.items() if tag in TURNS})
    if not tags:
        return None
    [(tag, count)] = tags.most_common(1)
    text = f"{count} of {len(names)} color images have the EXIF orientation {tag} ({TURNS[tag]}), which is not applied"
    frames = list(_readable(sequence, chosen))
    as_stored, turned = (sum(_agreement(frame, one) for frame in frames) for one in (UPRIGHT, tag))
    if turned <= MIN_EDGE_RATIO * as_stored:
        return Finding(Verdict.NOTE, "color", f"{text}; the stored pixels match the depth images")
    first = next(name for name in names if isinstance(name, Path))
    return Finding(
        Verdict.ERROR,
        "color",
        f"{text}; depth matches the images only after it: rotate the stored pixels, for example with "
        f"{rotation_command(first)}",
    )


def _readable(sequence: RGBDSequence, chosen: Sequence[int]) -> Iterator[Frame]:
    for k in chosen:
        with suppress(FrameError):
            yield sequence[k]


def _agreement(frame: Frame, tag: int) -> float:
    """Return the mean color gradient at depth edges relative to the mean gradient, with an orientation applied."""
    gradient = np.minimum(color_gradient(frame), MAX_GRADIENT)
    if tag in (2, 3):
        gradient = gradient[:, ::-1]
    if tag in (3, 4):
        gradient = gradient[::-1]
    edges = depth_edges(frame.depth)
    if gradient.shape != edges.shape or not edges.any():
        return 0.0
    near = cv2.dilate(edges.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return float(gradient[near].mean() / max(float(gradient.mean()), 1e-6))
