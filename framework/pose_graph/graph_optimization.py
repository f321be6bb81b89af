"""Pose graph of submap anchors, optimized with robust loop edges.

An edge (a, b) has a measured transform T_a_b. Its residual is the twist xi with T_a_b exp(xi) = T_world_a^-1
T_world_b. Open3D minimizes the sum of xi^T C^-1 xi with Levenberg-Marquardt. Loop edges have a line process (Choi, Zhou
and Koltun, "Robust Reconstruction of Indoor Scenes", CVPR 2015), so that those that contradict the others lose their
weight and are removed.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from framework.data import Float64
from framework.geometry import nearest_rotation

# m and rad, standard deviations of a loop, including drift within a submap; only their ratio to those of drift matters
LOOP_NOISE = (0.02, 0.006)
# m, residuals of a loop edge at which its weight is 1/4; decreasing, because all residuals are large at the beginning
# (graduated non-convexity, Yang et al., 2020)
MAX_LOOP_RESIDUALS = (6.0, 0.6, 0.06)
MIN_WEIGHT = 0.25  # minimum weight of a loop edge


@dataclass(frozen=True, eq=False)
class GraphEdge:
    """A measured transform between two anchors."""

    first: int
    second: int
    T_first_second: Float64  # (4, 4)
    information: Float64  # (6, 6) inverse covariance of the twist (rotation, translation), rad and m
    is_loop: bool = False

    @classmethod
    def tracked(cls, first: int, second: int, T_first_second: Float64, covariance: Float64) -> GraphEdge:
        """Return the edge of a tracked motion.

        Args:
            first: The first anchor.
            second: The second anchor.
            T_first_second: The motion (4, 4).
            covariance: The covariance (6, 6) of the twist (translation, rotation) in the frame of the second anchor.
        """
        return cls(first, second, T_first_second, np.roll(np.linalg.inv(covariance), (3, 3), (0, 1)))

    @classmethod
    def loop(cls, first: int, second: int, T_first_second: Float64) -> GraphEdge:
        """Return the edge of a loop between two anchors."""
        return cls(first, second, T_first_second, np.diag(np.repeat(LOOP_NOISE[::-1], 3) ** -2), is_loop=True)

    @property
    def path(self) -> float:
        """The length, m, of the path along which the tracker may have drifted."""
        return 0.0 if self.is_loop else float(np.linalg.norm(self.T_first_second[:3, 3]))


@dataclass
class AnchorGraph:
    """Submap anchors and the edges between them. Anchor 0 is fixed."""

    edges: list[GraphEdge] = field(default_factory=list)

    def connected(self, first: int, second: int) -> bool:
        """Return True if there is an edge between two anchors."""
        return any({edge.first, edge.second} == {first, second} for edge in self.edges)

    def path_lengths(self, anchor: int) -> dict[int, float]:
        """Return the length of the shortest path from one anchor to each, m, by number (Dijkstra's algorithm)."""
        neighbors: dict[int, list[tuple[float, int]]] = {anchor: []}
        for edge in self.edges:
            neighbors.setdefault(edge.first, []).append((edge.path, edge.second))
            neighbors.setdefault(edge.second, []).append((edge.path, edge.first))
        lengths: dict[int, float] = {}
        queue = [(0.0, anchor)]
        while queue:
            length, nearest = heapq.heappop(queue)
            if nearest not in lengths:
                lengths[nearest] = length
                for step, other in neighbors[nearest]:
                    heapq.heappush(queue, (length + step, other))
        return lengths

    def extended(self, poses: Sequence[Float64]) -> list[Float64]:
        """Return the poses (4, 4) of all anchors, given those of the first ones. The others follow by tracked motion.

        Args:
            poses: The poses (4, 4) of the first anchors.
        """
        known = list(poses)
        for edge in self.edges:
            if edge.second == len(known) and not edge.is_loop:
                known.append(known[edge.first] @ edge.T_first_second)
        return known


class Optimized(NamedTuple):
    """An optimized graph."""

    poses: list[Float64]  # (4, 4) of the anchors
    edges: list[GraphEdge]  # without those that the line process has removed


def load_optimizer() -> None:
    """Import Open3D, which takes a second."""
    import open3d  # noqa: F401


def optimize(poses: Sequence[Float64], edges: Sequence[GraphEdge]) -> Optimized:
    """Return the optimized graph.

    Args:
        poses: The poses (4, 4) of the anchors. The first one is fixed.
        edges: The edges between them, which connect all anchors.
    """
    import open3d as o3d  # slow; see load_optimizer

    registration = o3d.pipelines.registration
    graph = registration.PoseGraph()
    for T_world_anchor in poses:
        graph.nodes.append(registration.PoseGraphNode(T_world_anchor))
    for edge in edges:
        graph.edges.append(
            registration.PoseGraphEdge(edge.second, edge.first, edge.T_first_second, edge.information, edge.is_loop)
        )
    # Open3D multiplies the squared distance by the mean information of all edges, not by that of loops
    mean = float(np.mean([edge.information[-1, -1] for edge in edges]))
    for residual in MAX_LOOP_RESIDUALS:
        is_last = residual == MAX_LOOP_RESIDUALS[-1]
        option = registration.GlobalOptimizationOption(
            max_correspondence_distance=residual / (LOOP_NOISE[0] * np.sqrt(mean)),
            edge_prune_threshold=MIN_WEIGHT if is_last else 0.0,
            preference_loop_closure=1.0,
            reference_node=0,
        )
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            option,
        )
    kept = {edge.transformation.tobytes() for edge in graph.edges}
    return Optimized(
        [_rigid(node.pose) for node in graph.nodes],
        [edge for edge in edges if not edge.is_loop or edge.T_first_second.tobytes() in kept],
    )


def _rigid(pose: Float64) -> Float64:
    """Return a pose (4, 4) without rounding errors in its rotation."""
    T = np.array(pose)
    T[:3, :3] = nearest_rotation(T[:3, :3])
    return T
