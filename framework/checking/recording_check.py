"""Checks of a recording before mapping."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from framework.checking import Finding, Verdict, pose_fit, registration
from framework.checking.changed_sequences import DelayedDepth
from framework.checking.color_timing import check_color_delay
from framework.checking.depth_kind import check_depth_kind
from framework.checking.depth_normalization import check_normalization
from framework.checking.frame_times import check_times
from framework.checking.image_geometry import check_camera, check_orientation
from framework.checking.matched_pairs import MatchedPair, Matcher
from framework.checking.pose_delay import delayed, find_delay
from framework.checking.pose_fit import PLAUSIBLE, UNPOSED, USUAL_SCALES, PoseJudgment
from framework.checking.pose_jumps import PoseJumps, find_jumps
from framework.checking.registration import EdgeAlignment, EdgeComparison, color_gradient
from framework.checking.repeated_images import check_repeats
from framework.data import Float64, Frame
from framework.datasets.frames.conventions import (
    LARGEST_POSE_UNIT,
    LEAST_POSE_UNIT,
    MIRRORED_POSE,
    OF_MATRICES,
    Mirror,
    PoseReading,
)
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import DataError, FrameError
from framework.interfaces import RGBDSequence, RGBDVideo

CHECKED_FRAMES = 12  # number of checked frames, evenly spaced over the sequence
QUICK_STARTS, QUICK_STEPS = (0.1, 0.35, 0.6, 0.85), (1, 4, 16)  # fractions of the sequence; steps in frames
QUICK_JUMPS = 6  # number of pairs of neighboring frames that a run compares, with the largest motions
MAX_MISSING = 0.7  # maximum fraction of pixels without a depth reading, for a good map
MAX_BEYOND = 0.3  # maximum fraction of depth readings beyond the mapped range, for a good map
# maximum width of sharp color edges, as a fraction of the image width; real recordings have 4 to 9 px of 640
MAX_EDGE_WIDTH = 12 / 640
EDGE_WINDOW = 15 / 640  # side of the window for the contrast of an edge, as a fraction of the image width
MAX_MOTION = 0.2  # fraction of the image width, maximum motion per frame for the trackers
TYPICAL = 0.5, 4.5  # m, median depth of most rooms; real recordings have 1 to 3.5
SHOWN_MOTION = 0.06  # fraction of the image width, motion of the pair in the figure; makes errors visible

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordingCheck:
    """Results of the checks of a recording, and the data of the figure."""

    findings: tuple[Finding, ...]
    summary: str  # one line about the recording
    frames: tuple[Frame, ...]  # checked frames
    by_delay: tuple[EdgeAlignment, ...]  # edge alignment for each delay of depth
    poses: PoseJudgment
    pair: MatchedPair | None  # pair in the figure, with the stored poses
    meant: MatchedPair | None  # pair in the figure, with the pose delay corrected

    @property
    def errors(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.verdict is Verdict.ERROR)


def check(sequence: RGBDSequence, farthest: float) -> RecordingCheck:
    """Check some frames of a sequence and their neighbors.

    Args:
        sequence: Sequence.
        farthest: Mapped range, m.

    Raises:
        DataError: No frame is readable.
    """
    given, depth_delay = PoseReading(), 0
    left_handed, sequence = _without_mirroring(sequence)
    if isinstance(sequence, Recording):
        given, depth_delay = sequence.pose_reading, sequence.depth_reading.depth_delay
        # use all depth readings, and poses before conversion, but rigid
        mirrored = given.mirrored if given.mirrored in OF_MATRICES else Mirror.NONE
        stored = PoseReading(pose_delay=given.pose_delay, mirrored=mirrored)
        sequence = replace(sequence, pose_reading=stored, max_depth=0.0)
        given = replace(given, mirrored=Mirror.NONE if mirrored is not Mirror.NONE else given.mirrored)
    count = len(sequence)
    chosen = [int(k) for k in np.unique(np.linspace(0, count - 1, CHECKED_FRAMES).round())]
    frames, errors = _read(sequence, chosen)
    findings = []
    if errors:
        text = f"{len(errors)} of {len(chosen)} checked frames cannot be read; first error: {errors[0]}"
        findings.append(Finding(Verdict.NOTE, "frames", text))
    causes = _image_findings(sequence, chosen)
    depth_finding, median_depth = _check_depth(frames, farthest, _scale_of(sequence))
    longest = registration.MAX_DELAY
    room = min(longest, (count - 1) // 4)  # number of frames before and after each checked frame
    edges = EdgeComparison(sequence, sorted({min(max(k, room), count - 1 - room) for k in chosen}))
    by_delay = edges.alignments((delay, 1.0) for delay in range(-longest, longest + 1))
    best = max(by_delay, key=lambda alignment: alignment.strength).delay if by_delay else 0
    matcher = Matcher(sequence)
    starts = sorted({min(k, max(count - 2, 0)) for k in chosen})
    neighbors = [matcher.pair(k, 1) for k in starts if k + 1 < count]
    matched = [pair for pair in neighbors if pair is not None]
    if not _contain_error(causes):
        causes += filter(None, [check_repeats(matched)])
    steps = np.array([pair.motion for pair in matched]) / sequence.camera.width
    by_zoom = edges.alignments((best, zoom) for zoom in registration.ZOOMS)
    step = float(np.median(steps)) if len(steps) else 0.0
    registration_finding, late = registration.judge(by_delay, by_zoom, depth_delay, step)
    if late:
        matcher = Matcher(DelayedDepth(sequence, late))
    pairs = list(matcher.pairs(starts))
    if not _contain_error(causes):
        causes += filter(None, [check_depth_kind(pairs) or check_camera(sequence.camera, pairs)])
    posed = [pair for pair in pairs if _is_posed(pair)]
    if any(frame.T_world_camera is not None for frame in frames):
        judgment, pose_delay = _judge_poses(sequence, posed, given, median_depth)
        if depth_finding.setting and _is_inconsistent(judgment):
            judgment = _judged_at_scale(sequence, starts, given, depth_finding.setting) or judgment
        if not (late or pose_delay or depth_finding.verdict is Verdict.ERROR):
            judgment = _with_jumps(judgment, matcher, posed, given, median_depth)
    else:
        no_poses = Finding(Verdict.FINE, "poses", "none in the recording; the camera is tracked")
        judgment, pose_delay = PoseJudgment((no_poses,), None, None), 0
    # poses determine the depth scale more accurately
    if not any(finding.subject == "depth" for finding in judgment.findings):
        findings.append(depth_finding)
    motion_finding = _check_motion(steps, len(neighbors), sequence.camera.width)
    of_poses = [left_handed] if left_handed and not _contain_error(judgment.findings) else judgment.findings
    of_pairs = [*of_poses, registration_finding, check_color_delay(matcher)]
    if _contain_error(causes):
        of_pairs = []  # the results of frame pairs are consequences
        if any(cause.subject == "depth" for cause in causes):
            findings = [finding for finding in findings if finding.subject != "depth"]
    findings += [*causes, *of_pairs, motion_finding, _check_sharpness(frames), *check_times(sequence)]
    findings.append(Finding(Verdict.FINE, "sensor", f"{frames[0].sensor}"))
    camera = sequence.camera
    summary = (
        f"{sequence.name}: {count} frames of {camera.width}x{camera.height} px, fx {camera.fx:.4g} px; "
        f"checked {len(frames)} frames and their neighbors"
    )
    shown = min(posed or pairs, key=lambda pair: abs(pair.motion - SHOWN_MOTION * camera.width), default=None)
    meant = delayed(shown, _stored_poses(sequence), pose_delay) if shown is not None and pose_delay else shown
    return RecordingCheck(tuple(findings), summary, tuple(frames), tuple(by_delay), judgment, shown, meant)


def _without_mirroring(sequence: RGBDSequence) -> tuple[Finding | None, RGBDSequence]:
    """Return an error and the sequence without the mirroring if all poses have the determinant -1."""
    if not isinstance(sequence, Recording) or not all(MIRRORED_POSE in one.error for one in sequence.contents.frames):
        return None, sequence
    reading = sequence.pose_reading
    corrected = [replace(sequence, pose_reading=replace(reading, mirrored=option)) for option in OF_MATRICES]
    errors = []
    for one in corrected:
        starts = [int(fraction * len(one)) for fraction in QUICK_STARTS]
        pairs = [pair for pair in Matcher(one).pairs(starts) if _is_posed(pair)]
        errors.append(pose_fit.fit(pairs, PoseReading(), 1.0).error if pairs else 0.0)
    best = int(np.argmin(errors))
    text = f"expected a right-handed world, got {MIRRORED_POSE}"
    return Finding(Verdict.ERROR, "poses", text, f"dataset.mirrored={OF_MATRICES[best].name}"), corrected[best]


def _is_inconsistent(judgment: PoseJudgment) -> bool:
    return any(finding.setting == UNPOSED for finding in judgment.findings)


def _contain_error(findings: Iterable[Finding]) -> bool:
    return any(finding.verdict is Verdict.ERROR for finding in findings)


def _judged_at_scale(
    sequence: RGBDSequence, starts: Sequence[int], given: PoseReading, setting: str
) -> PoseJudgment | None:
    """Return the result of the pose checks at another depth scale, or None if the poses are then inconsistent, too."""
    if not isinstance(sequence, Recording):
        return None
    scale = float(setting.partition("=")[2])
    scaled = replace(sequence, depth_reading=replace(sequence.depth_reading, depth_scale=scale))
    pairs = [pair for pair in Matcher(scaled).pairs(starts) if _is_posed(pair)]
    if not pairs:
        return None
    median_depth = float(np.median(np.concatenate([pair.points_first[:, 2] for pair in pairs])))
    judgment = pose_fit.judge(pairs, replace(given, pose_delay=0), scale, median_depth)
    return None if _is_inconsistent(judgment) else judgment


def _judge_poses(
    sequence: RGBDSequence, pairs: Sequence[MatchedPair], given_reading: PoseReading, median_depth: float
) -> tuple[PoseJudgment, int]:
    """Return the results of the pose checks, and the delay of the poses in frames."""
    given, scale = replace(given_reading, pose_delay=0), _scale_of(sequence)
    judgment = pose_fit.judge(pairs, given, scale, median_depth)
    if judgment.given is None or judgment.best is None:
        return judgment, 0
    poses = _stored_poses(sequence)
    fits = [judgment.given, judgment.best, replace(judgment.given, depth_factor=judgment.best.depth_factor)]
    late = find_delay(pairs, poses, fits)
    if late is None:
        return judgment, 0
    meant = [delayed(pair, poses, late.frames) for pair in pairs]
    then = pose_fit.judge([pair for pair in meant if _is_posed(pair)], given, scale, median_depth)
    others = [finding for finding in then.findings if finding.verdict is not Verdict.FINE]
    assert isinstance(sequence, Recording)  # only recordings have stored poses
    step = float(np.median(np.diff([recorded.timestamp for recorded in sequence.contents.frames])))
    findings = (late.finding(given_reading.pose_delay, step), *others)
    return replace(then, findings=findings, given=judgment.given), late.frames


def _with_jumps(
    judgment: PoseJudgment, matcher: Matcher, pairs: Sequence[MatchedPair], given: PoseReading, median_depth: float
) -> PoseJudgment:
    """Return the judgment with the jumps of the poses, unless another error explains them."""
    jumps = find_jumps(matcher, _chosen_poses(matcher.sequence), given)
    finding = jumps.finding()
    if finding is None:
        return judgment
    if _contain_error(judgment.findings):  # the cause of the jumps, or an effect
        if _explains(judgment, jumps, given):
            return judgment
        judged = pose_fit.judge(jumps.without(pairs), given, _scale_of(matcher.sequence), median_depth)
        if any(one.verdict is not Verdict.FINE for one in judged.findings):
            return judgment
        judgment = judged
    return replace(judgment, findings=(finding,))


def _explains(judgment: PoseJudgment, jumps: PoseJumps, given: PoseReading) -> bool:
    """Return True if most jumps are absent with the best convention and scale of a judgment."""
    if judgment.best is None:
        return False
    best = judgment.best.reading
    unit = best.pose_unit / judgment.best.depth_factor  # has the effect of another depth scale
    if not LEAST_POSE_UNIT <= unit <= LARGEST_POSE_UNIT or replace(best, pose_unit=unit) == given:
        return False
    return PoseJumps.of(jumps.pairs, replace(best, pose_unit=unit)).count < jumps.count / 2


def _chosen_poses(sequence: RGBDSequence) -> Sequence[Float64 | None]:
    """Return the pose of each selected frame of a recording."""
    if not isinstance(sequence, Recording):
        return []
    return [sequence.contents.frames[index].T_world_camera for index in sequence.chosen]


def _stored_poses(sequence: RGBDSequence) -> Sequence[Float64 | None]:
    """Return the poses of all frames in a recording, including frames that are not selected."""
    return [recorded.T_world_camera for recorded in sequence.contents.frames] if isinstance(sequence, Recording) else []


def warn_of_images(sequence: RGBDVideo) -> bool:
    """Log a warning if the camera, the orientation of color images or the unit of depth of a few frames is wrong.

    Return True after a warning.
    """
    if not isinstance(sequence, Recording):
        return False
    chosen = [int(k) for k in np.unique([int(fraction * len(sequence)) for fraction in QUICK_STARTS])]
    found = [*_image_findings(sequence, chosen), check_camera(sequence.camera)]
    errors = [finding for finding in found if finding is not None and finding.verdict is Verdict.ERROR]
    for finding in errors:
        log.warning("%s: %s; run `instancemap check` for details", finding.subject, finding.text)
    return bool(errors)


def _image_findings(sequence: RGBDSequence, chosen: Sequence[int]) -> list[Finding]:
    """Return the results for the camera, the color images and the depth images that explain other errors."""
    found = (check_orientation(sequence, chosen), check_normalization(sequence, chosen))
    return [finding for finding in found if finding is not None]


CHECK = "run `instancemap check` for details"


def warn_of_poses(sequence: RGBDVideo, fix: str = CHECK) -> None:
    """Log a warning with a fix if the given poses do not fit the images of a few frames."""
    if not isinstance(sequence, RGBDSequence) or not sequence.has_poses():
        return
    starts = [int(fraction * len(sequence)) for fraction in QUICK_STARTS]
    matcher = Matcher(sequence)
    pairs = [pair for pair in matcher.pairs(starts, QUICK_STEPS) if _is_posed(pair)]
    if not pairs:
        return
    median_depth = float(np.median(np.concatenate([pair.points_first[:, 2] for pair in pairs])))
    findings = pose_fit.judge(pairs, PoseReading(), _scale_of(sequence), median_depth).findings
    errors = [finding for finding in findings if finding.verdict is Verdict.ERROR]
    if not errors:
        jump = find_jumps(matcher, _chosen_poses(sequence), PoseReading(), QUICK_JUMPS, revisits=0).finding()
        errors = [] if jump is None else [jump]
    for finding in errors:
        log.warning("%s: %s; %s", finding.subject, finding.text, fix)


def _is_posed(pair: MatchedPair) -> bool:
    return pair.first.T_world_camera is not None and pair.second.T_world_camera is not None


def _scale_of(sequence: RGBDSequence) -> float:
    """Return the depth units per meter."""
    return sequence.contents.depth_scale if isinstance(sequence, Recording) else 1.0


def _read(sequence: RGBDSequence, chosen: Sequence[int]) -> tuple[list[Frame], list[FrameError]]:
    frames, errors = [], []
    for k in chosen:
        try:
            frame = sequence[k]
            if frame.truth is not None and not frame.truth.of_depth:
                frame.truth.instance_ids  # noqa: B018  # decodes the stored image, which may be damaged
            frames.append(frame)
        except FrameError as error:
            errors.append(error)
    if not frames:
        raise DataError(
            f"{sequence.name}: expected at least one readable frame, got none among {len(chosen)} checked frames; "
            f"first error: {errors[0]}"
        )
    return frames, errors


def _check_depth(frames: Sequence[Frame], farthest: float, scale: float) -> tuple[Finding, float]:
    """Check the depth images. Return the result and the median depth in m.

    Args:
        frames: Checked frames.
        farthest: Mapped range, m.
        scale: Depth units per meter.
    """
    readings = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    if not len(readings):
        return Finding(Verdict.ERROR, "depth", "no readings in any checked frame"), 0.0
    median = float(np.median(readings))
    missing = 1 - len(readings) / sum(frame.depth.size for frame in frames)
    beyond = float((readings > farthest).mean())
    text = (
        f"median {median:.2f} m, {missing:.0%} of the pixels without a reading, "
        f"{beyond:.0%} of the readings beyond the mapped range of {farthest:g} m"
    )
    low, high = PLAUSIBLE
    if not low <= median <= high:
        low, high = TYPICAL
        fitting = [usual for usual in USUAL_SCALES if low <= median * scale / usual <= high]
        setting = f"dataset.depth_scale={fitting[0]:g}" if fitting else ""
        return Finding(Verdict.ERROR, "depth", f"{text}; implausible for a room", setting), median
    poor = missing > MAX_MISSING or beyond > MAX_BEYOND
    return Finding(Verdict.NOTE if poor else Verdict.FINE, "depth", text), median


def _check_motion(steps: Float64, neighbors: int, width: int) -> Finding:
    """Check the image motion between neighboring frames.

    Args:
        steps: Motion of each matched pair, as a fraction of the image width.
        neighbors: Number of all pairs.
        width: Image width, px.
    """
    if not neighbors:
        return Finding(Verdict.UNKNOWN, "motion", "unknown with a single frame")
    lost = neighbors - len(steps)
    if not len(steps):
        text = f"none of {neighbors} pairs of neighboring frames has enough overlap and texture"
        return Finding(Verdict.NOTE, "motion", f"{text}; tracking will fail")
    text = f"median of {width * np.median(steps):.0f} px per frame, maximum of {width * steps.max():.0f} px"
    if lost:
        text += f"; {lost} of {neighbors} pairs of neighboring frames have too little overlap"
    fast = float(np.median(steps)) > MAX_MOTION or lost > neighbors // 2
    return Finding(Verdict.NOTE if fast else Verdict.FINE, "motion", text)


def _check_sharpness(frames: Sequence[Frame]) -> Finding:
    """Check the image sharpness by the width of color edges."""
    widths = [_edge_width(frame) for frame in frames]
    text = f"median edge width of {np.median(widths):.1f} px, maximum of {max(widths):.1f} px in {len(frames)} frames"
    blurred = sum(width > MAX_EDGE_WIDTH * frames[0].camera.width for width in widths)
    if blurred > len(frames) // 3:
        return Finding(Verdict.NOTE, "sharpness", f"{text}; move the camera more slowly, or add light")
    return Finding(Verdict.FINE, "sharpness", text)


def _edge_width(frame: Frame) -> float:
    """Return the median width of the strongest color edges, px."""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    window = np.ones((max(3, round(EDGE_WINDOW * frame.camera.width)),) * 2, np.uint8)
    contrast = cv2.subtract(cv2.dilate(gray, window), cv2.erode(gray, window)).astype(np.float32)
    slope = color_gradient(frame) / 8  # the weights of the Sobel filter add up to 8
    strong = slope >= max(float(np.quantile(slope, 0.95)), 1e-3)
    # the width of an edge is its contrast divided by its gradient
    return float(np.median(contrast[strong] / slope[strong])) if strong.any() else float(len(window))
