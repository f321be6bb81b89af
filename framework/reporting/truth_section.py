"""The section of a run's page that compares its objects with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from framework.evaluation.instances import Judgement, Outcome
from framework.reporting.pictures import Picture
from framework.reporting.run_contents import RunContents
from framework.reporting.truth_check import Missed, TruthCheck
from framework.runs.instances_file import StoredInstance
from framework.runs.stored_runs import is_number

MAIN = {
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
    Outcome.WRONG_CLASS: ("Wrong class", "IoU of at least 0.5 with a true object of another class"),
    Outcome.FALSE: ("False positives", "IoU below 0.5 with every true object, or a duplicate"),
    Outcome.RIGHT: ("Correct", "same class and an IoU of at least 0.5"),
    Outcome.IGNORED: ("Ignored", "in unlabeled regions, or of a class that is not evaluated"),
}


@dataclass(frozen=True)
class Card:
    """One picture of a gallery."""

    class_name: str
    confidence: str
    note: str
    picture: Picture | None
    id: int | None  # of the object that a click selects


@dataclass(frozen=True)
class Gallery:
    """The objects with one outcome."""

    css: str
    name: str
    note: str
    cards: list[Card]
    open: bool


@dataclass(frozen=True)
class TruthSection:
    """The metrics, and the galleries of missed, wrong and correct objects."""

    metrics: list[tuple[str, str]]
    classes: list[tuple[str, object, list[float | None]]]  # name, count of true objects, AP50 and AP25
    unchecked: str  # the reason for missing galleries
    galleries: list[Gallery]

    @classmethod
    def of(
        cls, check: TruthCheck | None, why_unchecked: str, contents: RunContents, pictures: Mapping[int, Picture]
    ) -> TruthSection | None:
        """Return None for a run without ground truth."""
        metrics = contents.record.metrics
        main = [(name, f"{metrics[key]:.2f}") for key, name in MAIN.items() if is_number(metrics.get(key))]
        if check is None:
            reason = why_unchecked or "the run has no mesh"
            return cls(main, _classes(metrics), reason, []) if main else None
        return cls(main, _classes(metrics), "", _galleries(check, contents, pictures))


def _classes(metrics: Mapping[str, Any]) -> list[tuple[str, object, list[float | None]]]:
    prefix = "instances.true_count."
    rows = []
    for key in metrics:
        if key.startswith(prefix):
            name = key.removeprefix(prefix)
            values = [metrics.get(f"instances.{figure}.{name}") for figure in ("ap50", "ap25")]
            rows.append((name, metrics[key], [value if is_number(value) else None for value in values]))
    return rows


def _galleries(check: TruthCheck, contents: RunContents, pictures: Mapping[int, Picture]) -> list[Gallery]:
    by_id = {one.id: one for one in contents.objects}
    cards = {outcome: list[Card]() for outcome in GROUPS}
    for key, judgement in check.judgements.items():
        cards[judgement.outcome].append(_card(by_id[key], judgement, pictures.get(key)))
    missed = [_missed_card(one, check) for one in check.missed]
    galleries = [Gallery("missed", "Missed", "true objects without a match of their class", missed, bool(missed))]
    for outcome, (name, note) in GROUPS.items():
        open_first = outcome in (Outcome.WRONG_CLASS, Outcome.FALSE) and bool(cards[outcome])
        css = outcome.name.lower().replace("_", "-")
        galleries.append(Gallery(css, name, note, cards[outcome], open_first))
    return galleries


def _card(one: StoredInstance, judgement: Judgement, picture: Picture | None) -> Card:
    near = judgement.truth_class or "an unlabeled object"
    notes = {
        Outcome.RIGHT: f"IoU {judgement.iou:.2f}",
        Outcome.WRONG_CLASS: f"truth: {near}, IoU {judgement.iou:.2f}",
        Outcome.FALSE: f"nearest: {near}, IoU {judgement.iou:.2f}" if judgement.iou else "no overlap",
        Outcome.IGNORED: f"on {near}",
    }
    return Card(one.class_name, f"{one.confidence:.2f}", notes[judgement.outcome], picture, one.id)


def _missed_card(one: Missed, check: TruthCheck) -> Card:
    near = max(
        (j for j in check.judgements.values() if j.truth_id == one.id), key=lambda j: (j.iou, -j.id), default=None
    )
    note = "not detected" if near is None else f"best overlap: IoU {near.iou:.2f}"
    return Card(
        one.class_name, "", "not mapped" if one.picture is None else note, one.picture, near.id if near else None
    )
