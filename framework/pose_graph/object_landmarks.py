"""Objects as landmarks of the pose graph.

An object has a position but no orientation, so that its observations p_a and p_b in two submaps determine three degrees
of freedom of their anchors: T_a_b p_b = p_a. A node of its own would only connect these submaps, as in Fusion++
(McCormac et al., 2018). So the objects of two submaps are marginalized into one edge between the anchors: its transform
T_a_b aligns the positions, and its information matrix is the Hessian of the alignment, sum_k w_k J_k^T J_k / sigma_k^2
with J_k = [-[p_b]_x, I]. One object leaves the rotation about it undetermined; the Hessian has zeros there.

Adjacent submaps get no edge, because the tracker aligns each frame to the objects that they share: the tracked motion
contains this information. Only objects that were mapped twice, before and after the drift that a loop corrects,
determine more. They are those of the same class that are close to each other after the correction of the loop.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from framework.data import Camera, Float64
from framework.geometry import back_project, exp_se3, inverse, skew, transform
from framework.interfaces import SceneMap, SubmapChange
from framework.pose_graph.graph_optimization import GraphEdge
from framework.pose_graph.loop_detection import Loop
from framework.pose_graph.submap_anchors import Submap, SubmapAnchors

log = logging.getLogger(__name__)

WIDTH = 80  # px, width of the views in which objects are observed
CELL = 0.05  # m, surface in one cell counts once, however many views it is in
MIN_CELLS = 5  # minimum size of an object
MAX_APART = 0.3  # m, maximum distance of two observations of one object
# standard deviation of a position: a constant, m, and a fraction of the radius, because submaps see different sides
POSITION_NOISE, PARTIAL_VIEW = 0.03, 0.2
ITERATIONS = 10  # of reweighted least squares


class ObservedObject(NamedTuple):
    """An instance as observed in a submap."""

    submap: int
    instance_id: int
    class_id: int  # its most likely class
    position: Float64  # (3,) centroid of the observed surface in the frame of the anchor, m
    radius: float  # root mean square distance of the surface from the centroid, m
    cells: int  # size of the observed surface

    @property
    def variance(self) -> float:
        """Variance of each coordinate of the position, m^2."""
        return POSITION_NOISE**2 + (PARTIAL_VIEW * self.radius) ** 2


class SharedObject(NamedTuple):
    """An object that two submaps observe."""

    first: ObservedObject
    second: ObservedObject


@dataclass(frozen=True, eq=False, kw_only=True)
class ObjectEdge(GraphEdge):
    """The transform between two anchors that aligns the objects that both submaps observe."""

    objects: int


class NoLandmarks:
    """A pose graph without landmarks. This class observes nothing."""

    def observe(self, change: SubmapChange, submaps: Sequence[Submap], camera: Camera, scene: SceneMap) -> None:
        """Observe the objects of submaps before they are hidden.

        Args:
            change: The change of the map.
            submaps: All submaps after the change.
            camera: The camera of the frames.
            scene: The map before the change.
        """

    def edges(self, loops: Sequence[Loop], anchors: SubmapAnchors, camera: Camera, scene: SceneMap) -> list[ObjectEdge]:
        """Return the edges from the hidden submaps of loops to the visible submaps.

        Args:
            loops: Loops with the same correction.
            anchors: The submaps before the correction.
            camera: The camera of the frames.
            scene: The map before the correction.
        """
        return []


class ObjectLandmarks(NoLandmarks):
    """A pose graph with objects as landmarks."""

    def __init__(self) -> None:
        self.observed: dict[int, list[ObservedObject]] = {}  # objects by hidden submap

    def observe(self, change: SubmapChange, submaps: Sequence[Submap], camera: Camera, scene: SceneMap) -> None:
        for number in sorted(change.hidden):
            T_world_anchor = inverse(change.motions.get(number, np.eye(4))) @ submaps[number].T_world_anchor
            self.observed[number] = observed_objects(submaps[number], T_world_anchor, camera, scene)

    def edges(self, loops: Sequence[Loop], anchors: SubmapAnchors, camera: Camera, scene: SceneMap) -> list[ObjectEdge]:
        T_new_old, visible = loops[-1].correction(anchors.submaps), anchors.visible()
        corrected = [one.T_world_anchor for one in anchors.submaps]
        second = []
        for submap in visible:
            corrected[submap.number] = T_new_old @ submap.T_world_anchor
            second += observed_objects(submap, submap.T_world_anchor, camera, scene)
        shown = sorted(frozenset().union(*(loop.shown for loop in loops)))
        first = [one for number in shown for one in self.observed[number]]
        edges = object_edges(first, second, corrected)
        for edge in edges:
            log.info("submaps %d and %d: %d objects are in both", edge.first, edge.second, edge.objects)
        return edges


def observed_objects(submap: Submap, T_world_anchor: Float64, camera: Camera, scene: SceneMap) -> list[ObservedObject]:
    """Return the confirmed objects in the views of a visible submap.

    Args:
        submap: The submap.
        T_world_anchor: The pose (4, 4) of its anchor in the map.
        camera: The camera of the frames.
        scene: The map.
    """
    classes, small = scene.most_likely_classes(), camera.scaled(min(WIDTH / camera.width, 1))
    found = [np.zeros((0, 4), np.int64)]  # instance and cell
    for T_anchor_camera in submap.views:
        view = scene.render_visible(small, T_world_anchor @ T_anchor_camera)
        v, u = np.nonzero(view.instance_ids)
        points = back_project(small, np.stack([u, v], axis=1).astype(np.float32), view.depth[v, u])
        cells = np.floor(transform(T_anchor_camera, points) / CELL).astype(np.int64)
        found.append(np.unique(np.column_stack([view.instance_ids[v, u], cells]), axis=0))
    instance_ids, cells = np.split(np.unique(np.concatenate(found), axis=0), [1], axis=1)
    objects = []
    for k in sorted(classes.keys() & set(np.unique(instance_ids).tolist())):
        points = CELL * (cells[instance_ids[:, 0] == k] + 0.5)
        if len(points) >= MIN_CELLS:
            center = points.mean(axis=0)
            radius = float(np.sqrt(((points - center) ** 2).sum(axis=1).mean()))
            objects.append(ObservedObject(submap.number, k, classes[k][0], center, radius, len(points)))
    return objects


def object_edges(
    first: Sequence[ObservedObject], second: Sequence[ObservedObject], anchors: Sequence[Float64]
) -> list[ObjectEdge]:
    """Return the edges from the objects of some submaps to the same objects of others.

    Args:
        first: The objects of the submaps that do not move.
        second: The objects of the other submaps.
        anchors: The poses (4, 4) of all anchors after the correction by a loop.
    """
    shared: dict[tuple[int, int], list[SharedObject]] = {}
    for pair in shared_objects(first, second, anchors):
        shared.setdefault((pair.first.submap, pair.second.submap), []).append(pair)
    return [_edge(pairs, inverse(anchors[a]) @ anchors[b]) for (a, b), pairs in sorted(shared.items())]


def shared_objects(
    first: Sequence[ObservedObject], second: Sequence[ObservedObject], anchors: Sequence[Float64]
) -> list[SharedObject]:
    """Return the objects that are observed in both groups of submaps: the mutually nearest ones of equal class.

    An object that several submaps of a group observe counts once, in the submap that sees most of it.

    Args:
        first: The objects of some submaps.
        second: The objects of other submaps.
        anchors: The poses (4, 4) of all anchors, which are close to the true ones.
    """
    groups = [_without_repetition(group, anchors) for group in (first, second)]
    if not all(groups):
        return []
    positions = [_positions(group, anchors) for group in groups]
    classes = [np.array([one.class_id for one in group]) for group in groups]
    apart = np.linalg.norm(positions[0][:, None] - positions[1], axis=2)
    apart[classes[0][:, None] != classes[1]] = np.inf
    nearest = apart.argmin(axis=1)
    return [
        SharedObject(groups[0][k], groups[1][j])
        for k, j in enumerate(nearest)
        if apart[k, j] <= MAX_APART
        and apart[:, j].argmin() == k
        and groups[0][k].instance_id != groups[1][j].instance_id  # otherwise, it was not mapped twice
    ]


def _without_repetition(objects: Iterable[ObservedObject], anchors: Sequence[Float64]) -> list[ObservedObject]:
    """Return the objects that are not near a larger one of the same class."""
    kept: list[ObservedObject] = []
    for one in sorted(objects, key=lambda one: -one.cells):
        alike = [other for other in kept if other.class_id == one.class_id]
        apart = np.linalg.norm(_positions(alike, anchors) - _positions([one], anchors), axis=1)
        if (apart > MAX_APART).all():
            kept.append(one)
    return kept


def _positions(objects: Sequence[ObservedObject], anchors: Sequence[Float64]) -> Float64:
    """Return the positions (K, 3) of objects in the world frame, m."""
    return np.array([transform(anchors[one.submap], one.position) for one in objects]).reshape(-1, 3)


def _edge(pairs: Sequence[SharedObject], T_first_second: Float64) -> ObjectEdge:
    """Return the edge that aligns the objects of two submaps, by robust least squares.

    Args:
        pairs: The objects.
        T_first_second: The initial transform (4, 4).
    """
    p_first = np.array([pair.first.position for pair in pairs])
    p_second = np.array([pair.second.position for pair in pairs])
    variances = np.array([pair.first.variance + pair.second.variance for pair in pairs])
    J = np.array([np.hstack([-skew(p), np.eye(3)]) for p in p_second])
    for _ in range(ITERATIONS):
        residuals = transform(inverse(T_first_second), p_first) - p_second
        weights = variances / (variances + (residuals**2).sum(axis=1)) ** 2  # as in the line process, per variance
        H = np.einsum("k,kia,kib->ab", weights, J, J)
        rotation, translation = np.split(np.linalg.pinv(H, 1e-6) @ np.einsum("k,kia,ki->a", weights, J, residuals), 2)
        T_first_second = T_first_second @ exp_se3(np.concatenate([translation, rotation]))
    edge = (pairs[0].first.submap, pairs[0].second.submap, T_first_second)
    return ObjectEdge(*edge, information=H, is_loop=True, objects=len(pairs))
