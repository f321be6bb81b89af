"""Report section that compares the objects of a run with the ground truth.

The section contains metrics, and galleries of missed, wrong and correct objects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from framework.data import SceneTruth, UInt8
from framework.evaluation.calibration import Forecasts
from framework.evaluation.instances import (
    MAX_DISTANCE,
    MatchResult,
    Outcome,
    PredictedInstances,
    forecasts,
    judge,
    transfer_labels,
)
from framework.reporting.charts import reliability
from framework.reporting.map_scene import MapScene
from framework.reporting.pictures import Photographer, Picture
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import Footage
from framework.reporting.visibility import sightings
from framework.runs.instances_file import StoredInstance
from framework.runs.metrics import LABEL_SPACE, ignored_names
from framework.runs.reevaluation import classes_of
from framework.runs.stored_runs import is_number

TRUE_COLOR = (255, 196, 0)  # RGB, outline of missed objects
METRICS = {
    "instances.ap50": "AP50",
    "instances.ap25": "AP25",
    "instances.ap": "AP",
    "instances.ap50_agnostic": "AP50, class-agnostic",
    "instances.mean_iou": "Mean IoU",
    "instances.precision50": "Precision",
    "instances.recall50": "Recall",
    "instances.pq50": "PQ",
}
GROUPS = {
    Outcome.WRONG_CLASS: ("Wrong class", "IoU of at least 0.5 with a ground-truth object of another class"),
    Outcome.FALSE: ("False positives", "IoU below 0.5 with every ground-truth object, or duplicate of another object"),
    Outcome.RIGHT: ("Correct", "same class and an IoU of at least 0.5"),
    Outcome.IGNORED: ("Ignored", "in unlabeled regions, or of a class that is not evaluated"),
}


@dataclass(frozen=True)
class Card:
    """One object of a gallery."""

    class_name: str
    confidence: str  # "" = missed ground-truth object
    note: str
    picture: Picture | None
    id: int | None  # id of the object that a click selects, None = none


@dataclass(frozen=True)
class Gallery:
    """The objects with one outcome."""

    css: str
    name: str
    note: str
    cards: list[Card]
    open: bool


@dataclass(frozen=True)
class TruthCheck:
    """The outcomes of all objects, and the missed ground-truth objects."""

    match_results: Mapping[int, MatchResult]  # by object id
    missed: list[Card]
    forecasts: Mapping[str, Forecasts]  # probabilities of the objects, by event

    @classmethod
    def of(
        cls,
        contents: RunContents,
        truth: SceneTruth,
        scene: MapScene | None,
        photographer: Photographer | None,
        footage: Footage,
    ) -> TruthCheck | None:
        """Return the comparison of the objects with the ground truth, or None for a run without a mesh."""
        if contents.mesh is None:
            return None
        objects = contents.objects
        predictions = PredictedInstances.on_mesh(
            contents.mesh,
            [one.id for one in objects],
            [one.confidence for one in objects],
            [one.class_name for one in objects],
            {one.id: one.probabilities for one in objects},
        )
        compared = classes_of(contents.record).compare(predictions, truth)
        judged, missed = judge(compared.predictions, compared.truth)
        pictures: Mapping[int, Picture] = {}
        if scene is not None and photographer is not None and missed:
            points, ids = compared.truth.points_world, compared.truth.instance_ids
            true_ids = transfer_labels(points, ids, scene.mesh.vertices, MAX_DISTANCE)
            labels = np.where(np.isin(true_ids, list(missed)), true_ids, 0).astype(np.int32)
            best = sightings(scene.mesh, labels, contents.viewpoints, footage.camera, footage.clarity).best
            color: UInt8 = np.array(TRUE_COLOR, np.uint8)
            pictures = photographer.pictures(labels, best, dict.fromkeys(best, color))
        cards = []
        for key, name in sorted(missed.items()):
            overlapping = [one for one in judged if one.truth_id == key]
            nearest = max(overlapping, key=lambda one: (one.iou, -one.id), default=None)
            note = "not detected" if nearest is None else f"best overlap: IoU {nearest.iou:.2f}"
            picture = pictures.get(key)
            cards.append(Card(name, "", note if picture else "not mapped", picture, nearest.id if nearest else None))
        return cls({one.id: one for one in judged}, cards, forecasts(compared.predictions, compared.truth))

    def reliability(self) -> str:
        """Return the reliability diagrams as SVG, or "" without evaluated objects."""
        named = {"Exists": self.forecasts["exists"], "Class correct": self.forecasts["class"]}
        known = {name: one for name, one in named.items() if len(one)}
        return reliability(known) if known else ""

    def galleries(self, contents: RunContents, pictures: Mapping[int, Picture]) -> list[Gallery]:
        cards = {outcome: list[Card]() for outcome in GROUPS}
        for one in contents.objects:
            if match_result := self.match_results.get(one.id):
                cards[match_result.outcome].append(_card(one, match_result, pictures.get(one.id)))
        note = "ground-truth objects without a match of their class"
        galleries = [Gallery("missed", "Missed", note, self.missed, bool(self.missed))]
        for outcome, (name, note) in GROUPS.items():
            is_open = outcome in (Outcome.WRONG_CLASS, Outcome.FALSE) and bool(cards[outcome])
            galleries.append(Gallery(css_class(outcome), name, note, cards[outcome], is_open))
        return galleries


def truth_section(
    check: TruthCheck | None, why_unchecked: str, contents: RunContents, pictures: Mapping[int, Picture]
) -> dict[str, Any] | None:
    """Return the variables of the ground-truth section in run.html, or None without ground truth.

    Args:
        check: Comparison of the objects with the ground truth; None = not available.
        why_unchecked: Reason for a missing comparison, "" = the run has no mesh.
        contents: Outputs of the run.
        pictures: Image of each visible object, by object id.
    """
    metrics = contents.record.metrics
    main = [(name, f"{metrics[key]:.2f}") for key, name in METRICS.items() if is_number(metrics.get(key))]
    if not main and check is None:
        return None
    prefix = "instances.true_count."
    classes = []
    for name in (key.removeprefix(prefix) for key in metrics if key.startswith(prefix)):
        scores = [metrics.get(f"instances.{metric}.{name}") for metric in ("ap50", "ap25")]
        classes.append((name, metrics[prefix + name], [score if is_number(score) else None for score in scores]))
    return {
        "metrics": main,
        "classes": classes,
        "label_space": metrics.get(LABEL_SPACE),
        "ignored": ignored_names(metrics),
        "unchecked": "" if check else why_unchecked or "the run has no mesh",
        "reliability": check.reliability() if check else "",
        "galleries": check.galleries(contents, pictures) if check else [],
    }


def css_class(outcome: Outcome) -> str:
    """Return the CSS class of an outcome."""
    return outcome.name.lower().replace("_", "-")


def _card(one: StoredInstance, match_result: MatchResult, picture: Picture | None) -> Card:
    near = match_result.truth_class or "an unlabeled object"
    notes = {
        Outcome.RIGHT: f"IoU {match_result.iou:.2f}",
        Outcome.WRONG_CLASS: f"truth: {near}, IoU {match_result.iou:.2f}",
        Outcome.FALSE: f"best overlap: {near}, IoU {match_result.iou:.2f}" if match_result.iou else "no overlap",
        Outcome.IGNORED: f"on {near}",
    }
    return Card(one.class_name, f"{one.confidence:.2f}", notes[match_result.outcome], picture, one.id)
