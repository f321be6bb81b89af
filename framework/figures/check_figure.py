"""Figure of a recording check: alignment of depth, color and poses, and the error of each pose convention."""

from __future__ import annotations

import textwrap
from pathlib import Path

import cv2
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from framework.checking import Verdict
from framework.checking.matched_pairs import MatchedPair
from framework.checking.pose_fit import PoseFit, PoseJudgment, motion_of
from framework.checking.recording_check import RecordingCheck
from framework.checking.registration import depth_edges
from framework.data import Float64, Frame, UInt8
from framework.datasets.frames.conventions import CameraAxes, PoseKind, PoseReading, QuaternionOrder
from framework.files.atomic_write import atomic_write
from framework.geometry import back_project, project, transform

SIZE_IN, DPI = (15.0, 9.4), 100
TITLE_PT, TEXT_PT = 10.0, 9.0
LINE = 180  # maximum number of characters per line of the list of checks
COLORS = {Verdict.FINE: "#1a7f37", Verdict.UNKNOWN: "#787e86", Verdict.NOTE: "#9a6700", Verdict.ERROR: "#cf222e"}
CHOSEN, OTHER = "#1a7f37", "#b0b6be"


@rc_context({"text.parse_math": False})  # names can contain $
def write_check(path: Path, check: RecordingCheck) -> None:
    """Write the figure of a recording check as a PNG."""
    figure = Figure(SIZE_IN, facecolor="white")
    grid = figure.add_gridspec(
        3, 4, height_ratios=(1, 1, 0.75), left=0.02, right=0.98, top=0.9, bottom=0.01, wspace=0.16
    )
    figure.suptitle(check.summary, fontsize=TITLE_PT + 2, x=0.02, ha="left")
    frame = check.pair.first if check.pair is not None else check.frames[len(check.frames) // 2]
    _image(figure.add_subplot(grid[0, 0]), f"color of frame {frame.index}", frame.color)
    _depth(figure.add_subplot(grid[0, 1]), frame)
    _image(figure.add_subplot(grid[0, 2]), "depth edges (red) on color", _edges_on_color(frame))
    _delays(figure.add_subplot(grid[0, 3]), check)
    _warped(figure.add_subplot(grid[1, 0]), "as configured", check.pair, check.poses.given)
    if check.poses.best is not None:
        _warped(figure.add_subplot(grid[1, 1]), "best fit", check.meant, check.poses.best)
    _readings(figure.add_subplot(grid[1, 2:]), check.poses)
    _findings(figure.add_subplot(grid[2, :]), check)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=DPI)


def _image(axes: Axes, title: str, image: UInt8) -> None:
    axes.imshow(image)
    axes.set_title(title, fontsize=TITLE_PT)
    axes.set(xticks=[], yticks=[])


def _depth(axes: Axes, frame: Frame) -> None:
    shown = axes.imshow(np.ma.masked_equal(frame.depth, 0), cmap="turbo_r")
    axes.set_facecolor("black")
    axes.set_title("depth, m (black: missing)", fontsize=TITLE_PT)
    axes.set(xticks=[], yticks=[])
    assert axes.figure is not None
    axes.figure.colorbar(shown, ax=axes, fraction=0.035, pad=0.02).ax.tick_params(labelsize=TEXT_PT)


def _edges_on_color(frame: Frame) -> UInt8:
    gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    shown = np.repeat((96 + gray // 2 + gray // 8)[:, :, None], 3, axis=2)
    thick = cv2.dilate(depth_edges(frame.depth).astype(np.uint8), np.ones((2, 2), np.uint8)) > 0
    shown[thick] = (220, 20, 30)
    return np.asarray(shown, np.uint8)


def _warped(axes: Axes, title: str, pair: MatchedPair | None, fit: PoseFit | None) -> None:
    """Draw the first frame in red and the second frame, warped to the first, in cyan. Aligned pixels are gray."""
    if pair is None:
        _say(axes, "no pair of frames with enough overlap")
        return
    if fit is None:
        T_second_first, factor, title = pair.T_second_first, 1.0, "from image matches"
    else:
        T_second_first, factor = motion_of(pair, fit.reading), fit.depth_factor
    title = f"{title}: frame {pair.first.index} (red),\nframe {pair.second.index} warped (cyan); gray: aligned"
    _image(axes, title, _moved(pair, T_second_first, factor))


def _moved(pair: MatchedPair, T_second_first: Float64, factor: float) -> UInt8:
    frame = pair.first
    v, u = np.nonzero(frame.depth > 0)
    points = back_project(
        frame.camera, np.stack([u, v], axis=1).astype(np.int32), frame.depth[v, u] * np.float32(factor)
    )
    moved = transform(T_second_first, points)
    with np.errstate(all="ignore"):
        at = np.where(moved[:, 2:] > 0, project(pair.second.camera, moved), -1.0)
    where = np.full((*frame.depth.shape, 2), -1.0, np.float32)
    where[v, u] = np.nan_to_num(at, nan=-1.0, posinf=-1.0, neginf=-1.0)
    gray = cv2.cvtColor(pair.second.color, cv2.COLOR_RGB2GRAY)
    other = cv2.remap(gray, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderValue=0.0)
    own = np.where(frame.depth > 0, cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), 0)
    return np.stack([own, other, other], axis=2).astype(np.uint8)


def _readings(axes: Axes, poses: PoseJudgment) -> None:
    """Draw the reprojection error of each pose convention."""
    if poses.best is None or not poses.others:
        _say(axes, f"poses: {poses.findings[0].text}")
        return
    fits = sorted(poses.others, key=lambda fit: fit.error)
    chosen = [fit.reading == poses.best.reading for fit in fits]
    axes.barh(range(len(fits)), [fit.error for fit in fits], color=[CHOSEN if best else OTHER for best in chosen])
    for k, fit in enumerate(fits):
        name = f" {_short(fit.reading)}: {fit.error:.1f}"
        axes.text(0, k, name, fontsize=TEXT_PT - 1, va="center")
    axes.set_yticks([])
    axes.invert_yaxis()
    axes.tick_params(axis="x", labelsize=TEXT_PT)
    axes.set_title("reprojection error of each pose convention, px", fontsize=TITLE_PT)


def _delays(axes: Axes, check: RecordingCheck) -> None:
    """Draw the agreement of depth and color edges for each delay of depth, in frames."""
    if not check.by_delay:
        _say(axes, "too few edges to compare depth and color")
        return
    delays = [agreement.delay for agreement in check.by_delay]
    strengths = [agreement.strength for agreement in check.by_delay]
    best = max(strengths)
    axes.bar(delays, strengths, color=[CHOSEN if strength == best else OTHER for strength in strengths])
    axes.set_xticks(delays)
    axes.tick_params(labelsize=TEXT_PT)
    axes.set_ylim(0, 1.1 * max(best, 1e-3))
    axes.set_title("agreement of depth and color edges,\nby delay of depth in frames", fontsize=TITLE_PT)


def _findings(axes: Axes, check: RecordingCheck) -> None:
    axes.axis("off")
    y = 1.0
    for finding in check.findings:
        lines = textwrap.wrap(str(finding), LINE, subsequent_indent=" " * 7)
        color = COLORS[finding.verdict]
        axes.text(0, y, "\n".join(lines), color=color, fontsize=TEXT_PT, va="top", family="monospace")
        y -= 0.1 * len(lines) + 0.02


def _say(axes: Axes, text: str) -> None:
    axes.axis("off")
    axes.text(0.5, 0.5, "\n".join(textwrap.wrap(text, 44)), ha="center", va="center", fontsize=TITLE_PT)


def _short(reading: PoseReading) -> str:
    parts = [reading.pose_kind.value]
    parts += [reading.camera_axes.name] if reading.camera_axes is not CameraAxes.OPENCV else []
    parts += ["w x y z"] if reading.quaternion_order is not QuaternionOrder.XYZW else []
    return ", ".join(parts) if reading != PoseReading(PoseKind.T_WORLD_CAMERA) else "T_world_camera, OpenCV"
