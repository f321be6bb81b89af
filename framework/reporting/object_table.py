"""Object data for the table and for the panel next to the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Float64
from framework.evaluation.instances import MatchResult, Outcome
from framework.reporting.map_scene import colors_by_id, hex_color
from framework.reporting.pictures import Picture
from framework.reporting.run_contents import RunContents
from framework.reporting.truth_section import css_class
from framework.runs.instances_file import StoredInstance

SHOWN_CLASSES = 6  # maximum number of most probable classes that are shown for an object


@dataclass(frozen=True)
class ObjectRow:
    """One row of the object table."""

    instance: StoredInstance
    color: str  # #rrggbb
    picture: Picture | None  # None = never visible
    size: str  # side lengths of the bounding box, cm
    longest: float  # cm, longest side of the bounding box
    position: str  # center of the bounding box, m, world frame
    truth: str  # result of the comparison with the ground truth, "" = not compared
    css: str  # CSS class of the outcome
    iou: str  # IoU with the ground-truth instance, "" = none


def object_rows(
    contents: RunContents, pictures: Mapping[int, Picture], match_results: Mapping[int, MatchResult]
) -> list[ObjectRow]:
    """Return the rows of the object table, most probable object first.

    Args:
        contents: Outputs of the run.
        pictures: Image of each visible object, by object id.
        match_results: Comparison of each object with the ground truth, by object id; empty = not compared.
    """
    colors = colors_by_id(contents.objects)
    rows = []
    for one in sorted(contents.objects, key=lambda one: (-one.existence, -one.confidence, one.id)):
        match_result = match_results.get(one.id)
        rows.append(
            ObjectRow(
                one,
                hex_color(colors[one.id]),
                pictures.get(one.id),
                _size(one, contents.up),
                100 * float(one.obb.extent.max()),
                _position(one),
                _truth(match_result),
                css_class(match_result.outcome) if match_result else "faint",
                f"{match_result.iou:.2f}" if match_result and match_result.iou else "",
            )
        )
    return rows


def object_data(
    one: StoredInstance, contents: RunContents, color: str, picture: Picture | None, match_result: MatchResult | None
) -> dict[str, Any]:
    """Return the data of an object for the panel next to the map and for the editing mode, as JSON values."""
    imported = contents.record.is_imported  # class distributions and frames are unknown
    known = {} if imported else one.class_probabilities
    likeliest = sorted(known.items(), key=lambda entry: (-entry[1], entry[0]))[:SHOWN_CLASSES]
    height = _height_above_floor(one, contents)
    return {
        "id": one.id,
        "class": one.class_name,
        "confidence": one.confidence,
        "exists": one.existence,
        "calibrated": [] if one.exists is None else _calibrated(one),
        "color": color,
        "probabilities": [[name, round(probability, 4)] for name, probability in likeliest],
        "size": f"{_size(one, contents.up)} cm",
        "place": ", ".join(_position(one).split()) + " m",
        "height": None if height is None else f"{max(height, 0.0):.2f} m above the floor",
        "observations": one.observations,
        "frames": "" if imported else f"{one.first_frame} to {one.last_frame}",
        "vertices": one.vertices,
        "source": picture.source if picture else "",
        "truth": _truth(match_result) + (f", IoU {match_result.iou:.2f}" if match_result and match_result.iou else ""),
    }


def _calibrated(one: StoredInstance) -> list[tuple[str, str]]:
    """Return the names and values of the calibrated numbers of an object that are known, as text."""
    named = {"Exists": one.exists, "Class correct": one.class_probability, "Expected IoU": one.expected_iou}
    return [(name, f"{value:.2f}") for name, value in named.items() if value is not None]


def _size(one: StoredInstance, up: Float64 | None) -> str:
    """Return the side lengths of the box of an object as text, cm.

    The order is length, width and height. Without an up direction, the order is descending.
    """
    sides = np.sort(one.obb.extent)[::-1]
    if up is not None:
        upright = int(np.abs(one.obb.rotation.T @ up).argmax())
        level = np.sort(np.delete(one.obb.extent, upright))[::-1]
        sides = np.array([*level, one.obb.extent[upright]])
    return " × ".join(f"{100 * side:.0f}" for side in sides)


def _height_above_floor(one: StoredInstance, contents: RunContents) -> float | None:
    """Return the height of an object above the floor in m, or None if unknown."""
    floor, up = contents.record.metrics.get("map.floor_m"), contents.up
    if not isinstance(floor, float) or up is None:
        return None
    half = float(0.5 * np.abs(one.obb.rotation.T @ up) @ one.obb.extent)
    return float(one.obb.center @ up) - half - floor


def _truth(match_result: MatchResult | None) -> str:
    if match_result is None:
        return ""
    if match_result.outcome is Outcome.WRONG_CLASS:
        return f"truth: {match_result.truth_class}"
    return str(match_result.outcome.value)


def _position(one: StoredInstance) -> str:
    return "  ".join(f"{value:.2f}" for value in one.obb.center)
