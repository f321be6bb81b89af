"""Detection of appeared, vanished and moved objects between two visits of a scene.

The map of each visit is rendered from its camera poses. An object of the other visit is absent if the camera observed
free space at its surface. It is present if the camera observed a surface and the same object. It is unobserved if it
was occluded or outside of all views.

Both maps must share one world frame. Map the second visit with `localize_in=` of the first, or both with given poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from framework.data import Bool, Camera, Float32, Float64, Instance, InstanceMesh, Int32, Int64
from framework.errors import DataError
from framework.geometry import inverse, project, transform

RENDERED_POSES = 60  # number of evenly spaced poses for rendering the map of a visit
ASSUMED_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)  # of a visit: half the resolution of a Kinect
SAMPLED = 400  # maximum number of sampled vertices of an object
MIN_GAP, MIN_GAP_PER_DEPTH = 0.06, 0.02  # m, m per m of depth; minimum distance of the surface behind free space
MIN_SEEN = 0.3  # minimum fraction of an object's vertices observed in the other visit
MAX_DISTANCE = 0.05  # m, maximum distance to a vertex of the other map at the same position
STAY_PROBABILITY = 0.9  # prior probability that an object stays from one visit to the next
CLUTTER = 0.1  # probability of another surface or object at the position of an absent object
MIN_GONE = 0.5  # minimum probability of a vanished object
SAME_THING = 0.3  # minimum common fraction of the surface for the same object in both visits


class Kind(Enum):
    """The change of an object."""

    VANISHED = "vanished"
    APPEARED = "appeared"
    MOVED = "moved"
    STAYED = "stayed"
    NOT_SEEN = "not seen"  # not observed in the other visit


@dataclass(frozen=True)
class Change:
    """The change of an object between the first and the second visit."""

    kind: Kind
    name: str  # name of its class
    probability: float  # probability of `kind`; for NOT_SEEN, confidence of the object
    before: int | None  # id in the first map
    after: int | None  # id in the second map
    place: Float64  # (3,) m, last center in the world frame
    distance: float = 0.0  # m, displacement of a moved object


class ObservedView(Protocol):
    """A view of a map."""

    @property
    def depth(self) -> Float32:
        """Depth (H, W), m along z, 0 = no surface."""


class ObservedMap(Protocol):
    """The members of a map that are compared: those of SceneMap, or a LabeledSurface."""

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the columns of the class probabilities."""

    def mesh(self) -> InstanceMesh:
        """Return the surface."""

    def instances(self) -> Mapping[int, Instance]:
        """Return the objects by id."""

    def render(self, camera: Camera, T_world_camera: Float64) -> ObservedView:
        """Return the view from `camera` at T_world_camera (4, 4)."""


@dataclass(frozen=True)
class Visit:
    """A map with the camera poses of its frames.

    An imported map has no poses. It is rendered from the poses of the other visit.
    """

    scene: ObservedMap
    poses: Float64  # (F, 4, 4) T_world_camera

    def __post_init__(self) -> None:
        if not len(self.poses):
            raise DataError("visit: expected at least one pose, got none")


@dataclass(frozen=True)
class _Object:
    """An object of one visit, with its observation in the other visit."""

    instance: Instance
    name: str  # name of its class
    seen: float  # observed fraction of the surface in the other visit
    gone: float  # probability of absence in the other visit
    match: int | None  # id of the object of the other visit at the same position; None = no object

    @property
    def is_gone(self) -> bool:
        return self.gone >= MIN_GONE and self.seen >= MIN_SEEN

    @property
    def confidence(self) -> float:
        """Confidence of the object, in [0, 1]."""
        return float(min(max(self.instance.confidence, 0.0), 1.0))


def changes(before: Visit, after: Visit) -> list[Change]:
    """Return the changes of all objects of both visits.

    Moved, vanished and appeared objects come first. Both groups are sorted by decreasing probability.
    """
    old, new = _observe(before, after), _observe(after, before)
    pairs = _moved(old, new, _shared(before.scene.classes, after.scene.classes))
    found = []
    for a, b, probability in pairs:
        start, end = a.instance.obb.center, b.instance.obb.center
        distance = float(np.linalg.norm(start - end))
        found.append(Change(Kind.MOVED, a.name, probability, a.instance.id, b.instance.id, end, distance))
    moved_before, moved_after = {a.instance.id for a, _, _ in pairs}, {b.instance.id for _, b, _ in pairs}
    found += [_change(a, Kind.VANISHED) for a in old if a.instance.id not in moved_before]
    stayed = {a.match for a in old if a.gone < MIN_GONE and a.seen >= MIN_SEEN}  # already listed
    found += [_change(b, Kind.APPEARED) for b in new if b.instance.id not in moved_after | stayed]
    order = [Kind.MOVED, Kind.VANISHED, Kind.APPEARED, Kind.STAYED, Kind.NOT_SEEN]
    changed = {Kind.MOVED, Kind.VANISHED, Kind.APPEARED}
    return sorted(found, key=lambda one: (one.kind not in changed, -one.probability, order.index(one.kind)))


def _observe(visit: Visit, other: Visit) -> list[_Object]:
    """Return the objects of a visit, with their observations in the other visit."""
    mesh, instances, classes = visit.scene.mesh(), visit.scene.instances(), visit.scene.classes
    if not instances:
        return []
    sampled = [one.vertices[:: max(1, len(one.vertices) // SAMPLED)] for one in instances.values()]
    points = mesh.vertices[np.concatenate(sampled)]
    there, through = look_for(other, points)
    labels = _nearest_labels(other.scene.mesh(), points)
    objects = []
    end = 0
    for instance, vertices in zip(instances.values(), sampled, strict=True):
        own = slice(end, end + len(vertices))
        end = own.stop
        match = _match(labels[own])
        name = classes[int(instance.class_probabilities.argmax())] if classes else "object"
        seen = float((there[own] | through[own]).mean())
        gone = probability_gone(instance.confidence, there[own], through[own], match is not None)
        objects.append(_Object(instance, name, seen, gone, match))
    return objects


def look_for(visit: Visit, points: Float32) -> tuple[Bool, Bool]:
    """Return two masks (P,): points on an observed surface, and points in observed free space.

    A point is in free space if it was observed as free from at least one pose.

    Args:
        visit: Visit with the observations.
        points: World points (P, 3), m.
    """
    there, through = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    for k in np.unique(np.linspace(0, len(visit.poses) - 1, RENDERED_POSES).round().astype(int)):
        depth = visit.scene.render(ASSUMED_CAMERA, visit.poses[k]).depth
        points_camera = transform(inverse(visit.poses[k]), points.astype(np.float64))
        in_front = np.flatnonzero(points_camera[:, 2] > 0)
        u, v = np.rint(project(ASSUMED_CAMERA, points_camera[in_front])).astype(np.int64).T
        inside = (u >= 0) & (u < ASSUMED_CAMERA.width) & (v >= 0) & (v < ASSUMED_CAMERA.height)
        visible, surface = in_front[inside], depth[v[inside], u[inside]]
        behind = surface - points_camera[visible, 2]
        tolerance = MIN_GAP + MIN_GAP_PER_DEPTH * points_camera[visible, 2]
        known = surface > 0
        there[visible[known & (np.abs(behind) <= tolerance)]] = True
        through[visible[known & (behind > tolerance)]] = True
    return there & ~through, through


def probability_gone(confidence: float, there: Bool, through: Bool, matched: bool) -> float:
    """Return the probability that an object is absent in the other visit, by Bayes' rule.

    A present object has a surface and is detected as often as before. At the position of an absent object, surfaces and
    detections are only due to clutter.

    Args:
        confidence: Confidence of the object, in [0, 1].
        there: Mask (M,) of the sampled vertices where the other visit has a surface.
        through: Mask (M,) of the sampled vertices where the other visit has free space.
        matched: True if the other visit has an object at the same position.
    """
    observed = int(np.count_nonzero(there | through))
    if observed < MIN_SEEN * len(there):
        return 1 - STAY_PROBABILITY
    fraction = np.count_nonzero(there) / observed
    surface = (CLUTTER + (1 - CLUTTER) * fraction) / (CLUTTER + (1 - CLUTTER) * (1 - fraction))
    detected = min(max(confidence, CLUTTER), 1 - CLUTTER)
    label = detected / CLUTTER if matched else (1 - detected) / (1 - CLUTTER)
    odds = STAY_PROBABILITY / (1 - STAY_PROBABILITY) * surface * label
    return float(1 / (1 + odds))


def _nearest_labels(mesh: InstanceMesh, points: Float32) -> Int32:
    """Return the object id (P,) of the vertex nearest to each point (P, 3), m, or 0 for none nearby."""
    if not len(mesh.vertices):
        return np.zeros(len(points), np.int32)
    distance, nearest = KDTree(mesh.vertices).query(points, distance_upper_bound=MAX_DISTANCE)
    near = np.isfinite(distance)
    return np.where(near, mesh.instance_ids[np.where(near, nearest, 0)], 0).astype(np.int32)


def _match(labels: Int32) -> int | None:
    """Return the most frequent nonzero label, or None if it is too rare."""
    ids, counts = np.unique(labels[labels > 0], return_counts=True)
    if not len(ids) or counts.max() < SAME_THING * len(labels):
        return None
    return int(ids[counts.argmax()])


def _shared(before: Sequence[str], after: Sequence[str]) -> tuple[Int64, Int64]:
    """Return the indices of the common class names in two lists of classes."""
    common = [name for name in before if name in after]
    first, second = ([classes.index(name) for name in common] for classes in (before, after))
    return np.array(first, np.int64), np.array(second, np.int64)


def _moved(
    old: Sequence[_Object], new: Sequence[_Object], shared: tuple[Int64, Int64]
) -> list[tuple[_Object, _Object, float]]:
    """Return pairs of a vanished and a similar appeared object, with the probability of a move.

    `shared` are the indices of the common classes in the class probabilities of both visits.
    """
    vanished, appeared = [one for one in old if one.is_gone], [one for one in new if one.is_gone]
    if not vanished or not appeared:
        return []
    alike = np.array([[_similarity(a.instance, b.instance, shared) for b in appeared] for a in vanished])
    rows, columns = linear_sum_assignment(-alike)
    pairs = []
    for i, j in zip(rows, columns, strict=True):
        a, b = vanished[i], appeared[j]
        if alike[i, j] > 0.5:
            pairs.append((a, b, float(alike[i, j] * a.confidence * a.gone * b.confidence * b.gone)))
    return pairs


def _similarity(a: Instance, b: Instance, shared: tuple[Int64, Int64]) -> float:
    """Return the similarity of two objects in class and size, in [0, 1]. `shared` is described in `_moved`."""
    probabilities = a.class_probabilities[shared[0]] * b.class_probabilities[shared[1]]
    same_class = float(np.sqrt(probabilities).sum())  # Bhattacharyya coefficient
    sizes = np.sort(a.obb.extent), np.sort(b.obb.extent)
    ratio = float(np.abs(np.log(np.maximum(sizes[0], 0.02) / np.maximum(sizes[1], 0.02))).mean())
    return same_class * float(np.exp(-ratio))


def _change(one: _Object, kind: Kind) -> Change:
    """Return the change of an object that did not move.

    `kind` is VANISHED for an object of the first visit and APPEARED for an object of the second visit.
    """
    found, probability, match = Kind.NOT_SEEN, one.confidence, None
    if one.seen >= MIN_SEEN and one.gone < MIN_GONE:
        found, probability, match = Kind.STAYED, probability * (1 - one.gone), one.match
    elif one.seen >= MIN_SEEN:
        found, probability = kind, probability * one.gone
    own = one.instance.id
    before, after = (own, match) if kind is Kind.VANISHED else (match, own)
    return Change(found, one.name, probability, before, after, one.instance.obb.center)
