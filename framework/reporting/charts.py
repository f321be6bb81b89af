"""Charts of a report.

The charts are matplotlib figures, converted to SVG elements. They use the light or dark colors of the page.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from io import StringIO
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.spatial import ConvexHull, QhullError

from framework.data import Box, Float64
from framework.evaluation.calibration import Forecasts
from framework.explanation.contributions import Contributions
from framework.figures.contribution_figure import draw_bars
from framework.figures.stage_times import WINDOW, running_median
from framework.runs.timings_file import StageTimes
from framework.runtime.run_log import STAGE_ORDER
from framework.sensors.depth_distortion import DepthDistortion

WIDTH, HEIGHT, FLAT_HEIGHT, TIMES_HEIGHT, GROWTH_HEIGHT = 560.0, 380.0, 180.0, 240.0, 390.0  # px
RELIABILITY_HEIGHT = 260.0  # px
BAR_HEIGHT = 80.0  # px, height of the contributions to the loss
DEPTH_HEIGHT, SCALE_PX, IMAGE_STEP = 200.0, 16.0, 4  # px: height of a depth image, its color scale, and pixel step
LEFT, RIGHT, TOP, BOTTOM = 46.0, 12.0, 24.0, 40.0  # px, margins around the axes
TEXT_PX, DOT_PX = 12.0, 10.0  # font size, and diameter of the dots at the ends of a path
FOOT = 36.0  # px, height below a top view for the scale bar
MARGIN = 0.08  # margin on each side of a top view, relative to its content
MIN_EXTENT_M = 0.04  # minimum height of the area that a top view shows, m
LABEL_WIDTH_PX = 46.0  # minimum width of a footprint with a label
MAX_POINTS = 240  # maximum number of frames in the chart of stage times
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])  # of the unit cube
COLORS = {
    "card": "#ffffff",
    "line": "#e3e5e8",
    "ink": "#20242a",
    "faint": "#6b727b",
    "accent": "#2f5bea",
    "truth": "#8a9099",
    "bad": "#c93a32",
    "reading": "#9aa5b1",
    "detection": "#0072b2",
    "tracking": "#009e73",
    "lifting": "#8c6bb1",
    "refinement": "#d55e00",
    "association": "#c2609a",
    "update": "#4ba3c7",
    "integration": "#b5830a",
    "fusion": "#7d6608",
    "backend": "#8b5e3c",
    "run-3": "#a2459e",
    "run-4": "#8a6d00",
    "run-5": "#5b6570",
}
"""Colors of report.css in light mode, by variable name. In the SVG, the CSS variables replace the colors."""
RUN_COLORS = ("accent", "refinement", "tracking", "run-3", "run-4", "run-5")
RUN_WIDTHS = (6.0, 4.5, 3.0, 2.2, 1.6, 1.2)  # px, decreasing so that coinciding paths remain visible
VARIABLES = {color: f"var(--{name})" for name, color in COLORS.items()}


@dataclass(frozen=True)
class Footprint:
    """The outline of an object in the top view."""

    corners_world: Float64  # (8, 3) m, corners of the bounding box
    name: str
    color: str  # #rrggbb


@dataclass(frozen=True)
class PlottedPath:
    """The path of one camera."""

    positions: Float64  # (P, 3) m, in the world frame
    lost_after: Sequence[int] = ()  # indices of the last positions before tracking was lost
    color: str = "accent"  # key of COLORS
    width: float = 2.0  # px


@dataclass(frozen=True)
class PlottedGraph:
    """The anchors and loops of a pose graph."""

    anchors: Float64  # (A, 3) m, positions in the world frame
    loops: Sequence[tuple[int, int]]  # pairs of anchors


@dataclass(frozen=True)
class StageRow:
    """Percentiles of the run time of one stage, ms."""

    stage: str
    lowest: float  # 5th percentile
    median: float
    p95: float  # 95th percentile


def box_corners(box: Box) -> Float64:
    """Return the corners (8, 3) of a box, m, in the world frame."""
    return np.asarray(box.center + (CORNERS * box.extent) @ box.rotation.T)


def stage_rows(times: StageTimes) -> list[StageRow]:
    """Return the percentiles of each stage that ran, in pipeline order."""
    rows = []
    for stage in STAGE_ORDER:
        values = times.milliseconds.get(stage, np.zeros(0))
        if np.isfinite(values).any():
            rows.append(StageRow(stage, *np.nanpercentile(values, [5, 50, 95]).tolist()))
    return rows


def top_view(
    paths: Sequence[PlottedPath],
    true_paths: Sequence[Float64],
    objects: Sequence[Footprint],
    up: Float64,
    height: float = HEIGHT,
    graph: PlottedGraph | None = None,
) -> tuple[str, float]:
    """Draw camera paths and objects in top view.

    Args:
        paths: Estimated paths, at least one.
        true_paths: Positions (n, 3) of each ground-truth path, m. They are drawn as dashed lines.
        objects: Objects to draw as filled outlines.
        up: Up direction (3,) in the world frame, a unit vector.
        height: Height of the chart, px.
        graph: Pose graph to draw on the paths; None = none.

    Returns:
        The SVG element, and the longer side of the area covered by the paths, relative to the width of the chart.
    """
    plot_height = height - FOOT
    plane = _horizontal(paths[0].positions, up)
    shown = np.concatenate([path.positions for path in paths] + list(true_paths)) @ plane.T
    low, high = shown.min(axis=0), shown.max(axis=0)
    path_size = float((high - low).max())
    if objects:
        corners = np.concatenate([one.corners_world for one in objects]) @ plane.T
        low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    size = (high - low) * (1 + 2 * MARGIN)
    px = max(size[0] / WIDTH, max(size[1], MIN_EXTENT_M) / plot_height)  # m per px
    left, bottom = (low + high) / 2 - px * np.array([WIDTH, plot_height]) / 2

    figure = Figure((WIDTH / 72, height / 72), dpi=72, facecolor="none")
    limits: dict[str, Any] = {"xlim": (left, left + px * WIDTH), "ylim": (bottom, bottom + px * plot_height)}
    axes = figure.add_axes((0, FOOT / height, 1, plot_height / height), **limits)
    axes.axis("off")
    titles = {}
    for k, one in enumerate(objects):
        if _draw_footprint(axes, one, one.corners_world @ plane.T, px, f"chart-object-{k}"):
            titles[f"chart-object-{k}"] = one.name
    for positions in true_paths:
        line = (positions @ plane.T).T
        axes.plot(*line, color=COLORS["truth"], linewidth=2, dashes=(2.5, 2.5), gid="chart-true")
    for path in paths:
        points, color = path.positions @ plane.T, COLORS[path.color]
        axes.plot(*points.T, color=color, linewidth=path.width, gid="chart-path", solid_capstyle="round")
        lost = points[list(path.lost_after)]
        axes.plot(*lost.T, "o", color=COLORS["bad"], markersize=8, gid="chart-lost")
        for point, fill in ((points[0], COLORS["card"]), (points[-1], color)):
            axes.plot(*point, "o", color=fill, markersize=DOT_PX, markeredgecolor=color, markeredgewidth=2.5)
    if graph is not None:
        anchors = graph.anchors @ plane.T
        for pair in dict.fromkeys(graph.loops):
            axes.plot(*anchors[list(pair)].T, color=COLORS["refinement"], linewidth=3, gid="chart-loop")
        style: dict[str, Any] = {"color": COLORS["ink"], "markeredgecolor": COLORS["card"], "markeredgewidth": 1.5}
        axes.plot(*anchors.T, "s", markersize=DOT_PX, gid="chart-anchors", **style)
    length = round_length(0.12 * WIDTH * px)
    label = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
    x, y = left + 16 * px, bottom - 28 * px
    axes.plot([x, x + length], [y, y], color=COLORS["ink"], linewidth=2, clip_on=False)
    axes.text(x, y + 8 * px, label, color=COLORS["faint"], fontsize=TEXT_PX)
    return _svg(figure, "Camera path, top view", titles), path_size / (px * WIDTH)


def position_errors(frames: Sequence[int], errors: Float64, height: float = FLAT_HEIGHT) -> str:
    """Draw a line chart of the position error by frame, and return its SVG element.

    Args:
        frames: Frame numbers (n,).
        errors: Position errors (n,), m.
        height: Height of the chart, px.
    """
    return _distances(frames, errors, height, "Position error", "chart-errors")


def motions(frames: Sequence[int], distances: Float64) -> str:
    """Draw a line chart of the correction of the camera position by frame, and return its SVG element.

    Args:
        frames: Frame numbers (n,).
        distances: Distances (n,) between the tracked and the corrected positions, m.
    """
    return _distances(frames, distances, FLAT_HEIGHT, "Correction of the position", "chart-motions")


def depth_corrections(distortion: DepthDistortion, depth: float) -> str:
    """Draw the correction of a depth, m, as an image with a color scale in mm, and return its SVG element."""
    mm_per_correction = 1e3 * depth**2
    largest = max(mm_per_correction * float(np.abs(distortion.nodes).max()), 0.1)
    rows, columns = distortion.shape
    width = min((DEPTH_HEIGHT - 2 * SCALE_PX) * columns / rows, WIDTH - 6 * SCALE_PX)
    figure = Figure((WIDTH / 72, DEPTH_HEIGHT / 72), dpi=72, facecolor="none")
    bottom, tall = SCALE_PX / DEPTH_HEIGHT, 1 - 2 * SCALE_PX / DEPTH_HEIGHT
    shown: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest, "aspect": "auto"}
    axes = figure.add_axes((0, bottom, width / WIDTH, tall))
    axes.imshow(mm_per_correction * distortion.corrections[::IMAGE_STEP, ::IMAGE_STEP], gid="chart-depth", **shown)
    axes.axis("off")
    scale = figure.add_axes(((width + SCALE_PX) / WIDTH, bottom, SCALE_PX / WIDTH, tall))
    steps = np.linspace(-largest, largest, 100)[:, None]
    scale.imshow(steps, origin="lower", extent=(0, 1, -largest, largest), **shown)
    scale.yaxis.tick_right()
    scale.set_xticks([])
    ticks = [-largest, 0, largest]
    scale.set_yticks(ticks, [f"{tick:+.1f} mm" if tick else "0" for tick in ticks])
    scale.tick_params(length=0, labelsize=TEXT_PX, labelcolor=COLORS["faint"])
    for one in (axes, scale):
        one.spines[:].set_visible(False)
    return _svg(figure, f"Correction of depth at {depth:g} m")


def stage_areas(times: StageTimes) -> str:
    """Draw a stacked area chart of the stage times by frame, and return its SVG element.

    The areas show running medians over WINDOW frames, ms.
    """
    chosen = np.unique(np.linspace(0, len(times.frames) - 1, MAX_POINTS).astype(int))
    stages = [row.stage for row in stage_rows(times)]
    layers = [np.nan_to_num(running_median(times.milliseconds[stage], WINDOW))[chosen] for stage in stages]
    figure, axes = _chart(TIMES_HEIGHT, times.frames[0], times.frames[-1], "Stacked stage times, ms")
    if layers:
        areas = axes.stackplot(times.frames[chosen], layers, colors=[COLORS[stage] for stage in stages])
        for stage, area in zip(stages, areas, strict=True):
            area.set_gid(f"chart-stage-{stage}")
        axes.set_ylim(0, max(float(np.percentile(np.sum(layers, axis=0), 98)) * 1.2, 1e-3))
    return _svg(figure, "Stage times by frame")


def contribution_bar(contributions: Contributions) -> str:
    """Draw the contributions to the loss as a stacked bar, and return its SVG element."""
    figure = Figure((WIDTH / 72, BAR_HEIGHT / 72), dpi=72, facecolor="none")
    axes = figure.add_axes((0.02, 0.45, 0.96, 0.5), facecolor="none")
    draw_bars(axes, {"": contributions}, [0.0], 1.0)
    axes.spines[:].set_visible(False)
    axes.set_yticks([])
    axes.tick_params(length=0, labelsize=TEXT_PX, labelcolor=COLORS["faint"])
    axes.set_xlabel(f"loss (1 - {contributions.metric})", loc="right", fontsize=TEXT_PX, color=COLORS["faint"])
    return _svg(figure, "Contributions to the loss")


def growth(frames: Sequence[int], fraction: Float64, first_frames: Sequence[int], last_frame: int) -> str:
    """Draw the visible surface and the number of detected objects by frame, and return the SVG element.

    Args:
        frames: Frame numbers (n,).
        fraction: Fraction (n,) of the visible surface that was seen up to each frame, in [0, 1].
        first_frames: Number of the frame in which each object was first detected.
        last_frame: Number of the last frame of the sequence.
    """
    first, last = min([0, *frames]), max(last_frame, 1)
    figure, axes = _chart(GROWTH_HEIGHT, first, last, "", LEFT)
    axes.fill_between(frames, 100 * fraction, color=COLORS["truth"], alpha=0.16, linewidth=0)
    axes.plot(frames, 100 * fraction, color=COLORS["truth"], linewidth=2, gid="chart-seen")
    axes.set_ylim(0, 100)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}%"))
    counts = axes.twinx()
    counts.spines[:].set_visible(False)
    ordered = sorted(first_frames)
    steps = [first, *ordered, last], [0, *range(1, len(ordered) + 1), len(ordered)]
    counts.step(*steps, where="post", color=COLORS["accent"], linewidth=2, gid="chart-objects")
    counts.set_ylim(0, max(1, len(ordered)))
    counts.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    counts.tick_params(length=0, labelsize=TEXT_PX, labelcolor=COLORS["accent"])
    return _svg(figure, "Visible surface and detected objects by frame")


def reliability(forecasts: Mapping[str, Forecasts]) -> str:
    """Draw a reliability diagram for each event, by title, and return the SVG element."""
    return _svg(reliability_figure(forecasts), "Reliability of the probabilities")


def reliability_figure(forecasts: Mapping[str, Forecasts], background: str = "none") -> Figure:
    """Return a figure with a reliability diagram for each event, by title.

    Each dot is a bin with its number of instances. Dots on the diagonal are calibrated.
    """
    figure = Figure((WIDTH / 72, RELIABILITY_HEIGHT / 72), dpi=72, facecolor=background)
    inner = WIDTH / len(forecasts) - LEFT - RIGHT
    for k, (title, one) in enumerate(forecasts.items()):
        left = k * (inner + LEFT + RIGHT) + LEFT
        tall = RELIABILITY_HEIGHT - TOP - BOTTOM
        bounds = left / WIDTH, BOTTOM / RELIABILITY_HEIGHT, inner / WIDTH, tall / RELIABILITY_HEIGHT
        axes = figure.add_axes(bounds, facecolor="none")
        axes.plot([0, 1], [0, 1], color=COLORS["faint"], linewidth=1, gid=f"chart-ideal-{k}")
        for one_bin in one.reliability():
            point = one_bin.mean_probability, one_bin.frequency
            size = DOT_PX**2 * (1 + 9 * one_bin.count / len(one))
            axes.scatter(*point, s=size, color=COLORS["accent"], alpha=0.4, linewidth=0, zorder=3)
            axes.annotate(
                str(one_bin.count), point, color=COLORS["ink"], fontsize=TEXT_PX, ha="center", va="center", zorder=4
            )
        axes.set(xlim=(-0.08, 1.08), ylim=(-0.08, 1.08), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(COLORS["line"])
        axes.tick_params(length=0, labelsize=TEXT_PX, labelcolor=COLORS["faint"])
        axes.set_xlabel("x: predicted, y: observed fraction", loc="right", fontsize=TEXT_PX, color=COLORS["faint"])
        heading = f"{title}: n = {len(one)}, ECE {one.ece():.2f}"
        axes.set_title(heading, loc="left", fontsize=TEXT_PX, color=COLORS["faint"])
    return figure


def round_length(longest: float) -> float:
    """Return the largest length, at most `longest`, that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(longest, 1e-9)))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= longest * (1 + 1e-9) or factor == 1))


def _chart(height: float, first: float, last: float, title: str, right: float = RIGHT) -> tuple[Figure, Axes]:
    """Return a figure and its empty axes, with frame numbers on the x axis. Lengths are in px."""
    figure = Figure((WIDTH / 72, height / 72), dpi=72, facecolor="none")
    inner = 1 - (LEFT + right) / WIDTH, 1 - (TOP + BOTTOM) / height
    axes = figure.add_axes((LEFT / WIDTH, BOTTOM / height, *inner), facecolor="none")
    axes.set_xlim(first, max(last, first + 1))
    axes.spines[["top", "left", "right"]].set_visible(False)
    axes.spines["bottom"].set_color(COLORS["faint"])
    axes.grid(axis="y", color=COLORS["line"], linewidth=1)
    axes.tick_params(length=0, labelsize=TEXT_PX, labelcolor=COLORS["faint"])
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    axes.set_xlabel("frame", loc="right", fontsize=TEXT_PX, color=COLORS["faint"])
    axes.set_title(title, loc="left", fontsize=TEXT_PX, color=COLORS["faint"])
    return figure, axes


def _distances(frames: Sequence[int], distances: Float64, height: float, name: str, gid: str) -> str:
    """Draw a line chart of distances (n,), m, by frame, and return its SVG element."""
    figure, axes = _chart(height, frames[0], frames[-1], f"{name}, mm")
    axes.plot(frames, 1e3 * distances, color=COLORS["accent"], linewidth=2, gid=gid)
    axes.set_ylim(0, max(1.08e3 * float(distances.max(initial=0.0)), 1e-3))
    return _svg(figure, f"{name} by frame")


def _horizontal(positions: Float64, up: Float64) -> Float64:
    """Return the right and up axes (2, 3) of the top view, unit vectors in the world frame.

    The right axis is the horizontal direction with the largest variance of the positions (P, 3). `up` (3,) is the up
    direction, a unit vector.
    """
    any_level = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    level = np.stack([any_level, np.cross(up, any_level)]) / np.linalg.norm(any_level)
    _, _, Vt = np.linalg.svd((positions - positions.mean(axis=0)) @ level.T, full_matrices=True)
    right = Vt[0] * (np.sign(Vt[0][np.abs(Vt[0]).argmax()]) or 1.0)
    return np.asarray(np.stack([right, [-right[1], right[0]]]) @ level)


def _draw_footprint(axes: Axes, one: Footprint, corners: Float64, px: float, gid: str) -> bool:
    """Draw an object in the top view. Return False if its outline has no area.

    Args:
        axes: Axes of the top view.
        one: Object.
        corners: Corners (8, 2) of the object in the axes of the top view, m.
        px: Size of a pixel, m.
        gid: Id of the outline in the SVG.
    """
    try:
        outline = corners[ConvexHull(corners).vertices]
    except QhullError:  # the object is a line in the top view
        return False
    axes.fill(*outline.T, facecolor=(one.color, 0.22), edgecolor=(one.color, 0.7), linewidth=1, gid=gid)
    if np.ptp(outline[:, 0]) > LABEL_WIDTH_PX * px:
        name = one.name.encode("utf-8", "backslashreplace").decode()
        x, y = outline.mean(axis=0).tolist()
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": COLORS["faint"], "fontsize": TEXT_PX}
        axes.text(x, y, name, **style, parse_math=False)
    return True


def _svg(figure: Figure, label: str, titles: Mapping[str, str] | None = None) -> str:
    """Convert a figure to an `<svg>` element without inline styles.

    The content security policy of the page forbids inline styles.

    Args:
        figure: Figure to convert.
        label: Accessible name of the chart.
        titles: Tooltip by element id.
    """
    file = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "instancemap"}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # the browser draws glyphs that are missing in matplotlib's font
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", file.getvalue(), flags=re.DOTALL)
    text = re.sub(r' style="([^"]*)"', _attributes, text[text.index("<svg") :])
    for gid, title in (titles or {}).items():
        text = text.replace(f'<g id="{gid}">', f'<g id="{gid}"><title>{escape(title)}</title>')
    size = f'viewBox="0 0 {figure.get_figwidth() * 72:g} {figure.get_figheight() * 72:g}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" {size} role="img"'
    head += f' aria-label="{escape(label)}" stroke-linejoin="round">'
    return re.sub(r"^<svg[^>]*>", lambda _: head, text)


def _attributes(style: re.Match[str]) -> str:
    """Convert a matched `style` attribute to SVG attributes, without fonts.

    Colors in COLORS are replaced by the CSS variables of the page.
    """
    pairs = [item.split(":", 1) for item in style[1].split(";") if ":" in item]
    kept = [(key.strip(), value.strip()) for key, value in pairs if not key.strip().startswith("font")]
    return "".join(f' {key}="{VARIABLES.get(value, value)}"' for key, value in kept)
