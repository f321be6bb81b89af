"""The part of a run's page that compares its objects with the true ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from framework.evaluation.instances import Judgement, Outcome
from framework.reporting.markup import section, table, tag, words
from framework.reporting.object_table import image, meter
from framework.reporting.pictures import Picture
from framework.reporting.run_contents import RunContents
from framework.reporting.truth_check import Missed, TruthCheck
from framework.runs.instances_file import StoredInstance
from framework.runs.stored_runs import is_number

MAIN = {
    "instances.ap50": "AP50",
    "instances.ap25": "AP25",
    "instances.ap": "AP",
    "instances.ap50_agnostic": "AP50, classes ignored",
    "instances.mean_iou": "Mean IoU",
    "instances.precision50": "Precision",
    "instances.recall50": "Recall",
    "instances.pq50": "PQ",
}
GROUPS = {
    Outcome.WRONG_CLASS: ("Wrong class", "they overlap a true object of another class by half or more"),
    Outcome.FALSE: ("False", "they overlap no true object by half, or one that was found already"),
    Outcome.RIGHT: ("Right", "class and at least half of the overlap agree"),
    Outcome.IGNORED: ("Not judged", "where nobody knows the truth, or of a class that nobody looked for"),
}


def truth_section(
    check: TruthCheck | None, why_unchecked: str, contents: RunContents, pictures: Mapping[int, Picture]
) -> str:
    """Figures, classes, and what was missed, wrong and false with pictures; nothing where there never was a truth."""
    metrics = contents.record.metrics
    main = [(name, metrics[key]) for key, name in MAIN.items() if is_number(metrics.get(key))]
    if not main and check is None:
        return ""
    figures = tag(
        "dl",
        *(tag("div", tag("dt", words(name)), tag("dd", f"{value:.2f}"), class_="figure") for name, value in main),
        class_="figures small",
    )
    parts = [figures if main else "", _classes(metrics)]
    if check is None:
        reason = why_unchecked or "the record has no mesh"
        parts.append(tag("p", words(f"The single objects cannot be compared any more: {reason}."), class_="notice"))
    else:
        parts += _galleries(check, contents, pictures)
    return section("truth", "Against the truth", *parts, lead="Matched at an IoU of 0.5, the most confident first.")


def _classes(metrics: Mapping[str, Any]) -> str:
    prefix = "instances.true_count."
    rows = []
    for key, count in metrics.items():
        if not key.startswith(prefix):
            continue
        name = key.removeprefix(prefix)
        cells = [words(name), str(count)]
        for figure in ("ap50", "ap25"):
            value = metrics.get(f"instances.{figure}.{name}")
            cells.append(f"{meter(value)}{value:.2f}" if is_number(value) else "")
        rows.append(cells)
    if not rows:
        return ""
    return table(["Class", "True objects", "AP50", "AP25"], rows, numbers=(1, 2, 3), class_="classes")


def _galleries(check: TruthCheck, contents: RunContents, pictures: Mapping[int, Picture]) -> list[str]:
    by_id = {one.id: one for one in contents.objects}
    cards = {outcome: list[str]() for outcome in GROUPS}
    for key, judgement in check.judgements.items():
        cards[judgement.outcome].append(_card(by_id[key], judgement, pictures.get(key)))
    missed = [_missed_card(one, check) for one in check.missed]
    parts = [_gallery("missed", "Missed", "true objects that nothing of their class was matched with", missed)]
    for outcome, (name, says) in GROUPS.items():
        parts.append(_gallery(outcome.name.lower().replace("_", "-"), name, says, cards[outcome]))
    return parts


def _gallery(css: str, name: str, says: str, cards: list[str]) -> str:
    count = tag("span", str(len(cards)), class_=f"outcome {css}")
    head = tag("summary", tag("b", words(name)), " ", count, " ", tag("span", words(says), class_="faint"))
    body = tag("div", *cards, class_="gallery") if cards else tag("p", "None.", class_="empty")
    return tag("details", head, body, open=css not in ("right", "ignored") and bool(cards))


def _card(one: StoredInstance, judgement: Judgement, picture: Picture | None) -> str:
    near = judgement.truth_class or "something unknown"
    lines = {
        Outcome.RIGHT: f"IoU {judgement.iou:.2f}",
        Outcome.WRONG_CLASS: f"truth: {near}, IoU {judgement.iou:.2f}",
        Outcome.FALSE: f"nearest: {near}, IoU {judgement.iou:.2f}" if judgement.iou else "nothing is there",
        Outcome.IGNORED: f"on {near}",
    }
    title = tag("b", words(one.class_name), tag("span", f" {one.confidence:.2f}", class_="faint"))
    return tag(
        "button",
        image(picture, f"{one.class_name} {one.id}"),
        title,
        tag("span", words(lines[judgement.outcome]), class_="faint"),
        type="button",
        class_="card",
        data_id=one.id,
    )


def _missed_card(one: Missed, check: TruthCheck) -> str:
    near = max(
        (j for j in check.judgements.values() if j.truth_id == one.id), key=lambda j: (j.iou, -j.id), default=None
    )
    said = "nothing was found there" if near is None else f"best overlap: IoU {near.iou:.2f}"
    if one.picture is None:
        said = "nothing was mapped there"
    body = [image(one.picture, f"missed {one.class_name}"), tag("b", words(one.class_name))]
    body.append(tag("span", words(said), class_="faint"))
    if near is None:
        return tag("div", *body, class_="card")
    return tag("button", *body, type="button", class_="card", data_id=near.id)
