"""The objects of a map, as rows of a table and as data of the panel next to the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import Float64
from framework.evaluation.instances import Judgement, Outcome
from framework.reporting.pictures import Picture
from framework.reporting.run_contents import RunContents
from framework.runs.instances_file import StoredInstance

LIKELY_CLASSES = 6  # of an object's class distribution, that a page shows


def sides_cm(one: StoredInstance, up: Float64 | None) -> tuple[float, float, float]:
    """The sides of an object's box: the longer and the shorter level one, and its height; without `up`, by length."""
    extent = 100 * one.obb.extent
    if up is None:
        a, b, c = sorted(extent.tolist(), reverse=True)
        return a, b, c
    upright = int(np.abs(one.obb.rotation.T @ up).argmax())
    level = sorted(np.delete(extent, upright).tolist(), reverse=True)
    return level[0], level[1], float(extent[upright])


def size_words(one: StoredInstance, up: Float64 | None) -> str:
    """The sides in cm."""
    return " × ".join(f"{side:.0f}" for side in sides_cm(one, up))


def above_floor(one: StoredInstance, contents: RunContents) -> float | None:
    """How high an object's box ends below, m above the floor; None where that is not known."""
    floor, up = contents.record.metrics.get("map.floor_m"), contents.up
    if not isinstance(floor, float) or up is None:
        return None
    half = float(0.5 * np.abs(one.obb.rotation.T @ up) @ one.obb.extent)
    return float(one.obb.center @ up) - half - floor


def likeliest(one: StoredInstance) -> list[tuple[str, float]]:
    """The classes that a page shows of an object's distribution, the most probable first."""
    return sorted(one.class_probabilities.items(), key=lambda share: (-share[1], share[0]))[:LIKELY_CLASSES]


@dataclass(frozen=True)
class ObjectRow:
    """An object as the table shows it."""

    instance: StoredInstance
    color: str  # #rrggbb
    picture: Picture | None
    size: str
    longest: float  # cm
    position: str
    truth: str  # "" = not compared
    css: str  # class of the outcome
    iou: str


def object_rows(
    contents: RunContents,
    colors: Mapping[int, str],
    pictures: Mapping[int, Picture],
    judgements: Mapping[int, Judgement],
) -> list[ObjectRow]:
    """Return the rows of the table, the most confident object first."""
    rows = []
    for one in sorted(contents.objects, key=lambda one: (-one.confidence, one.id)):
        judgement = judgements.get(one.id)
        rows.append(
            ObjectRow(
                one,
                colors[one.id],
                pictures.get(one.id),
                size_words(one, contents.up),
                max(sides_cm(one, contents.up)),
                _position(one),
                outcome_words(judgement),
                "faint" if judgement is None else judgement.outcome.name.lower().replace("_", "-"),
                f"{judgement.iou:.2f}" if judgement and judgement.iou else "",
            )
        )
    return rows


def object_data(
    one: StoredInstance, contents: RunContents, picture: Picture | None, judgement: Judgement | None
) -> dict[str, Any]:
    """What the panel shows of an object."""
    height = above_floor(one, contents)
    return {
        "id": one.id,
        "class": one.class_name,
        "confidence": one.confidence,
        "probabilities": [[name, round(share, 4)] for name, share in likeliest(one)],
        "size": f"{size_words(one, contents.up)} cm",
        "place": ", ".join(_position(one).split()) + " m",
        "height": None if height is None else f"{max(height, 0.0):.2f} m above the floor",
        "observations": one.observations,
        "frames": f"{one.first_frame} to {one.last_frame}",
        "vertices": one.vertices,
        "source": picture.source if picture else "",
        "truth": outcome_words(judgement) + (f", IoU {judgement.iou:.2f}" if judgement and judgement.iou else ""),
    }


def outcome_words(judgement: Judgement | None) -> str:
    """What became of an object, in a few words."""
    if judgement is None:
        return ""
    if judgement.outcome is Outcome.WRONG_CLASS:
        return f"truth: {judgement.truth_class}"
    return str(judgement.outcome.value)


def _position(one: StoredInstance) -> str:
    return "  ".join(f"{value:.2f}" for value in one.obb.center)
