"""Checks of the camera's principal point and of the orientation tags of color images."""

from __future__ import annotations

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
from framework.files.image_files import UPRIGHT, exif_orientation, mogrify, rotation_command
from framework.interfaces import RGBDSequence
from framework.tracking.color_delay import MAX_GRADIENT

MAX_OFFSET = 0.2  # fraction of the image size, maximum distance of the principal point from the image center
FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 1.0, 3 / 2, 2.0, 2.25, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Usual ratios of two resolutions of a camera."""
MAX_FACTOR_ERROR = 0.1  # maximum relative difference from a usual ratio; cameras have principal points within 8 %
SUBJECT = "camera"
TURNS = {2: "a mirror image", 3: "a rotation by 180 degrees", 4: "a vertical mirror image", 5: "a transposition"}
TURNS |= {6: "a rotation by 90 degrees", 7: "a transposition", 8: "a rotation by 270 degrees"}
MIN_EDGE_RATIO = 1.2  # minimum ratio of the edge agreement after and before the rotation
# minimum edge agreement with another orientation, and minimum ratio to the agreement of the stored images, for images
# without EXIF orientation; real recordings have 1.9 to 5.1 as stored, and at most 1.4 with another orientation
MIN_AGREEMENT, MIN_UNTAGGED_RATIO = 1.5, 1.4
COMMANDS = {2: "-flop", 3: "-rotate 180", 4: "-flip"}  # options of mogrify


def check_principal_point(camera: Camera) -> Finding | None:
    """Return an error if the principal point is far from the image center, or None."""
    x, y = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height  # 0.5 = center
    if max(abs(x - 0.5), abs(y - 0.5)) <= MAX_OFFSET:
        return None
    where = f"cx {camera.cx:.4g} px and cy {camera.cy:.4g} px"
    expected = f"expected a principal point near the center of {camera.width}x{camera.height} px, got {where}"
    both = _nearest_factor(x, y)
    factors = (both, both) if both else (_nearest_factor(x) or round(2 * x, 2), _nearest_factor(y) or round(2 * y, 2))
    size = f"{factors[0] * camera.width:.0f}x{factors[1] * camera.height:.0f} px"
    if factors[0] == factors[1]:
        fix = f"multiply fx, fy, cx, cy by {1 / factors[0]:.4g}"
    else:
        fix = f"multiply fx, cx by {1 / factors[0]:.4g} and fy, cy by {1 / factors[1]:.4g}"
    text = f"{expected}; these intrinsics are of images of {size}: {fix} in the camera's file"
    return Finding(Verdict.ERROR, SUBJECT, text)


def _nearest_factor(*centers: float) -> float | None:
    """Return the usual ratio of resolutions that explains all relative principal points, or None."""
    factor = min(FACTORS, key=lambda one: max(abs(2 * center / one - 1) for center in centers))
    return factor if all(abs(2 * center / factor - 1) <= MAX_FACTOR_ERROR for center in centers) else None


def check_orientation(sequence: RGBDSequence, chosen: Sequence[int]) -> Finding | None:
    """Return the result for color images with another orientation than depth, or None.

    The orientation is that of the EXIF data. Images without one are compared in each orientation of the same size.
    Images are an error if their edges match the depth edges only after the rotation.

    Args:
        sequence: The sequence.
        chosen: Indices of the checked frames in the sequence.
    """
    if not isinstance(sequence, Recording):
        return None
    names = [sequence.contents.frames[sequence.chosen[k]].images.color_name for k in chosen]
    tags = Counter(exif_orientation(name) if isinstance(name, Path) else UPRIGHT for name in names)
    tags = Counter({tag: count for tag, count in tags.items() if tag in TURNS})
    frames = list(_readable(sequence, chosen))
    if not tags:
        return _check_untagged(frames, names[0])
    [(tag, count)] = tags.most_common(1)
    text = f"{count} of {len(names)} color images have the EXIF orientation {tag} ({TURNS[tag]}), which is not applied"
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


def _check_untagged(frames: Sequence[Frame], name: Path | str) -> Finding | None:
    """Return an error if color images match depth only in another orientation, or None."""
    if not frames:
        return None
    means = {tag: float(np.mean([_agreement(frame, tag) for frame in frames])) for tag in (UPRIGHT, *COMMANDS)}
    best = max(means, key=lambda tag: means[tag])
    if means[best] < max(MIN_AGREEMENT, MIN_UNTAGGED_RATIO * means[UPRIGHT]) or best == UPRIGHT:
        return None
    text = f"color images match the depth images only after {TURNS[best]}"
    if isinstance(name, Path):
        text += f": correct one of them, for example with {mogrify(COMMANDS[best], name)}"
    return Finding(Verdict.ERROR, "color", text)


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
