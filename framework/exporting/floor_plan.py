"""Floor plans as PNG images and as GeoJSON."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from framework.data import Float64, UInt8
from framework.exporting.occupancy import Plan
from framework.exporting.upright_room import RoomObject, UprightRoom
from framework.files.atomic_write import atomic_write
from framework.files.json_file import write_json
from framework.rendering.palette import FAINT_INK, INK, PAPER

UNSEEN, FLOOR, FREE, OCCUPIED, WALL = (214, 216, 218), (240, 232, 206), PAPER, (150, 154, 160), INK
TONES = {
    "wall": WALL,
    "occupied": OCCUPIED,
    "free": FREE,
    "floor, space above partly unobserved": FLOOR,
    "unobserved": UNSEEN,
}
DPI = 150
TINT = 0.6  # fraction of the object's color in its cells
DARKER = 0.65  # brightness factor of outlines
LONGER_SIDE, SHORTEST_SIDE = 9.0, 4.5  # inches, longer side and minimum width of the plan
FOOT = 0.72  # height of the legend, inches
EDGE = 0.15  # margin of the page, inches
TEXT_PT, SMALL_PT = 8.0, 7.0
BARS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)  # possible lengths of the scale bar, m
MAX_BAR_FRACTION = 0.25  # maximum length of the scale bar, as a fraction of the plan's width
MOVES = ((0, 0), (0, 1), (0, -1), (0, 2), (0, -2), (0.6, 1), (-0.6, 1), (0.6, -1), (-0.6, -1))
"""Candidate offsets of a name in x and y, as multiples of its width and height."""
COORDINATES = "x, y in meters in the room frame (z up, floor at z = 0), not longitude and latitude"
DIGITS = 4  # decimal places of lengths in m


def write_floor_plan(path: Path, room: UprightRoom, plan: Plan, robot_height: float) -> None:
    """Draw a floor plan and save it as a PNG file.

    `robot_height` (m) is only shown in the legend. The file is deterministic.
    """
    with warnings.catch_warnings(), atomic_write(path) as temporary:
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)  # drawn as boxes
        _drawn(room, plan, robot_height).savefig(temporary, dpi=DPI)


def tones(plan: Plan) -> UInt8:
    """Return the RGB color (H, W, 3) of each cell. Row 0 has the lowest y."""
    image = np.tile(np.array(UNSEEN, np.uint8), (*plan.shape, 1))
    for chosen, tone in ((plan.floor, FLOOR), (plan.free, FREE), (plan.occupied, OCCUPIED), (plan.wall, WALL)):
        image[chosen] = tone
    return image


def _drawn(room: UprightRoom, plan: Plan, robot_height: float) -> Figure:
    left, right, bottom, top = plan.extent
    scale = LONGER_SIDE / max(right - left, top - bottom)
    width, height = max((right - left) * scale, SHORTEST_SIDE), max((top - bottom) * scale, SHORTEST_SIDE / 2)
    page = width + 2 * EDGE, height + FOOT + EDGE
    figure = Figure(page, facecolor=_unit_rgb(PAPER))
    FigureCanvasAgg(figure)
    frame = EDGE / page[0], FOOT / page[1], width / page[0], height / page[1]
    axes = figure.add_axes(frame, facecolor=_unit_rgb(UNSEEN), xticks=[], yticks=[])
    axes.set_aspect("equal", adjustable="datalim")
    axes.spines[:].set_visible(False)
    image = tones(plan)
    for one in room.objects:
        image[plan.highest == one.id] = (1 - TINT) * np.array(PAPER) + TINT * one.color
    axes.imshow(image, origin="lower", extent=plan.extent, interpolation="nearest")
    _draw_outlines(axes, room)
    _draw_names(axes, room.objects)
    _draw_bar(axes)
    _draw_foot(figure, page, plan, robot_height)
    return figure


def _draw_outlines(axes: Axes, room: UprightRoom) -> None:
    """Draw the outlines of the objects, the highest object last."""
    for one in sorted(room.objects, key=lambda one: (one.top, one.id)):
        dark = _unit_rgb([round(DARKER * channel) for channel in one.color.tolist()])
        axes.add_patch(Polygon(outline(room, one), fill=False, edgecolor=dark, linewidth=1.0, joinstyle="round"))


def _draw_names(axes: Axes, objects: Sequence[RoomObject]) -> None:
    """Write the class and id at each object, large objects first."""
    figure = axes.figure
    assert isinstance(figure, Figure)
    renderer = FigureCanvasAgg(figure).get_renderer()
    taken: list[Bbox] = []
    inside = axes.get_window_extent(renderer)
    for one in sorted(objects, key=lambda one: (-float(np.prod(one.box.extent[:2])), one.id)):
        words = (f"{one.class_name} {one.id}", str(one.id))  # only the id if the class does not fit
        for text, moves in zip(words, (MOVES, ((0, 0), *MOVES[1:5])), strict=True):
            center_x, center_y, _ = one.box.center.tolist()
            label = axes.text(
                center_x,
                center_y,
                text.replace("$", r"\$"),
                fontsize=TEXT_PT,
                color=_unit_rgb(INK),
                ha="center",
                va="center",
                path_effects=[withStroke(linewidth=2.2, foreground=_unit_rgb(PAPER))],
            )
            box = label.get_window_extent(renderer)
            shifts = [(x * box.width, y * box.height) for x, y in moves]
            free = next((shift for shift in shifts if _fits(box.translated(*shift), taken, inside)), None)
            if free is not None:
                place = axes.transData.transform(one.box.center[:2]) + free
                x, y = axes.transData.inverted().transform(place).tolist()
                label.set_position((x, y))
                taken.append(box.translated(*free))
                break
            label.remove()


def _fits(box: Bbox, taken: Sequence[Bbox], inside: Bbox) -> bool:
    if box.x0 < inside.x0 or box.x1 > inside.x1 or box.y0 < inside.y0 or box.y1 > inside.y1:
        return False
    return not any(box.overlaps(other) for other in taken)


def _draw_bar(axes: Axes) -> None:
    """Draw a scale bar in the lower left corner."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    length = max([bar for bar in BARS if bar <= MAX_BAR_FRACTION * (right - left)], default=BARS[0])
    unit = 0.012 * (right - left)
    x, y = left + 2 * unit, bottom + 2.2 * unit
    patch = (left + unit, bottom + unit), length + 2 * unit, 4.2 * unit
    axes.add_patch(Rectangle(*patch, color=_unit_rgb(PAPER), zorder=4, alpha=0.85))
    axes.add_patch(Rectangle((x, y), length, 0.6 * unit, color=_unit_rgb(INK), zorder=5))
    axes.text(x + length / 2, y + unit, f"{length:g} m", fontsize=SMALL_PT, ha="center", va="bottom", zorder=5)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def _draw_foot(figure: Figure, page: tuple[float, float], plan: Plan, robot_height: float) -> None:
    edge = _unit_rgb(FAINT_INK)
    patches = [
        Patch(facecolor=_unit_rgb(tone), edgecolor=edge, linewidth=0.4, label=name) for name, tone in TONES.items()
    ]
    figure.legend(
        handles=patches,
        loc="upper left",
        bbox_to_anchor=(EDGE / page[0], (FOOT - 0.06) / page[1]),
        ncols=3,
        frameon=False,
        fontsize=SMALL_PT,
        borderaxespad=0,
        handlelength=1.4,
        columnspacing=1.6,
    )
    note = f"cell size {plan.resolution:g} m; free: for a robot height of {robot_height:g} m"
    figure.text(EDGE / page[0], 0.1 / page[1], note, fontsize=SMALL_PT, color=edge, va="bottom")


def _unit_rgb(color: Sequence[int]) -> tuple[float, float, float]:
    """Convert an 8-bit RGB color to the range [0, 1] of matplotlib."""
    red, green, blue = (channel / 255 for channel in color)
    return red, green, blue


def write_geojson(path: Path, room: UprightRoom) -> None:
    """Write the outline of each object as a counterclockwise GeoJSON polygon.

    The coordinates are in meters, as stated in the file. GeoJSON readers may expect longitude and latitude (RFC 7946).
    """
    write_json(
        path,
        {
            "type": "FeatureCollection",
            "coordinates_are": COORDINATES,
            "T_room_world": room.T_room_world.tolist(),
            **({"map_origin": list(room.origin)} if room.origin else {}),
            "features": [_feature(room, one) for one in room.objects],
        },
    )


def outline(room: UprightRoom, one: RoomObject) -> Float64:
    """Return the counterclockwise outline (N, 2) of an object in top view, m.

    The outline is the convex hull of the vertices. If the hull has no area, it is the footprint of the box.
    """
    points = room.mesh.vertices[one.vertices, :2]
    hull = cv2.convexHull(np.ascontiguousarray(points), clockwise=False)[:, 0].astype(np.float64)
    return hull if len(hull) >= 3 else one.footprint


def _feature(room: UprightRoom, one: RoomObject) -> dict[str, Any]:
    ring = np.round(outline(room, one), DIGITS).tolist()
    return {
        "type": "Feature",
        "id": one.id,
        "properties": {
            "name": one.name,
            "class": one.class_name,
            "probability": one.probability,
            "confidence": one.confidence,
            "exists": one.existence,
            "base": round(one.base, DIGITS),
            "top": round(one.top, DIGITS),
            "box": np.round(one.footprint, DIGITS).tolist(),
        },
        "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
    }
