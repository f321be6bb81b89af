"""The objects of a map as a table, and as what the panel beside the map shows of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from framework.data import Float64
from framework.evaluation.instances import Judgement, Outcome
from framework.reporting.markup import tag, words
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


def object_table(
    contents: RunContents,
    colors: Mapping[int, str],
    pictures: Mapping[int, Picture],
    judgements: Mapping[int, Judgement] | None,
) -> str:
    """The table, the most confident object first; `page.js` sorts and filters it, and its rows choose objects."""
    heads = [("Object", "text"), ("Confidence", "number"), ("Size, cm", "number"), ("Frames", "number")]
    heads += [("First seen", "number"), ("Position, m", "text")]
    if judgements is not None:
        heads += [("Truth", "text"), ("IoU", "number")]
    buttons = [tag("th", tag("button", words(name), type="button"), scope="col", class_=kind) for name, kind in heads]
    rows = [
        _row(one, contents, colors[one.id], pictures.get(one.id), judgements)
        for one in sorted(contents.objects, key=lambda one: (-one.confidence, one.id))
    ]
    head = tag("thead", tag("tr", tag("th", tag("span", "Picture", class_="unseen"), scope="col"), *buttons))
    return tag("div", tag("table", head, tag("tbody", *rows), id="objects-table", class_="objects"), class_="scroll")


def _row(
    one: StoredInstance,
    contents: RunContents,
    color: str,
    picture: Picture | None,
    judgements: Mapping[int, Judgement] | None,
) -> str:
    sides = sides_cm(one, contents.up)
    cells = [
        tag("td", image(picture, f"{one.class_name} {one.id}"), class_="picture"),
        tag(
            "td",
            swatch(color),
            tag("b", words(one.class_name)),
            tag("span", f" {one.id}", class_="faint"),
            class_="name",
            data_value=f"{one.class_name} {one.id:08d}",
        ),
        tag("td", meter(one.confidence), f"{one.confidence:.2f}", class_="number", data_value=one.confidence),
        tag("td", words(size_words(one, contents.up)), class_="number", data_value=max(sides)),
        tag("td", str(one.observations), class_="number", data_value=one.observations),
        tag("td", str(one.first_frame), class_="number", data_value=one.first_frame),
        tag("td", _position(one), class_="place", data_value=_position(one)),
    ]
    if judgements is not None:
        judgement = judgements.get(one.id)
        said = outcome_words(judgement)
        css = "faint" if judgement is None else judgement.outcome.name.lower().replace("_", "-")
        iou = "" if judgement is None or not judgement.iou else f"{judgement.iou:.2f}"
        cells += [
            tag("td", tag("span", words(said), class_=f"outcome {css}"), data_value=said),
            tag("td", iou, class_="number", data_value=iou or 0),
        ]
    return tag(
        "tr", *cells, tabindex=0, data_id=one.id, data_confidence=one.confidence, data_words=one.class_name.lower()
    )


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


def image(picture: Picture | None, alt: str) -> str:
    """A picture, or an empty place of its size."""
    if picture is None:
        return tag("span", class_="no-picture")
    return tag("img", src=picture.url, alt=alt, width=264, height=198, loading="lazy").removesuffix("</img>")


def swatch(color: str) -> str:
    """A small field of a colour, as SVG: the page's policy allows no style beside the style sheet."""
    return f'<svg class="swatch" viewBox="0 0 1 1" aria-hidden="true"><rect width="1" height="1" fill="{color}"/></svg>'


def meter(share: float) -> str:
    """A bar as long as a share of 1."""
    width = f"{100 * min(max(share, 0.0), 1.0):.1f}"
    return (
        '<svg class="meter" viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="meter-all" width="100" height="10"/><rect class="meter-part" width="{width}" height="10"/></svg>'
    )


def _position(one: StoredInstance) -> str:
    return "  ".join(f"{value:.2f}" for value in one.obb.center)
