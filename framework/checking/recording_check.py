"""All that is looked at before a recording is mapped, and what it says."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from framework.checking import pose_fit, registration
from framework.checking.finding import Finding, Verdict
from framework.checking.matched_pairs import MatchedPair, Matcher
from framework.checking.pose_delay import delayed, find_delay
from framework.checking.pose_fit import PLAUSIBLE, USUAL_SCALES, PoseJudgement
from framework.checking.registration import EdgeAlignment, EdgeComparison, color_gradient
from framework.data import Camera, Float64, Frame
from framework.datasets.frames.conventions import PoseReading
from framework.datasets.frames.sequence_reader import Recording
from framework.errors import DataError, FrameError
from framework.interfaces import RGBDSequence, RGBDVideo

LOOKED_AT = 12  # frames, spread over the sequence
GLANCED_AT, GLANCED_STEPS = (0.1, 0.35, 0.6, 0.85), (1, 4, 16)  # shares of the sequence; frames from there
MOST_WITHOUT = 0.7  # of the pixels without a reading, that a map can be made with
MOST_BEYOND = 0.3  # of the readings beyond what is mapped, that are worth a word
WIDEST_EDGE = 12 / 640  # of the image's width, of colour edges that are sharp; kitchen 4, desk 5, rendered ScanNet 9 px
EDGE_WINDOW = 15 / 640  # of the width: within it an edge's contrast is taken
FASTEST = 0.2  # of the image's width from frame to frame, that trackers follow
TYPICAL = 0.5, 4.5  # m, the median depth of most rooms: kitchen 1.9, desk 1.0, flat 1.3, study room 3.5
SHOWN_MOTION = 0.06  # of the image's width, of the pair in the picture: enough to see what does not fit
LONGEST_GAP = 0.5  # s between frames, and five times the usual

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RecordingCheck:
    """What was found, and what the picture of it shows."""

    findings: tuple[Finding, ...]
    summary: str
    frames: tuple[Frame, ...]  # those looked at
    by_delay: tuple[EdgeAlignment, ...]
    poses: PoseJudgement
    pair: MatchedPair | None  # of stored poses, which a picture shows
    meant: MatchedPair | None  # the same with the poses that belong to its frames

    @property
    def faults(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.verdict is Verdict.FAULT)


def check(sequence: RGBDSequence, farthest: float) -> RecordingCheck:
    """Looks at some frames of a sequence and their neighbours; `farthest` m is what the map takes.

    Raises DataError when none of them can be read.
    """
    asked = sequence.pose_reading if isinstance(sequence, Recording) else PoseReading()
    delay = sequence.depth_reading.depth_delay if isinstance(sequence, Recording) else 0
    if isinstance(sequence, Recording):
        # as it is stored: readings that are too far, and poses that another reading turns
        sequence = replace(sequence, pose_reading=PoseReading(pose_delay=asked.pose_delay), max_depth=0.0)
    count = len(sequence)
    chosen = [int(k) for k in np.unique(np.linspace(0, count - 1, LOOKED_AT).round())]
    frames, unreadable = _read(sequence, chosen)
    findings = []
    if unreadable:
        text = f"{len(unreadable)} of {len(chosen)} cannot be read; the first: {unreadable[0]}"
        findings.append(Finding(Verdict.NOTE, "frames", text))
    of_depth, median_depth = _depth(frames, farthest, _scale_of(sequence))
    edges = EdgeComparison(sequence, _with_neighbours(chosen, count))
    by_delay = edges.by_delay()
    best = max(by_delay, key=lambda agreement: agreement.strength).delay if by_delay else 0
    matcher = Matcher(sequence)
    starts = sorted({min(k, max(count - 2, 0)) for k in chosen})
    neighbours = [matcher.pair(k, 1) for k in starts if k + 1 < count]
    steps = np.array([pair.motion for pair in neighbours if pair is not None]) / sequence.camera.width
    of_registration, late = registration.judge(
        by_delay, edges.by_zoom(best), delay, float(np.median(steps)) if len(steps) else 0.0
    )
    if late:
        matcher = Matcher(DelayedDepth(sequence, late))
    pairs = list(matcher.pairs(starts))
    posed = [pair for pair in pairs if _posed(pair)]
    if any(frame.T_world_camera is not None for frame in frames):
        judgement, pose_delay = _judge_poses(sequence, posed, asked, median_depth)
    else:
        judgement = PoseJudgement(
            (Finding(Verdict.FINE, "poses", "none are given: the camera is tracked"),), None, None
        )
        pose_delay = 0
    if not any(finding.subject == "depth" for finding in judgement.findings):  # poses know it better
        findings.append(of_depth)
    of_motion = _motion(steps, len(neighbours), sequence.camera.width)
    findings += [*judgement.findings, of_registration, of_motion, _sharpness(frames), *_times(sequence)]
    shown = min(
        posed or pairs, key=lambda pair: abs(pair.motion - SHOWN_MOTION * pair.first.camera.width), default=None
    )
    meant = delayed(shown, _stored_poses(sequence), pose_delay) if shown is not None and pose_delay else shown
    return RecordingCheck(
        tuple(findings), _summary(sequence, frames), tuple(frames), tuple(by_delay), judgement, shown, meant
    )


def _judge_poses(
    sequence: RGBDSequence, pairs: Sequence[MatchedPair], asked: PoseReading, median_depth: float
) -> tuple[PoseJudgement, int]:
    """What the pairs say of the poses, and by how many frames these are late."""
    given, scale = replace(asked, pose_delay=0), _scale_of(sequence)
    judgement = pose_fit.judge(pairs, given, scale, median_depth)
    if judgement.given is None or judgement.best is None:
        return judgement, 0
    poses = _stored_poses(sequence)
    fits = [judgement.given, judgement.best, replace(judgement.given, depth_factor=judgement.best.depth_factor)]
    late = find_delay(pairs, poses, fits)
    if late is None:
        return judgement, 0
    meant = [delayed(pair, poses, late.frames) for pair in pairs]
    then = pose_fit.judge([pair for pair in meant if _posed(pair)], given, scale, median_depth)
    others = [finding for finding in then.findings if finding.verdict is not Verdict.FINE]
    findings = (late.finding(asked.pose_delay, _step(sequence)), *others)
    return replace(then, findings=findings, given=judgement.given), late.frames


def _step(sequence: RGBDSequence) -> float:
    """s, from one frame of a recording to the next, chosen or not."""
    assert isinstance(sequence, Recording)
    return float(np.median(np.diff([recorded.timestamp for recorded in sequence.contents.frames])))


def _stored_poses(sequence: RGBDSequence) -> Sequence[Float64 | None]:
    """Those of all frames of a recording, chosen or not."""
    return [recorded.T_world_camera for recorded in sequence.contents.frames] if isinstance(sequence, Recording) else []


def warn_of_poses(sequence: RGBDVideo) -> None:
    """The cheap part of it, at the start of a run: says in the log where the given poses do not fit a few frames."""
    if not isinstance(sequence, RGBDSequence) or not sequence.has_poses():
        return
    starts = [int(share * len(sequence)) for share in GLANCED_AT]
    pairs = [pair for pair in Matcher(sequence).pairs(starts, GLANCED_STEPS) if _posed(pair)]
    if not pairs:
        return
    median_depth = float(np.median(np.concatenate([pair.points_first[:, 2] for pair in pairs])))
    for finding in pose_fit.judge(pairs, PoseReading(), _scale_of(sequence), median_depth).findings:
        if finding.verdict is Verdict.FAULT:
            log.warning("%s: at a glance, %s; `python -m framework check` looks closer", finding.subject, finding.text)


@dataclass
class DelayedDepth(RGBDSequence):
    """A sequence whose depth is that of some frames later."""

    sequence: RGBDSequence
    delay: int  # frames

    def __post_init__(self) -> None:
        self.camera: Camera = self.sequence.camera
        self.name = self.sequence.name

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, k: int) -> Frame:
        if not 0 <= k + self.delay < len(self.sequence):
            raise FrameError(f"frame {k}: no depth image is {self.delay} frames away")
        return replace(self.sequence[k], depth=self.sequence[k + self.delay].depth)


def _posed(pair: MatchedPair) -> bool:
    return pair.first.T_world_camera is not None and pair.second.T_world_camera is not None


def _scale_of(sequence: RGBDSequence) -> float:
    """Units a metre."""
    return sequence.contents.depth_scale if isinstance(sequence, Recording) else 1.0


def _with_neighbours(chosen: Sequence[int], count: int) -> list[int]:
    """The positions, moved from the ends to where there is room for frames before and after."""
    room = min(registration.LONGEST_DELAY, (count - 1) // 4)
    return sorted({min(max(k, room), count - 1 - room) for k in chosen})


def _read(sequence: RGBDSequence, chosen: Sequence[int]) -> tuple[list[Frame], list[FrameError]]:
    frames, faults = [], []
    for k in chosen:
        try:
            frames.append(sequence[k])
        except FrameError as error:
            faults.append(error)
    if not frames:
        raise DataError(f"none of the {len(chosen)} frames that were looked at can be read; the first: {faults[0]}")
    return frames, faults


def _depth(frames: Sequence[Frame], farthest: float, scale: float) -> tuple[Finding, float]:
    """What the readings are like, and their median, m."""
    readings = np.concatenate([frame.depth[frame.depth > 0] for frame in frames])
    if not len(readings):
        return Finding(Verdict.FAULT, "depth", "there is not a single reading"), 0.0
    median = float(np.median(readings))
    without = 1 - len(readings) / sum(frame.depth.size for frame in frames)
    beyond = float((readings > farthest).mean())
    told = (
        f"median {median:.2f} m, {100 * without:.0f} % of the pixels without a reading, "
        f"{100 * beyond:.0f} % of the readings beyond the {farthest:g} m that are mapped"
    )
    low, high = PLAUSIBLE
    if not low <= median <= high:
        low, high = TYPICAL
        fitting = [usual for usual in USUAL_SCALES if low <= median * scale / usual <= high]
        setting = f"dataset.depth_scale={fitting[0]:g}" if fitting else ""
        return Finding(Verdict.FAULT, "depth", f"{told}: that is no room", setting), median
    if without > MOST_WITHOUT or beyond > MOST_BEYOND:
        return Finding(Verdict.NOTE, "depth", told), median
    return Finding(Verdict.FINE, "depth", told), median


def _motion(steps: Float64, neighbours: int, width: int) -> Finding:
    """How far the images move from frame to frame: `steps`, shares of the width, of those neighbours that tell."""
    subject = "motion"
    if not neighbours:
        return Finding(Verdict.UNKNOWN, subject, "there is but one frame")
    lost = neighbours - len(steps)
    if not len(steps):
        text = f"none of {neighbours} pairs of neighbouring frames shows enough in common, or has enough texture"
        return Finding(Verdict.NOTE, subject, f"{text}: trackers will lose the camera")
    text = f"{width * np.median(steps):.0f} px from frame to frame, {width * steps.max():.0f} px at most"
    if lost:
        text += f"; {lost} of {neighbours} neighbours have too little in common to say"
    fast = float(np.median(steps)) > FASTEST or lost > neighbours // 2
    return Finding(Verdict.NOTE if fast else Verdict.FINE, subject, text)


def _sharpness(frames: Sequence[Frame]) -> Finding:
    """How wide the colours' edges are: contrast by gradient, at the strongest ones."""
    widths = [_edge_width(frame) for frame in frames]
    width = frames[0].camera.width
    blurred = sum(each > WIDEST_EDGE * width for each in widths)
    text = (
        f"edges are {np.median(widths):.1f} px wide, {max(widths):.1f} px in the most blurred of {len(frames)} frames"
    )
    if blurred > len(frames) // 3:
        return Finding(Verdict.NOTE, "sharpness", f"{text}: move the camera slower, or give it more light")
    return Finding(Verdict.FINE, "sharpness", text)


def _edge_width(frame: Frame) -> float:
    """px"""
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    window = np.ones((max(3, round(EDGE_WINDOW * frame.camera.width)),) * 2, np.uint8)
    contrast = cv2.subtract(cv2.dilate(gray, window), cv2.erode(gray, window)).astype(np.float32)
    slope = color_gradient(frame) / 8  # Sobel's weights sum up to 8
    strong = slope >= max(float(np.quantile(slope, 0.95)), 1e-3)
    return float(np.median(contrast[strong] / slope[strong])) if strong.any() else float(len(window))


def _times(sequence: RGBDSequence) -> list[Finding]:
    """What the timestamps say, of recordings, which have them without reading any image."""
    if not isinstance(sequence, Recording) or len(sequence) < 3:
        return []
    times: Float64 = np.array([sequence.contents.frames[k].timestamp for k in sequence.chosen])
    steps = np.diff(times)
    usual = float(np.median(steps))
    gaps = int((steps > max(LONGEST_GAP, 5 * usual)).sum())
    text = f"{1 / usual:.3g} Hz for {times[-1] - times[0]:.1f} s"
    if gaps:
        return [Finding(Verdict.NOTE, "time", f"{text}, with {gaps} gaps, the longest of {steps.max():.1f} s")]
    return [Finding(Verdict.FINE, "time", text)]


def _summary(sequence: RGBDSequence, frames: Sequence[Frame]) -> str:
    camera = sequence.camera
    return (
        f"{sequence.name}: {len(sequence)} frames of {camera.width}x{camera.height} px, "
        f"fx {camera.fx:.4g} px; {len(frames)} were looked at, with their neighbours"
    )
