"""Fit of stored poses to the images, in each supported pose convention."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from framework.checking import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.data import Float64
from framework.datasets.frames.conventions import CameraAxes, Mirror, PoseKind, PoseReading, QuaternionOrder
from framework.geometry import inverse, project, transform

MAX_ERROR = 1.0  # fraction of the image width, limit of the error of a point; also used for points behind the camera
MIN_BASELINE = 0.02  # fraction of the median depth, minimum translation for a scale estimate
MIN_PAIRS = 3  # minimum number of informative pairs
MIN_MOTION = 0.01  # fraction of the image width; pairs with less motion fit any poses
MAX_RELATIVE_ERROR = 0.2  # fraction of the motion, maximum error of valid poses; real recordings have 0.01 to 0.06
ALIKE, ALIKE_PX = 1.15, 0.2  # ratio, and offset in px, up to which two errors count as equal
MAX_OTHER_RATIO = 0.5  # maximum ratio of the error of another convention to the error of the configured convention
# maximum ratio of the error of a mirrored convention to the error of the best other convention
MAX_MIRRORED_RATIO = 0.7
# minimum cosine of the angle between translations in the poses and in the images, median of the pairs, for a scale
# estimate; real recordings have 0.1 to 1.0
MIN_COSINE = 0.0
# minimum uncertainty of the logarithm of the depth factor, due to inaccurate poses and depth in real recordings
MIN_LOG_UNCERTAINTY = 0.07
# maximum ratio of the errors with the estimated and the stored scale, for a clearly wrong scale
MAX_ERROR_INCREASE = 1.3
WRONG_SCALE = 2.5  # minimum factor of a clearly wrong scale; during rotation, the scale is uncertain by up to 1.6
UNIT_FACTORS = (1000.0, 100.0)  # depth factors for poses in mm and cm, which slow rotations do not determine
USUAL_SCALES = (1000.0, 5000.0, 10_000.0, 4000.0, 1.0, 100.0, 2000.0, 256.0, 6553.5)  # per m, common ones first
INCH, FOOT = 0.0254, 0.3048  # m
OTHER_UNIT = 20.0  # minimum factor of translations in another unit than meters, such as centimeters
CERTAIN_FACTOR = 1.1  # maximum ratio of an estimated scale to that of inches or feet
UNPOSED = "tracker=voxel_hashing_icp"  # setting for recordings with unusable poses
PLAUSIBLE = (0.2, 12.0)  # m, plausible median depth of a room


@dataclass(frozen=True)
class PoseFit:
    """Agreement of the poses with the frame pairs in one pose convention."""

    reading: PoseReading
    depth_factor: float  # factor of all depth readings
    errors: Float64  # (P,) px, median error of the points of each pair
    factor_within: float = 1.0  # uncertainty of depth_factor, as a ratio; 1 if the factor is given

    @property
    def error(self) -> float:
        """Median error in px."""
        return float(np.median(self.errors))


def readings(pose_unit: float = 1.0) -> Iterator[PoseReading]:
    """Yield all pose conventions, starting with the default convention.

    Translations are in units of `pose_unit` meters.
    """
    for order, kind, axes in product(QuaternionOrder, PoseKind, CameraAxes):
        yield PoseReading(kind, axes, order, pose_unit)


def mirrored_readings(pose_unit: float = 1.0) -> Iterator[PoseReading]:
    """Yield the pose conventions with a mirrored world and camera."""
    for mirror, kind, axes in product((Mirror.Y, Mirror.Z, Mirror.X), PoseKind, CameraAxes):
        yield PoseReading(kind, axes, mirrored=mirror, pose_unit=pose_unit)


def fit(pairs: Sequence[MatchedPair], reading: PoseReading, depth_factor: float | None = None) -> PoseFit:
    """Return the fit of a pose convention to pairs of frames with poses.

    The depth factor is estimated if it is None.
    """
    motions = [motion_of(pair, reading) for pair in pairs]
    factor, within = (depth_factor, 1.0) if depth_factor else _depth_factor(pairs, motions)
    errors = np.array([error_of(pair, motion, factor) for pair, motion in zip(pairs, motions, strict=True)])
    return PoseFit(reading, factor, errors, within)


def motion_of(pair: MatchedPair, reading: PoseReading) -> Float64:
    """Return the camera motion T_second_first (4, 4) from the stored poses of a pair."""
    T_world_first, T_world_second = pair.first.T_world_camera, pair.second.T_world_camera
    assert T_world_first is not None
    assert T_world_second is not None
    return motion_between(T_world_first, T_world_second, reading)


def motion_between(T_world_first: Float64, T_world_second: Float64, reading: PoseReading) -> Float64:
    """Return the camera motion T_second_first (4, 4) from two stored poses in a pose convention."""
    return inverse(reading.pose(T_world_second)) @ reading.pose(T_world_first)


def _depth_factor(pairs: Sequence[MatchedPair], motions: Sequence[Float64]) -> tuple[float, float]:
    """Return the ratio of translations in the poses to translations in the images, and its uncertainty.

    The uncertainty is also a ratio. Both values are 1 if unknown.
    """
    ratios, cosines = [], []
    for pair, T_second_first in zip(pairs, motions, strict=True):
        t_seen, t_moved = pair.T_second_first[:3, 3], T_second_first[:3, 3]
        seen, moved = np.linalg.norm(t_seen), np.linalg.norm(t_moved)
        if seen > MIN_BASELINE * np.median(pair.points_first[:, 2]) and moved > 0:
            ratios.append(float(np.log(moved / seen)))
            cosines.append(float(t_seen @ t_moved / (seen * moved)))
    if len(ratios) < MIN_PAIRS or np.median(cosines) < MIN_COSINE:
        return 1.0, 1.0
    middle = float(np.median(ratios))
    spread = 1.5 * float(np.median(np.abs(np.array(ratios) - middle)))
    return float(np.exp(middle)), float(np.exp(MIN_LOG_UNCERTAINTY + 3 * spread / np.sqrt(len(ratios))))


def error_of(pair: MatchedPair, T_second_first: Float64, factor: float) -> float:
    """Return the median reprojection error of a pair, px, with all depths multiplied by `factor`."""
    moved = transform(T_second_first, pair.points_first.astype(np.float64) * factor)
    farthest = MAX_ERROR * pair.second.camera.width
    with np.errstate(all="ignore"):
        distance = np.linalg.norm(project(pair.second.camera, moved) - pair.pixels_second, axis=1)
    return float(np.median(np.where((moved[:, 2] > 0) & (distance < farthest), distance, farthest)))


@dataclass(frozen=True)
class PoseJudgment:
    """Results of the checks of poses and units."""

    findings: tuple[Finding, ...]
    given: PoseFit | None  # fit of the configured convention; None = too few informative pairs
    best: PoseFit | None  # fit of the best convention; None = too few informative pairs
    others: tuple[PoseFit, ...] = ()  # fits of all conventions, with depth as stored


def judge(pairs: Sequence[MatchedPair], given: PoseReading, depth_scale: float, median_depth: float) -> PoseJudgment:
    """Check the stored poses, and find the pose convention that fits the images best.

    Args:
        pairs: Pairs of frames.
        given: Configured convention.
        depth_scale: Configured depth scale, units per meter.
        median_depth: Median depth of the recording, m.
    """
    informative = [pair for pair in pairs if pair.motion > MIN_MOTION * pair.first.camera.width]
    if len(informative) < MIN_PAIRS:
        text = f"expected at least {MIN_PAIRS} pairs of frames with motion to check the poses, got {len(informative)}"
        return PoseJudgment((Finding(Verdict.UNKNOWN, "poses", text),), None, None)
    motion = float(np.median([pair.motion for pair in informative]))
    as_given = fit(informative, given, 1.0)
    others = tuple(fit(informative, reading, 1.0) for reading in readings(given.pose_unit))
    scaled = [fit(informative, reading) for reading in (given, *readings(given.pose_unit))]
    factors = _usual_factors(depth_scale, median_depth)
    if min(one.error for one in (*others, *scaled)) > MAX_RELATIVE_ERROR * motion:
        scaled += [fit(informative, given, factor) for factor in factors]
    alike = _equal_to_best((as_given, *others, *scaled))
    best = min(alike, key=lambda one: (len(_settings(one.reading, given)), one.error))
    now = as_given.error
    reading = best.reading if now > MAX_RELATIVE_ERROR * motion and best.error < MAX_OTHER_RATIO * now else given
    chosen = _with_plain_factor(informative, reading, factors, MAX_RELATIVE_ERROR * motion)
    measured = f"median error of {now:.1f} px in {len(informative)} pairs of frames with a motion of {motion:.0f} px"
    if reading == given and now <= MAX_RELATIVE_ERROR * motion and chosen.depth_factor == 1.0:
        return PoseJudgment((Finding(Verdict.FINE, "poses", f"valid: {measured}"),), as_given, as_given, others)
    mirrored = _mirrored_fit(informative, given)
    angle, turned = _rotated_images(informative, given)
    if turned < min(MAX_MIRRORED_RATIO * min(chosen.error, mirrored.error), MAX_RELATIVE_ERROR * motion):
        text = (
            f"images are rotated by {angle} degrees relative to the poses: {measured}, and {turned:.1f} px without the "
            f"rotation; rotate color and depth by {360 - angle} degrees clockwise to use the poses"
        )
        return PoseJudgment((Finding(Verdict.ERROR, "poses", text, UNPOSED),), as_given, best, others)
    # a mirrored rotation is a rotation with other axes, so translations decide
    if mirrored.error < min(MAX_MIRRORED_RATIO * chosen.error, MAX_RELATIVE_ERROR * motion):
        text = (
            f"mirrored (a left-handed world, or mirrored images): {measured}, and {mirrored.error:.1f} px without the "
            "mirroring"
        )
        findings = [Finding(Verdict.ERROR, "poses", text, " ".join(_settings(mirrored.reading, given)))]
        if mirrored.depth_factor != 1.0:
            findings.append(_scale_finding(mirrored, depth_scale, median_depth))
        return PoseJudgment(tuple(findings), as_given, mirrored, others)
    if chosen.error > MAX_RELATIVE_ERROR * motion:
        text = f"inconsistent with the images in all supported conventions: {measured}"
        finding = Finding(Verdict.ERROR, "poses", text, UNPOSED)
        return PoseJudgment((finding,), as_given, best, others)
    findings = []
    if reading != given:
        text = f"stored as {_named(reading)}: {measured}, and {chosen.error:.1f} px in this convention"
        settings = {_settings(one.reading, given) for one in alike if one.reading not in (reading, given)}
        if settings:
            text += f"; {' or '.join(sorted(map(' '.join, settings)))} fits this camera motion equally well"
        findings.append(Finding(Verdict.ERROR, "poses", text, " ".join(_settings(reading, given))))
    else:
        text = f"valid with the correct scale: {measured}, and {chosen.error:.1f} px with the correct scale"
        findings.append(Finding(Verdict.FINE, "poses", text))
    if chosen.depth_factor != 1.0:
        findings.append(_scale_finding(chosen, depth_scale, median_depth))
    return PoseJudgment(tuple(findings), as_given, chosen, others)


def _mirrored_fit(pairs: Sequence[MatchedPair], given: PoseReading) -> PoseFit:
    """Return the best fit of a mirrored convention."""
    fits = []
    for reading in mirrored_readings(given.pose_unit):
        as_stored, scaled = fit(pairs, reading, 1.0), fit(pairs, reading)
        is_other_unit = not 1 / OTHER_UNIT < scaled.depth_factor < OTHER_UNIT
        fits.append(scaled if is_other_unit and scaled.error < as_stored.error else as_stored)
    return min(_equal_to_best(fits), key=lambda one: (len(_settings(one.reading, given)), one.error))


def _rotated_images(pairs: Sequence[MatchedPair], given: PoseReading) -> tuple[int, float]:
    """Return the clockwise rotation of the images that fits the poses best, degrees, and its median error, px."""
    errors: dict[int, float] = {}
    for angle, kind, axes in product((90, 180, 270), PoseKind, CameraAxes):
        R = np.eye(4)
        R[:3, :3] = Rotation.from_euler("z", angle, degrees=True).as_matrix()
        reading = PoseReading(kind, axes, given.quaternion_order, given.pose_unit)
        rotated = [error_of(pair, R @ motion_of(pair, reading) @ R.T, 1.0) for pair in pairs]
        errors[angle] = min(float(np.median(rotated)), errors.get(angle, np.inf))
    best = min(errors, key=lambda angle: errors[angle])
    return best, errors[best]


def _with_plain_factor(
    pairs: Sequence[MatchedPair], reading: PoseReading, factors: Sequence[float], limit: float
) -> PoseFit:
    """Return the fit with the stored depth scale.

    If an estimated scale has a clearly smaller error, return the fit with the estimated scale. If its error is above
    `limit`, px, the usual depth factors are tried, too.
    """
    as_stored, scaled = fit(pairs, reading, 1.0), fit(pairs, reading)
    if scaled.error > limit:
        scaled = min((scaled, *(fit(pairs, reading, factor) for factor in factors)), key=lambda one: one.error)
    far = not 1 / WRONG_SCALE < scaled.depth_factor < WRONG_SCALE
    needed = MAX_ERROR_INCREASE if far else MAX_OTHER_RATIO
    return scaled if scaled.error < needed * as_stored.error else as_stored


def _usual_factors(depth_scale: float, median_depth: float) -> list[float]:
    """Return the depth factors for poses in mm or cm, and for usual depth scales with a plausible depth.

    They are more certain than an estimated factor if the camera mainly rotates.
    """
    low, high = PLAUSIBLE
    factors = [depth_scale / usual for usual in USUAL_SCALES if usual != depth_scale]
    plausible = [factor for factor in factors if low <= median_depth * factor <= high]
    return [*plausible, *(UNIT_FACTORS if low <= median_depth <= high else ())]


def _scale_finding(chosen: PoseFit, depth_scale: float, median_depth: float) -> Finding:
    low, high = PLAUSIBLE
    factor = chosen.depth_factor
    if low <= median_depth <= high and not low <= median_depth * factor <= high:
        text = f"translations are {factor:.3g} times as long as in the images at a median depth of {median_depth:.2f} m"
        is_inch = abs(np.log(INCH * factor)) < np.log(min(chosen.factor_within, CERTAIN_FACTOR))
        unit = INCH if is_inch else 10.0 ** round(np.log10(1 / factor))
        return Finding(Verdict.ERROR, "poses", text, f"dataset.pose_unit={chosen.reading.pose_unit * unit:g}")
    scale = depth_scale / factor
    fitting = [usual for usual in USUAL_SCALES if abs(np.log(usual / scale)) < np.log(max(chosen.factor_within, 1.01))]
    if not fitting and abs(np.log(FOOT * factor)) < np.log(min(chosen.factor_within, CERTAIN_FACTOR)):
        text = f"translations are {factor:.3g} times as long as in the images: in feet"
        return Finding(Verdict.ERROR, "poses", text, f"dataset.pose_unit={chosen.reading.pose_unit * FOOT:g}")
    setting = fitting[0] if fitting else float(f"{scale:.3g}")
    text = f"expected {scale:.3g} units per m according to the poses, got {depth_scale:g}"
    return Finding(Verdict.ERROR, "depth", text, f"dataset.depth_scale={setting:g}")


def _named(reading: PoseReading) -> str:
    parts = [reading.pose_kind.value] if reading.pose_kind is not PoseKind.T_WORLD_CAMERA else []
    if reading.camera_axes is not CameraAxes.OPENCV:
        parts.append(f"of a camera with {reading.camera_axes.value}")
    if reading.quaternion_order is not QuaternionOrder.XYZW:
        parts.append("with quaternions in the order w x y z")
    return ", ".join(parts) or "T_world_camera with x right, y down, z forward"


def _equal_to_best(fits: Sequence[PoseFit]) -> list[PoseFit]:
    least = min(one.error for one in fits)  # for a panning camera, several conventions fit equally well
    return [one for one in fits if one.error <= ALIKE * least + ALIKE_PX]


def _settings(reading: PoseReading, given: PoseReading) -> tuple[str, ...]:
    """Return the overrides KEY=VALUE that change the convention `given` to `reading`."""
    names = ("mirrored", "pose_kind", "camera_axes", "quaternion_order")
    changed = [name for name in names if getattr(reading, name) != getattr(given, name)]
    return tuple(f"dataset.{name}={getattr(reading, name).name}" for name in changed)
