"""Causes of lost objects and of false instances.

For each true object, the part that is left after each stage is estimated from its clusters in all frames in which it is
detected: its coverage by masks, and the IoU after refinement. Fusion outvotes errors in few frames, so medians over
frames are used. The cause of a lost object is the first stage, in the order of the pipeline, after which this value is
below the IoU threshold of the evaluation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from framework.data import Float64, Int32
from framework.evaluation.compared_classes import Compared
from framework.evaluation.instances import MAX_DISTANCE, MIN_POINTS, Outcome, evaluate, judge, transfer_labels
from framework.explanation.object_views import MIN_PIXELS, InstancePoints, ObjectViews, instance_points
from framework.explanation.observation import FrameObservation

MIN_IOU = 0.5  # IoU threshold of the evaluation
MIN_DETECTION_RATE = 0.1  # minimum fraction of the frames with an object in which it is detected
MIN_FOREIGN = 0.1  # minimum fraction of the points of an instance on an object that can determine its class
SPLIT_FRACTION = 0.25  # minimum fraction of the points of an object that each part of a split object has


class State(Enum):
    """The result of a true object."""

    FOUND = "found"
    WRONG_CLASS = "wrong class"  # an instance of another class reaches the IoU threshold
    SPLIT = "split"  # several instances cover a part of it, and none reaches the IoU threshold
    MISSED = "missed"
    IGNORED = "ignored"  # not evaluated


class Cause(Enum):
    """The stage that lost an object, in the order of the pipeline."""

    OBSERVATION = "observation"
    DETECTION = "detection"
    TRACKING = "tracking"
    REFINEMENT = "refinement"
    ASSOCIATION = "association"
    FUSION = "fusion"
    EVALUATION = "evaluation"


@dataclass(frozen=True)
class StageFigures:
    """What happened to a true object in each stage. All numbers of points are sums over frames."""

    # observation
    frames_seen: int  # number of frames with at least MIN_PIXELS readings on the object
    largest_view: int  # px, largest number of readings on the object in a frame
    # detection
    frames_detected: int  # number of these frames with a cluster of the object
    detected_classes: Mapping[str, int]  # number of its clusters by class
    masks_of_others: Mapping[int, int]  # number of frames with most of it in the mask of another object, by object
    coverage: float  # median fraction of its readings in its best mask, over the frames in which it is detected
    # tracking
    frames_lost: int  # number of frames with the object and a lost pose
    displacement: float  # m, median displacement of the object by pose errors; NaN = unknown
    largest_displacement: float  # m
    # coverage times the fraction of its readings in frames that displace it by at most MAX_DISTANCE
    coverage_in_place: float
    # refinement
    points: int  # number of points of its clusters on it, before refinement
    removed: float  # fraction of these points that the refiner removed
    foreign: float  # fraction of the points of its refined clusters that are not on it
    iou_refinement: float  # this fraction times the median IoU of its best refined mask
    # association
    first_detected: int  # Frame.index of its first cluster, -1 = none
    first_matched: int  # Frame.index of its first cluster with an instance, -1 = none
    largest_cluster: int  # number of points of its largest refined cluster
    instance: int  # instance of the map with most of it, 0 = none
    instances: Mapping[int, int]  # number of points of its refined clusters by instance; 0 = without an instance
    objects_of_instance: Mapping[int, int]  # number of points of `instance` by true object; 0 = on no object
    iou_association: float  # times the IoU of the points of its clusters with those of the clusters of `instance`
    # fusion
    confirmed: bool  # True = `instance` is in the results
    labels: Mapping[int, float]  # fraction of its true points by instance in the map; 0 = none
    best_instance: int  # instance of the results with the best IoU, 0 = none
    iou: float  # IoU of the evaluation, with `best_instance`
    # evaluation
    true_points: int
    covered: float  # fraction of its true points within MAX_DISTANCE of the surface of the map


@dataclass(frozen=True)
class ObjectExplanation:
    """The explanation of the result of a true object."""

    id: int
    class_name: str
    state: State
    cause: Cause | None  # None = found or ignored
    reason: str
    frame: int  # Frame.index of the frame that shows the cause best, -1 = never visible
    figures: StageFigures


@dataclass(frozen=True)
class FalseInstance:
    """The explanation of a false instance."""

    id: int
    class_name: str
    cause: Cause
    reason: str
    observations: int  # number of frames with a matched cluster
    objects: Mapping[int, int]  # number of its points by true object; 0 = on no object


def explain_objects(
    frames: Sequence[FrameObservation],
    motions: Mapping[int, Float64],
    classes: Sequence[str],
    merged: Mapping[int, int],
    compared: Compared,
) -> tuple[list[ObjectExplanation], list[FalseInstance]]:
    """Return the explanations of all true objects, by id, and of all false instances, by decreasing confidence.

    Args:
        frames: The observed frames.
        motions: The motion (4, 4) of the points of a frame in the camera frame by pose errors, by `Frame.index`. Lost
            frames and frames without a true pose are missing.
        classes: The classes of the detector.
        merged: The instance into which each merged instance was merged.
        compared: The map and the ground truth, in the label space of the evaluation.
    """
    judged, lost = judge(compared.predictions, compared.truth, MIN_IOU)
    surface = LabeledTruth.of(compared)
    matched = {k: instance_points(k, frames, merged) for k in instances_of(frames, merged)}
    explained = []
    for key in sorted(surface.sizes):
        views = ObjectViews.of(key, frames, motions, merged)
        figures = figures_of(key, views, matched, surface, classes)
        name = compared.truth.class_names.get(key)
        state = state_of(name, figures, is_lost=key in lost)
        cause, reason = cause_of(key, name or "", state, figures, classes)
        shown = frame_of(views, cause, figures)
        explained.append(ObjectExplanation(key, name or "unknown class", state, cause, reason, shown, figures))
    objects = {one.id: one for one in explained}
    names = dict(zip(compared.predictions.ids.tolist(), compared.predictions.class_names, strict=True))
    false = [
        explain_false(one.id, names[one.id], instance_points(one.id, frames, merged), objects)
        for one in judged
        if one.outcome is Outcome.FALSE
    ]
    return explained, false


def instances_of(frames: Sequence[FrameObservation], merged: Mapping[int, int]) -> list[int]:
    """Return the remaining instances that were matched with clusters."""
    found = {k for frame in frames for k in frame.instance_ids.tolist()}
    return sorted(found - merged.keys() - {0} | {k for k in merged.values() if k not in merged})


@dataclass(frozen=True)
class LabeledTruth:
    """The labels of the map at the points of the ground truth."""

    true_ids: Int32  # (V,) true object of each point, 0 = none
    predicted: Int32  # (V,) instance of the map at each point, 0 = none
    listed: frozenset[int]  # instances in the results
    sizes: Mapping[int, int]  # number of points of each true object
    covered: Mapping[int, int]  # number of points of each true object near the surface of the map
    best_ious: Mapping[int, float]  # of the evaluation
    best_ids: Mapping[int, int]

    @classmethod
    def of(cls, compared: Compared) -> LabeledTruth:
        predictions, truth = compared.predictions, compared.truth
        on_surface = np.ones(len(predictions.points_world), np.int32)
        near = transfer_labels(predictions.points_world, on_surface, truth.points_world, MAX_DISTANCE)
        evaluation = evaluate(predictions, truth)
        return cls(
            truth.instance_ids,
            compared.predicted_ids(),
            frozenset(predictions.ids.tolist()),
            Counter(truth.instance_ids[truth.instance_ids > 0].tolist()),
            Counter(truth.instance_ids[near > 0].tolist()),
            evaluation.best_ious,
            evaluation.best_ids,
        )

    def labels_of(self, key: int) -> dict[int, float]:
        """Return the fraction of the points of a true object by instance of the map, 0 = none."""
        found = Counter(self.predicted[self.true_ids == key].tolist())
        return {k: count / self.sizes[key] for k, count in found.most_common()}


def figures_of(
    key: int,
    views: ObjectViews,
    matched: Mapping[int, InstancePoints],
    surface: LabeledTruth,
    classes: Sequence[str],
) -> StageFigures:
    """Return the figures of an object.

    Args:
        key: The object.
        views: The views of the object.
        matched: The clusters of each instance of the map.
        surface: The labels of the map.
        classes: The classes of the detector.
    """
    seen, detected = views.seen, views.detected
    good, fused = detected & views.in_place, detected & ~views.lost
    refined, refined_foreign = int(views.refined[good].sum()), int(views.refined_foreign[good].sum())
    instances = sum((views.matched[k] for k in np.flatnonzero(detected)), Counter[int]())
    parts = {  # IoU of the points of its clusters with the points of the clusters of an instance
        k: count / (instances.total() + matched[k].cluster_points.total() - matched[k].cluster_points[key])
        for k, count in instances.items()
        if k
    }
    instance = max(parts, key=lambda k: (parts[k], -k), default=0)
    in_place = _ratio(views.visible[good].sum(), views.visible[detected].sum())
    coverage, iou_refined = _median(views.coverage[detected]), _median(views.refined_iou[fused])
    known = views.displacement[detected & np.isfinite(views.displacement)]
    has_instance = np.array([any(points) for points in views.matched], np.bool_)
    return StageFigures(
        frames_seen=int(seen.sum()),
        largest_view=int(views.visible.max(initial=0)),
        frames_detected=int((seen & detected).sum()),
        detected_classes={classes[k]: count for k, count in views.classes.most_common()},
        masks_of_others=dict(Counter(views.covering[seen & (views.covering > 0)].tolist()).most_common()),
        coverage=coverage,
        frames_lost=int((views.lost & seen).sum()),
        displacement=float(np.median(known)) if len(known) else float("nan"),
        largest_displacement=float(known.max()) if len(known) else float("nan"),
        coverage_in_place=in_place * coverage,
        points=int(views.lifted.sum()),
        removed=1 - _ratio(views.refined[fused].sum(), views.lifted[fused].sum()) if fused.any() else 0.0,
        foreign=_ratio(refined_foreign, refined + refined_foreign),
        iou_refinement=in_place * iou_refined,
        first_detected=_first(views.frames[detected]),
        first_matched=_first(views.frames[has_instance]),
        largest_cluster=int(views.largest.max(initial=0)),
        instance=instance,
        instances=dict(instances.most_common()),
        objects_of_instance=dict(matched[instance].points.most_common()) if instance else {},
        iou_association=in_place * iou_refined * parts.get(instance, 0.0),
        confirmed=instance in surface.listed,
        labels=surface.labels_of(key),
        best_instance=surface.best_ids.get(key, 0),
        iou=surface.best_ious.get(key, 0.0),
        true_points=surface.sizes[key],
        covered=surface.covered.get(key, 0) / surface.sizes[key],
    )


def state_of(class_name: str | None, figures: StageFigures, is_lost: bool) -> State:
    """Return the state of an object of a class (None = unknown), of which no correct instance exists if it is lost."""
    if class_name is None or figures.true_points < MIN_POINTS:
        return State.IGNORED
    if not is_lost:
        return State.FOUND
    if figures.iou >= MIN_IOU:
        return State.WRONG_CLASS
    parts = [k for k, fraction in figures.labels.items() if k and fraction >= SPLIT_FRACTION]
    return State.SPLIT if len(parts) > 1 else State.MISSED


def cause_of(
    key: int, class_name: str, state: State, figures: StageFigures, classes: Sequence[str]
) -> tuple[Cause | None, str]:
    """Return the cause of the state of an object, and the reason as text."""
    if state is State.FOUND:
        return None, f"IoU {figures.iou:.2f} with instance {figures.best_instance}"
    if state is State.IGNORED:
        return None, f"{figures.true_points} true points" if class_name else "class is not evaluated"
    if state is State.WRONG_CLASS:
        return _cause_of_class(key, class_name, figures, classes)
    return next(
        ((cause, reason(key, figures)) for cause, is_lost, reason in RULES if is_lost(figures)),
        (Cause.FUSION, _outvoted(figures)),
    )


def _not_detected(figures: StageFigures) -> bool:
    return figures.frames_detected < MIN_DETECTION_RATE * figures.frames_seen or figures.coverage < MIN_IOU


def _detection_reason(_: int, figures: StageFigures) -> str:
    inside = [f"; inside the mask of object {k} in {n} frames" for k, n in figures.masks_of_others.items()]
    counts = f"detected in {figures.frames_detected} of {figures.frames_seen} frames"
    return f"{counts}, masks cover {figures.coverage:.0%}{inside[0] if inside else ''}"


def _tracking_reason(_: int, figures: StageFigures) -> str:
    lost = f"; {figures.frames_lost} frames lost" if figures.frames_lost else ""
    median, largest = 100 * figures.displacement, 100 * figures.largest_displacement
    return f"displaced by {median:.1f} cm in the median frame and by at most {largest:.1f} cm{lost}"


def _refinement_reason(_: int, figures: StageFigures) -> str:
    return f"{figures.removed:.0%} of its points removed; {figures.foreign:.0%} of the remaining points are not on it"


def _other_objects(figures: StageFigures) -> list[int]:
    """Return the objects other than the main one that have much of the instance."""
    points = figures.objects_of_instance
    others = [k for k in list(points)[1:] if k]
    return [k for k in others if points[k] >= MIN_FOREIGN * sum(points.values())]


def _association_reason(key: int, figures: StageFigures) -> str:
    if not figures.instance:
        return f"no instance was created; its largest cluster has {figures.largest_cluster} points"
    main = next(iter(figures.objects_of_instance))
    if main not in (0, key):
        return f"absorbed by instance {figures.instance}, most of which is on object {main}"
    if others := _other_objects(figures):
        return f"instance {figures.instance} is also on object {others[0]}"
    total = sum(figures.instances.values())
    parts = ", ".join(f"{k or 'none'} {count / total:.0%}" for k, count in list(figures.instances.items())[:4])
    late = figures.first_matched - figures.first_detected
    return f"its points by instance: {parts}" + (f"; created {late} frames late" if late > 0 else "")


def _outvoted(figures: StageFigures) -> str:
    own = figures.labels.get(figures.instance, 0.0)
    others = {k: fraction for k, fraction in figures.labels.items() if k != figures.instance}
    top = max(others, key=lambda k: others[k], default=0)
    winner = f"instance {top}" if top else "no instance"
    return f"instance {figures.instance} has {own:.0%} of its true points, {winner} {others.get(top, 0.0):.0%}"


Rule = tuple[Cause, Callable[[StageFigures], bool], Callable[[int, StageFigures], str]]
RULES: tuple[Rule, ...] = (
    (
        Cause.OBSERVATION,
        lambda one: one.frames_seen == 0,
        lambda _, one: f"never seen with {MIN_PIXELS} px; largest view {one.largest_view} px",
    ),
    (Cause.DETECTION, _not_detected, _detection_reason),
    (Cause.TRACKING, lambda one: one.coverage_in_place < MIN_IOU, _tracking_reason),
    (Cause.REFINEMENT, lambda one: one.iou_refinement < MIN_IOU, _refinement_reason),
    (Cause.ASSOCIATION, lambda one: one.iou_association < MIN_IOU, _association_reason),
    (Cause.ASSOCIATION, lambda one: bool(_other_objects(one)), _association_reason),
    (Cause.FUSION, lambda one: not one.confirmed, lambda _, one: f"instance {one.instance} was not confirmed"),
    (
        Cause.EVALUATION,
        lambda one: one.covered < MIN_IOU,
        lambda _, one: f"{one.covered:.0%} of its true points are within {100 * MAX_DISTANCE:g} cm of the map",
    ),
)
"""The conditions under which a stage has lost an object, in the order of the pipeline, and the reasons."""


def _cause_of_class(key: int, class_name: str, figures: StageFigures, classes: Sequence[str]) -> tuple[Cause, str]:
    found = figures.detected_classes
    counts = "detected as " + (", ".join(f"{name} ({count})" for name, count in found.items()) or "nothing")
    main = next(iter(figures.objects_of_instance), 0)
    if main not in (0, key):
        return Cause.ASSOCIATION, f"absorbed by instance {figures.instance}, most of which is on object {main}"
    if next(iter(found), "") != class_name:
        unknown = "" if class_name in classes else f"; the detector has no class {class_name}"
        return Cause.DETECTION, counts + unknown
    if others := [k for k in _other_objects(figures) if k != key]:
        return Cause.ASSOCIATION, f"{counts}; instance {figures.instance} has the class of object {others[0]}"
    return Cause.FUSION, f"{counts}, but instance {figures.best_instance} has another class"


def frame_of(views: ObjectViews, cause: Cause | None, figures: StageFigures) -> int:
    """Return the index of the frame that shows the cause best, -1 = never visible."""
    if not len(views.frames):
        return -1
    value = views.visible
    if cause is Cause.DETECTION:
        value = views.visible + views.lifted_foreign - views.lifted
    elif cause is Cause.TRACKING:
        value = np.where(views.in_place, 0, views.visible)
    elif cause is Cause.REFINEMENT:
        value = views.lifted - views.refined + views.refined_foreign
    elif cause is Cause.ASSOCIATION:
        value = np.array([points.total() - points[figures.instance] for points in views.matched], np.int64)
    return int(views.frames[value.argmax() if value.any() else views.visible.argmax()])


def explain_false(
    key: int, class_name: str, own: InstancePoints, objects: Mapping[int, ObjectExplanation]
) -> FalseInstance:
    """Return the explanation of a false instance, given its clusters and the explanations of the true objects."""
    cause, reason = _cause_of_false(own, objects)
    return FalseInstance(key, class_name, cause, reason, own.observations, dict(own.points.most_common()))


def _cause_of_false(own: InstancePoints, objects: Mapping[int, ObjectExplanation]) -> tuple[Cause, str]:
    main, count = (own.clusters.most_common(1) or [(0, 0)])[0]
    one = objects.get(main)
    if one is None or one.state is State.IGNORED:
        where = f"object {main}, which is not evaluated" if main else "no object"
        return Cause.DETECTION, f"{count} of its {own.clusters.total()} masks are on {where}"
    part = f"on object {main} ({one.class_name})"
    if one.cause is not None:
        return one.cause, f"{part}, which is {one.state.value}"
    if (covered := _ratio(own.lifted[main], own.visible[main])) < MIN_IOU:
        return Cause.DETECTION, f"{part}; its masks cover {covered:.0%} of this object"
    if one.figures.largest_displacement > MAX_DISTANCE:
        return Cause.TRACKING, f"{part}, displaced by up to {100 * one.figures.largest_displacement:.0f} cm"
    if (foreign := 1 - _ratio(own.points[main], own.points.total())) > 1 - MIN_IOU:
        return Cause.REFINEMENT, f"{part}; {foreign:.0%} of its points are not on this object"
    return Cause.ASSOCIATION, f"{part}, whose main instance is {one.figures.best_instance}"


def _first(frames: Sequence[int] | np.ndarray) -> int:
    return int(frames[0]) if len(frames) else -1


def _median(values: Float64) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else 0.0
