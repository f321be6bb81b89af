"""Which reading of a recording's poses moves the points of its images where the images show them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from framework.checking.finding import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.data import Float64
from framework.datasets.frames.conventions import CameraAxes, PoseKind, PoseReading, QuaternionOrder
from framework.geometry import inverse, project, transform

UNSEEN = 1.0  # of the image's width: the error of a point that a reading moves behind the camera, or farther than this
SHORTEST_BASELINE = 0.02  # of the median depth: a pair that moves less says nothing about the scale
FEWEST_PAIRS = 3  # that tell something
SHORTEST_MOTION = 0.01  # of the image's width: pairs that move less fit with any poses
POOR = 0.2  # of the motion: a larger error is not that of good poses; kitchen, flat, desk and ScanNet have 0.01 to 0.06
ALIKE, ALIKE_PX = 1.15, 0.2  # times and px, within which two errors are the same
CLEARLY = 0.5  # times the error as it is, or less, that another reading must have
UNCERTAIN = 0.07  # of the factor, whatever the pairs say: what poses and depth of real recordings leave
NOT_WORSE = 1.3  # times the error: the camera that only turns tells little of the scale
WRONG_SCALE = 2.5  # times too far or too near: rotating about the camera leaves the scale uncertain up to 1.6 times
USUAL_SCALES = (1000.0, 5000.0, 10_000.0, 4000.0, 1.0, 100.0, 2000.0, 256.0)  # units a metre, the usual ones first
PLAUSIBLE = (0.2, 12.0)  # m, the median depth of a room


@dataclass(frozen=True)
class PoseFit:
    """How well the poses explain the pairs, read in one way."""

    reading: PoseReading
    depth_factor: float  # what all depths are multiplied by
    errors: Float64  # (P,) px, of each pair: the median over its points
    factor_within: float = 1.0  # times, to either side, that the factor may be another one; 1 where it is given

    @property
    def error(self) -> float:
        """px"""
        return float(np.median(self.errors))


def readings(pose_unit: float = 1.0) -> Iterator[PoseReading]:
    """Those that are tried, the format's own first, of translations in that unit, m."""
    for order, kind, axes in product(QuaternionOrder, PoseKind, CameraAxes):
        yield PoseReading(kind, axes, order, pose_unit)


def fit(pairs: Sequence[MatchedPair], reading: PoseReading, depth_factor: float | None = None) -> PoseFit:
    """The error of a reading of the pairs' poses, which are known; without a factor, with the one that fits best."""
    moves = [motion_of(pair, reading) for pair in pairs]
    factor, within = (depth_factor, 1.0) if depth_factor else _depth_factor(pairs, moves)
    errors = np.array([error_of(pair, move, factor) for pair, move in zip(pairs, moves, strict=True)])
    return PoseFit(reading, factor, errors, within)


def motion_of(pair: MatchedPair, reading: PoseReading) -> Float64:
    """T_second_first (4, 4) by the poses of the two frames."""
    T_world_first, T_world_second = pair.first.T_world_camera, pair.second.T_world_camera
    assert T_world_first is not None
    assert T_world_second is not None
    return motion_between(T_world_first, T_world_second, reading)


def motion_between(T_world_first: Float64, T_world_second: Float64, reading: PoseReading) -> Float64:
    """T_second_first (4, 4) by two stored poses."""
    return inverse(reading.pose(T_world_second)) @ reading.pose(T_world_first)


def _depth_factor(pairs: Sequence[MatchedPair], moves: Sequence[Float64]) -> tuple[float, float]:
    """By how much the poses move farther than the images do, and within which factor that is; 1 where none can tell."""
    ratios = []
    for pair, T_second_first in zip(pairs, moves, strict=True):
        seen, moved = np.linalg.norm(pair.T_second_first[:3, 3]), np.linalg.norm(T_second_first[:3, 3])
        if seen > SHORTEST_BASELINE * np.median(pair.points_first[:, 2]) and moved > 0:
            ratios.append(float(np.log(moved / seen)))
    if len(ratios) < FEWEST_PAIRS:
        return 1.0, 1.0
    middle = float(np.median(ratios))
    spread = 1.5 * float(np.median(np.abs(np.array(ratios) - middle)))
    return float(np.exp(middle)), float(np.exp(UNCERTAIN + 3 * spread / np.sqrt(len(ratios))))


def error_of(pair: MatchedPair, T_second_first: Float64, factor: float) -> float:
    """px that a motion (4, 4) leaves, the median over the points, where all depths are multiplied by a factor."""
    moved = transform(T_second_first, pair.points_first.astype(np.float64) * factor)
    farthest = UNSEEN * pair.second.camera.width
    with np.errstate(all="ignore"):
        distance = np.linalg.norm(project(pair.second.camera, moved) - pair.pixels_second, axis=1)
    return float(np.median(np.where((moved[:, 2] > 0) & (distance < farthest), distance, farthest)))


@dataclass(frozen=True)
class PoseJudgement:
    """What the pairs say about a recording's poses and units."""

    findings: tuple[Finding, ...]
    given: PoseFit | None  # as the recording is read; None where the pairs do not tell
    best: PoseFit | None
    others: tuple[PoseFit, ...] = ()  # all readings, as they are


def judge(pairs: Sequence[MatchedPair], given: PoseReading, depth_scale: float, median_depth: float) -> PoseJudgement:
    """Whether the poses fit, which are the stored ones, as they are `given` to be read; and which reading fits better.

    `depth_scale` are the units a metre that depth is read with, `median_depth` m what that makes.
    """
    telling = [pair for pair in pairs if pair.motion > SHORTEST_MOTION * pair.first.camera.width]
    if len(telling) < FEWEST_PAIRS:
        text = f"too few pairs of frames move enough to say whether they fit ({len(telling)})"
        return PoseJudgement((Finding(Verdict.UNKNOWN, "poses", text),), None, None)
    motion = float(np.median([pair.motion for pair in telling]))
    as_given = fit(telling, given, 1.0)
    others = tuple(fit(telling, reading, 1.0) for reading in readings(given.pose_unit))
    scaled = [fit(telling, reading) for reading in (given, *readings(given.pose_unit))]
    alike = _that_fit_alike((as_given, *others, *scaled))
    best = min(alike, key=lambda one: (len(_settings(one.reading, given)), one.error))
    now, then = as_given.error, best.error
    reading = best.reading if now > POOR * motion and then < CLEARLY * now else given
    chosen = _with_trusted_factor(telling, reading)
    factor = chosen.depth_factor
    found = chosen.error
    told = (
        f"in {len(telling)} pairs of frames that move {motion:.0f} px, points lie {now:.1f} px from where they belong"
    )
    if reading == given and now <= POOR * motion and factor == 1.0:
        return PoseJudgement((Finding(Verdict.FINE, "poses", f"they fit: {told}"),), as_given, as_given, others)
    if found > POOR * motion:
        text = f"they do not fit the images, in any axes: {told}"
        finding = Finding(Verdict.FAULT, "poses", text, "tracker=voxel_hashing_icp, which needs none")
        return PoseJudgement((finding,), as_given, best, others)
    findings = []
    if reading != given:
        text = f"they are {_named(reading)}: {told}, and {found:.1f} px when they are read so"
        settings = {_settings(one.reading, given) for one in alike if one.reading not in (reading, given)}
        if settings:
            text += f"; {' or '.join(sorted(map(' '.join, settings)))} fits as well, as the camera moves"
        findings.append(Finding(Verdict.FAULT, "poses", text, " ".join(_settings(reading, given))))
    else:
        text = f"they fit once the scale does: {told}, and {found:.1f} px then"
        findings.append(Finding(Verdict.FINE, "poses", text))
    if factor != 1.0:
        findings.append(_scale_finding(chosen, depth_scale, median_depth))
    return PoseJudgement(tuple(findings), as_given, chosen, others)


def _with_trusted_factor(pairs: Sequence[MatchedPair], reading: PoseReading) -> PoseFit:
    """With depth as it is, unless another factor is plain."""
    as_it_is, scaled = fit(pairs, reading, 1.0), fit(pairs, reading)
    now, then = as_it_is.error, scaled.error
    far = not 1 / WRONG_SCALE < scaled.depth_factor < WRONG_SCALE
    return scaled if (far and then < NOT_WORSE * now) or then < CLEARLY * now else as_it_is


def _scale_finding(chosen: PoseFit, depth_scale: float, median_depth: float) -> Finding:
    low, high = PLAUSIBLE
    factor = chosen.depth_factor
    if low <= median_depth <= high and not low <= median_depth * factor <= high:
        text = (
            f"they move {factor:.3g} times as far as the images, whose median depth of {median_depth:.2f} m is a room's"
        )
        unit = chosen.reading.pose_unit * 10.0 ** round(np.log10(1 / factor))
        return Finding(Verdict.FAULT, "poses", text, f"dataset.pose_unit={unit:g}")
    scale = depth_scale / factor
    fitting = [usual for usual in USUAL_SCALES if abs(np.log(usual / scale)) < np.log(chosen.factor_within)]
    setting = fitting[0] if fitting else float(f"{scale:.3g}")
    text = f"by the poses, it is {factor:.3g} times as much: {depth_scale:g} units are not a metre"
    return Finding(Verdict.FAULT, "depth", text, f"dataset.depth_scale={setting:g}")


def _named(reading: PoseReading) -> str:
    parts = [reading.pose_kind.value] if reading.pose_kind is not PoseKind.T_WORLD_CAMERA else []
    if reading.camera_axes is not CameraAxes.OPENCV:
        parts.append(f"of a camera with {reading.camera_axes.value}")
    if reading.quaternion_order is not QuaternionOrder.XYZW:
        parts.append("with quaternions in the order w x y z")
    return ", ".join(parts) or "T_world_camera with x right, y down, z forward"


def _that_fit_alike(fits: Sequence[PoseFit]) -> list[PoseFit]:
    """The best one, and those that nobody can tell from it: to a camera that only pans, some axes are the same."""
    least = min(one.error for one in fits)
    return [one for one in fits if one.error <= ALIKE * least + ALIKE_PX]


def _settings(reading: PoseReading, given: PoseReading) -> tuple[str, ...]:
    """The parameters in which the readings differ."""
    names = ("pose_kind", "camera_axes", "quaternion_order")
    return tuple(
        f"dataset.{name}={getattr(reading, name).name}"
        for name in names
        if getattr(reading, name) != getattr(given, name)
    )
