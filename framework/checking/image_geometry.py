"""Checks of the camera's intrinsics and of the orientation of color images."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.registration import color_gradient, depth_edges
from framework.checking.rigid_residual import along_z, residuals_of
from framework.data import Camera, Float64, Frame
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import FrameError
from framework.files.image_files import UPRIGHT, exif_orientation, mogrify, rotation_command
from framework.interfaces import RGBDSequence
from framework.tracking.color_delay import MAX_GRADIENT

# fractions of the image size, maximum distance of the principal point from the image center without and with a
# confirmation by frame pairs
MAX_OFFSET, MIN_OFFSET = 0.2, 0.1
# maximum ratios of the residuals with corrected and with stored intrinsics; valid recordings have at least 0.98 for the
# principal point and 1.1 for the focal length
MAX_CENTER_RATIO, MAX_FOCAL_RATIO = 0.9, 0.85
MAX_SWAPPED_OFFSET = 0.06  # fraction of the image size, maximum distance of cy, cx from the center if they are swapped
FACTORS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 4 / 5, 1.0, 5 / 4, 3 / 2, 8 / 5, 2.0, 2.25, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Usual ratios of two resolutions of a camera."""
SIZES = ((1280, 720), (1920, 1080), (848, 480), (640, 360), (960, 540), (512, 424), (256, 192), (640, 480), (1296, 968))
"""Usual image sizes of sensors, px."""
MAX_ASPECT = 1.1  # maximum ratio of fx and fy of most cameras
ALIKE = 1.05  # ratio up to which two residuals count as equal
MAX_FACTOR_ERROR = 0.1  # maximum relative difference from a usual ratio; cameras have principal points within 8%
SUBJECT = "camera"
log = logging.getLogger(__name__)
TURNS = {2: "a mirror image", 3: "a rotation by 180 degrees", 4: "a vertical mirror image", 5: "a transposition"}
TURNS |= {6: "a rotation by 90 degrees", 7: "a transposition", 8: "a rotation by 270 degrees"}
MIN_EDGE_RATIO = 1.2  # minimum ratio of the edge agreement after and before the rotation
# minimum edge agreement with another orientation, and minimum ratio to the agreement of the stored images, for images
# without EXIF orientation; real recordings have 1.9 to 5.1 as stored, and at most 1.4 with another orientation
MIN_AGREEMENT, MIN_UNTAGGED_RATIO = 1.5, 1.4
COMMANDS = {2: "-flop", 3: "-rotate 180", 4: "-flip"}  # options of mogrify


def check_camera(camera: Camera, pairs: Sequence[MatchedPair] = ()) -> Finding | None:
    """Return an error if the intrinsics are those of other images, or None.

    Without enough pairs of frames, only the principal point is checked.

    Args:
        camera: The camera of the images.
        pairs: Pairs of frames.
    """
    offset = max(abs(center - 0.5) for center in _relative_center(camera))
    fixes = [fix for fix in _fixes(camera) if offset > MIN_OFFSET or fix.of_focal_length]
    found = residuals_of(pairs, [along_z, *(fix.points for fix in fixes)])
    where = f"cx {camera.cx:.4g} px and cy {camera.cy:.4g} px"
    expected = f"expected a principal point near the center of {camera.width}x{camera.height} px, got {where}"
    if found is None:
        likely = [fix for fix in fixes if fix.is_swap] or (fixes if offset > MAX_OFFSET else [])
        return Finding(Verdict.ERROR, SUBJECT, f"{expected}; {likely[0]}") if likely else None
    least = ALIKE * found.ratios[1:].min()
    ratio, fix = next(one for one in zip(found.ratios[1:], fixes, strict=True) if one[0] <= least)
    if ratio <= (MAX_FOCAL_RATIO if fix.of_focal_length else MAX_CENTER_RATIO):
        if fix.of_focal_length:
            expected = f"expected the focal length of the images, got fx {camera.fx:.4g} px and fy {camera.fy:.4g} px"
        text = f"{expected}; {fix} (residual of a rigid motion between frames: {ratio:.2f} times as much with this fix)"
        return Finding(Verdict.ERROR, SUBJECT, text)
    if offset > MAX_OFFSET:
        consistent = "frame pairs are consistent with these intrinsics, as for cropped images"
        return Finding(Verdict.NOTE, SUBJECT, f"{expected}; {consistent}")
    return None


def warn_of_camera(camera: Camera) -> None:
    """Log a warning if the principal point of a camera is far from the image center."""
    finding = check_camera(camera)
    if finding is not None:
        log.warning("%s: %s", finding.subject, finding.text)


@dataclass(frozen=True)
class _Fix:
    """A correction of the intrinsics."""

    text: str
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    of_focal_length: bool = False
    is_swap: bool = False  # True if cx and cy are swapped

    def __str__(self) -> str:
        return f"{self.text} in the file of the camera"

    def points(self, camera: Camera, pixels: Float64, values: Float64) -> Float64:
        """Return the points (P, 3) for depth values (P,) at pixels (P, 2) with the corrected camera."""
        return along_z(replace(camera, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy), pixels, values)


def _fixes(camera: Camera) -> list[_Fix]:
    """Return the possible corrections of the intrinsics, the most likely one first."""
    fx, fy, cx, cy, width, height = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
    u, v = (width - 1) / 2, (height - 1) / 2
    fixes = []
    a, b = _size_factors(camera)
    if min(a, b) >= FACTORS[0] and (a, b) != (1.0, 1.0):
        scaling = f"multiply fx, fy, cx, cy by {1 / a:.4g}"
        if a != b:
            scaling = f"multiply fx, cx by {1 / a:.4g} and fy, cy by {1 / b:.4g}"
        text = f"these intrinsics are of images of {a * width:.0f}x{b * height:.0f} px: {scaling}"
        fixes.append(_Fix(text, fx / a, fy / b, cx / a, cy / b))
    if max(abs(cx - v) / height, abs(cy - u) / width) < MAX_SWAPPED_OFFSET:
        fixes.append(_Fix("cx and cy are swapped: exchange them", fx, fy, cy, cx, is_swap=True))
    text = f"subtract the margins of the cropped images, about {cx - u:.0f} px from cx and {cy - v:.0f} px from cy,"
    if cx == cy == 0:
        text = f"set cx and cy to the image center, {u:g} and {v:g} px,"
    fixes.append(_Fix(text, fx, fy, u, v))
    pairs = {f"multiply fx, fy by {factor:g}": (factor * fx, factor * fy) for factor in (0.5, 2.0)}
    if max(fx / fy, fy / fx) > MAX_ASPECT:
        pairs |= {f"set fy to {fx:.4g}": (fx, fx), f"set fx to {fy:.4g}": (fy, fy)}
    return fixes + [_Fix(text, *focal, cx, cy, of_focal_length=True) for text, focal in pairs.items()]


def _size_factors(camera: Camera) -> tuple[float, float]:
    """Return the ratios of width and height of the images with these intrinsics and the stored images."""
    x, y = _relative_center(camera)
    if (both := _nearest_factor(x, y)) is not None:
        return both, both
    for width, height in SIZES:
        a, b = width / camera.width, height / camera.height
        if max(abs(2 * x / a - 1), abs(2 * y / b - 1)) <= MAX_FACTOR_ERROR:
            return a, b
    return _nearest_factor(x) or round(2 * x, 2), _nearest_factor(y) or round(2 * y, 2)


def _relative_center(camera: Camera) -> tuple[float, float]:
    """Return the principal point as fractions of the image size, 0.5 = center."""
    return (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height


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
