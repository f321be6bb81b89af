"""What has changed between two visits of a place: objects that appeared, vanished or moved, with probabilities.

An object of one visit is looked for in the map of the other by what its camera saw. Where that looks through the
object's surface, it is gone; where it sees a surface there, and the same thing in it, it is there still; where it
never looked, or something stood before it, nobody knows. Both maps lie in one world: the second was made with
`localize_in=` of the first, or both with given poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from framework.data import Bool, Camera, Float32, Float64, Instance, InstanceMesh, Int32
from framework.errors import DataError
from framework.geometry import inverse, project, transform
from framework.interfaces import SceneMap

LOOKS = 60  # poses of a visit, evenly spread, from which its map is looked at
EYE = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)  # half a Kinect: what a visit's camera is taken for
SAMPLED = 400  # of an object's vertices
BEHIND = 0.06  # m and share of the depth (BEHIND_SHARE), that a surface must lie behind a point to be seen through it
BEHIND_SHARE = 0.02
LEAST_SEEN = 0.3  # of an object's vertices, that the other visit must tell something about
BESIDE = 0.05  # m, within which a vertex of the other map is the same place
STAYS = 0.9  # probability that a thing stays from one visit to the next
CLUTTER = 0.1  # probability that there is a surface, or an object found, where the thing has gone
GONE = 0.5  # probability, from which on it is told as gone
SAME_THING = 0.3  # of an object's surface, under one object of the other visit, that makes them one


class Kind(Enum):
    """What became of an object."""

    VANISHED = "vanished"
    APPEARED = "appeared"
    MOVED = "moved"
    STAYED = "stayed"
    NOT_SEEN = "not seen"  # the other visit does not tell


@dataclass(frozen=True)
class Change:
    """One object of the first visit, the second, or both."""

    kind: Kind
    name: str  # of its class
    probability: float  # of what `kind` says; of NOT_SEEN, that it is an object at all
    before: int | None  # its id in the first map
    after: int | None  # its id in the second
    place: Float64  # (3,) m, its centre in the world, where it was last
    distance: float = 0.0  # m, by which it moved


@dataclass(frozen=True)
class Visit:
    """A map, and the poses (F, 4, 4) from which its camera saw it."""

    scene: SceneMap
    poses: Float64

    def __post_init__(self) -> None:
        if not len(self.poses):
            raise DataError("a visit without any pose has seen nothing")


def changes(before: Visit, after: Visit) -> list[Change]:
    """All objects of both visits, what changed first, by falling probability."""
    lost, known = _looked_for(before, after), _looked_for(after, before)
    classes = before.scene.classes, after.scene.classes
    pairs = _moved(lost, known, classes)
    found = [_moved_change(a, b, probability, classes) for a, b, probability in pairs]
    taken_before = {a.instance.id for a, _, _ in pairs}
    taken_after = {b.instance.id for _, b, _ in pairs}
    found += [_change(a, Kind.VANISHED, classes[0]) for a in lost if a.instance.id not in taken_before]
    stayed = {a.match for a in lost if a.gone < GONE and a.seen >= LEAST_SEEN}
    found += [
        _change(b, Kind.APPEARED, classes[1])
        for b in known
        if b.instance.id not in taken_after | stayed  # each object is told once
    ]
    order = [Kind.MOVED, Kind.VANISHED, Kind.APPEARED, Kind.STAYED, Kind.NOT_SEEN]
    changed = {Kind.MOVED, Kind.VANISHED, Kind.APPEARED}
    return sorted(found, key=lambda one: (one.kind not in changed, -one.probability, order.index(one.kind)))


@dataclass(frozen=True)
class _Sought:
    """An object of one visit, and what the other one tells of it."""

    instance: Instance
    seen: float  # share of its surface about which the other visit tells something
    gone: float  # probability that it is not there in the other visit
    match: int | None  # the object of the other visit that is where it is


def _looked_for(visit: Visit, other: Visit) -> list[_Sought]:
    """Each object of a visit, looked for in the other one."""
    mesh, instances = visit.scene.mesh(), visit.scene.instances()
    if not instances:
        return []
    chosen = [_spread(instance.vertices) for instance in instances.values()]
    points = mesh.vertices[np.concatenate(chosen)]
    ends = np.cumsum([len(vertices) for vertices in chosen])
    there, through = look_for(other, points)
    labels = _labels_beside(other.scene.mesh(), points)
    sought = []
    for instance, end, count in zip(instances.values(), ends, map(len, chosen), strict=True):
        own = slice(end - count, end)
        match = _match(labels[own])
        seen = there[own] | through[own]
        sought.append(
            _Sought(
                instance,
                float(seen.mean()),
                probability_gone(instance.confidence, there[own], through[own], match is not None),
                match,
            )
        )
    return sought


def look_for(visit: Visit, points: Float32) -> tuple[Bool, Bool]:
    """Whether a visit saw a surface at points (P, 3) m of the world, (P,), and whether it saw through them, (P,).

    A point that it saw through from anywhere is not there, whatever else it looked like.
    """
    there, through = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    for k in np.unique(np.linspace(0, len(visit.poses) - 1, LOOKS).round().astype(int)):
        depth = visit.scene.render(EYE, visit.poses[k]).depth
        in_camera = transform(inverse(visit.poses[k]), points.astype(np.float64))
        ahead = np.flatnonzero(in_camera[:, 2] > 0)
        u, v = np.rint(project(EYE, in_camera[ahead])).astype(np.int64).T
        inside = (u >= 0) & (u < EYE.width) & (v >= 0) & (v < EYE.height)
        at, surface = ahead[inside], depth[v[inside], u[inside]]
        behind = surface - in_camera[at, 2]
        tolerance = BEHIND + BEHIND_SHARE * in_camera[at, 2]
        known = surface > 0
        there[at[known & (np.abs(behind) <= tolerance)]] = True
        through[at[known & (behind > tolerance)]] = True
    return there & ~through, through


def probability_gone(confidence: float, there: Bool, through: Bool, matched: bool) -> float:
    """By Bayes' rule, that a thing is not there: from its surface points (M,), and whether an object is found there.

    A thing that is there shows a surface where it had one, and is found as often as it was before; one that is gone
    leaves both to chance.
    """
    told = int(np.count_nonzero(there | through))
    if told < LEAST_SEEN * len(there):
        return 1 - STAYS
    share = np.count_nonzero(there) / told
    surface = (CLUTTER + (1 - CLUTTER) * share) / (CLUTTER + (1 - CLUTTER) * (1 - share))
    again = min(max(confidence, CLUTTER), 1 - CLUTTER)
    label = again / CLUTTER if matched else (1 - again) / (1 - CLUTTER)
    odds = STAYS / (1 - STAYS) * surface * label
    return float(1 / (1 + odds))


def _spread(vertices: Int32) -> Int32:
    return vertices[:: max(1, len(vertices) // SAMPLED)]


def _labels_beside(mesh: InstanceMesh, points: Float32) -> Int32:
    """(P,) the object of the nearest vertex, 0 = none, or none within BESIDE."""
    if not len(mesh.vertices):
        return np.zeros(len(points), np.int32)
    distance, nearest = KDTree(mesh.vertices).query(points, distance_upper_bound=BESIDE)
    near = np.isfinite(distance)
    return np.where(near, mesh.instance_ids[np.where(near, nearest, 0)], 0).astype(np.int32)


def _match(labels: Int32) -> int | None:
    """The object under most of a surface, if that is enough of it."""
    ids, counts = np.unique(labels[labels > 0], return_counts=True)
    if not len(ids) or counts.max() < SAME_THING * len(labels):
        return None
    return int(ids[counts.argmax()])


def _moved(
    lost: Sequence[_Sought], known: Sequence[_Sought], classes: tuple[tuple[str, ...], tuple[str, ...]]
) -> list[tuple[_Sought, _Sought, float]]:
    """Things that are gone from one place and new in another: pairs of one class and size, with their probability."""
    gone = [sought for sought in lost if sought.gone >= GONE and sought.seen >= LEAST_SEEN]
    new = [sought for sought in known if sought.gone >= GONE and sought.seen >= LEAST_SEEN]
    if not gone or not new or classes[0] != classes[1]:
        return []
    alike = np.array([[_alike(a.instance, b.instance) for b in new] for a in gone])
    rows, columns = linear_sum_assignment(-alike)
    return [
        (gone[i], new[j], float(alike[i, j] * _exists(gone[i]) * gone[i].gone * _exists(new[j]) * new[j].gone))
        for i, j in zip(rows, columns, strict=True)
        if alike[i, j] > 0.5
    ]


def _alike(a: Instance, b: Instance) -> float:
    """In [0, 1]: how much two objects agree in their classes (Bhattacharyya) and in their size."""
    same_class = float(np.sqrt(a.class_probabilities * b.class_probabilities).sum())
    sizes = np.sort(a.obb.extent), np.sort(b.obb.extent)
    ratio = float(np.abs(np.log(np.maximum(sizes[0], 0.02) / np.maximum(sizes[1], 0.02))).mean())
    return same_class * float(np.exp(-ratio))


def _exists(sought: _Sought) -> float:
    return float(min(max(sought.instance.confidence, 0.0), 1.0))


def _change(sought: _Sought, kind: Kind, classes: tuple[str, ...]) -> Change:
    instance = sought.instance
    name = classes[int(instance.class_probabilities.argmax())] if classes else "object"
    own, other = instance.id, None
    probability = _exists(sought)
    if sought.seen < LEAST_SEEN:
        told = Kind.NOT_SEEN
    elif sought.gone < GONE:
        told, probability, other = Kind.STAYED, probability * (1 - sought.gone), sought.match
    else:
        told, probability = kind, probability * sought.gone
    before, after = (own, other) if kind is Kind.VANISHED else (other, own)
    return Change(told, name, probability, before, after, instance.obb.center)


def _moved_change(
    a: _Sought, b: _Sought, probability: float, classes: tuple[tuple[str, ...], tuple[str, ...]]
) -> Change:
    name = classes[0][int(a.instance.class_probabilities.argmax())]
    distance = float(np.linalg.norm(a.instance.obb.center - b.instance.obb.center))
    return Change(Kind.MOVED, name, probability, a.instance.id, b.instance.id, b.instance.obb.center, distance)
