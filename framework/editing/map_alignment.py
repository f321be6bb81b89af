"""Alignment of two overlapping maps.

Keyframes give the transform between the maps, and ICP of the surfaces refines it. A wrong transform ruins a map, so the
result is verified: the cameras of each map must see the surface of the other map where it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from framework.data import Float64
from framework.editing.keyframe_registration import MIN_INLIERS, match_keyframes, register
from framework.editing.surface_registration import registered
from framework.errors import DataError
from framework.geometry import inverse, transform
from framework.queries.changes import Visit, look_for
from framework.rendering.surface import Surface
from framework.tracking.keyframes import Keyframe

# maximum inliers of the best different transform, fraction of the inliers; repeated rooms have 1
MAX_OTHER_INLIERS = 0.5
CHECKED = 5000  # approximate number of vertices of each map that are compared with the other map
MIN_SEEN = 0.05  # minimum fraction of the vertices of each map that the cameras of the other map see
# Minimum fraction of the seen vertices that are on the surface of the other map. Overlapping parts of real recordings
# have 0.86 to 0.96, different rooms have 0.14 to 0.42, and an error of 0.2 m has 0.11 to 0.79 in one of the directions.
MIN_AGREEMENT = 0.8


@dataclass(frozen=True)
class KeyframedMap:
    """A map with the camera poses of its frames and its keyframes."""

    visit: Visit
    keyframes: Sequence[Keyframe]


def align_maps(a: KeyframedMap, b: KeyframedMap) -> Float64:
    """Return the transform T_a_b (4, 4) between the world frames of two maps.

    Raises:
        DataError: The maps do not overlap, or the transform is uncertain.
    """
    if not a.keyframes or not b.keyframes:
        raise DataError(f"expected keyframes in both runs, got {len(a.keyframes)} and {len(b.keyframes)}")
    found = register(match_keyframes(a.keyframes, b.keyframes))
    if found is None:
        raise DataError(f"expected an overlap with at least {MIN_INLIERS} consistent feature matches, got fewer")
    count = len(found.matches.points_a)
    if found.other_inliers > MAX_OTHER_INLIERS * count:
        raise DataError(f"expected one transform, got two with {count} and {found.other_inliers} feature matches")
    surface_a, surface_b = (
        Surface(mesh.vertices, mesh.triangles) for mesh in (a.visit.scene.mesh(), b.visit.scene.mesh())
    )
    T_a_b = registered(surface_a, surface_b, found.T_a_b, found.matches)
    check_agreement(a.visit, b.visit, T_a_b)
    return T_a_b


def check_agreement(a: Visit, b: Visit, T_a_b: Float64) -> None:
    """Raise DataError unless the cameras of each map see the surface of the other map where it is."""
    for visit, other, T_world_other in ((a, b, T_a_b), (b, a, inverse(T_a_b))):
        vertices = other.scene.mesh().vertices
        sampled = vertices[:: max(1, len(vertices) // CHECKED)].astype(np.float64)
        there, through = look_for(visit, transform(T_world_other, sampled).astype(np.float32))
        seen = int(np.count_nonzero(there | through))
        if not seen or seen < MIN_SEEN * len(sampled):
            found = seen / max(len(sampled), 1)
            raise DataError(f"expected an overlap of at least {MIN_SEEN:.0%}, got {found:.0%}")
        agreement = np.count_nonzero(there) / seen
        if agreement < MIN_AGREEMENT:
            raise DataError(
                f"expected surfaces that agree on at least {MIN_AGREEMENT:.0%} of the overlap, got {agreement:.0%}"
            )
