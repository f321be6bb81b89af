"""A run's objects against the true ones: which are right, wrong, false and missed, each to be shown with a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from framework.data import SceneTruth, UInt8
from framework.evaluation.instances import (
    MAX_DISTANCE,
    Judgement,
    PredictedInstances,
    judge,
    transfer_labels,
)
from framework.reporting.map_scene import MapScene
from framework.reporting.pictures import Photographer, Picture
from framework.reporting.run_contents import RunContents
from framework.reporting.source_frames import Footage
from framework.reporting.visibility import sightings

TRUE_COLOR = (255, 196, 0)  # the outline of what was missed


@dataclass(frozen=True)
class Missed:
    """A true instance that no prediction of its class found."""

    id: int
    class_name: str
    picture: Picture | None  # None = nothing was mapped there


@dataclass(frozen=True)
class TruthCheck:
    """What became of every object, and what was missed."""

    judgements: Mapping[int, Judgement]  # by object
    missed: tuple[Missed, ...]

    @classmethod
    def of(
        cls,
        contents: RunContents,
        truth: SceneTruth,
        scene: MapScene | None,
        photographer: Photographer | None,
        footage: Footage,
    ) -> TruthCheck | None:
        """None where the record has no mesh, or the objects no classes."""
        if contents.mesh is None:
            return None
        objects = contents.objects
        predictions = PredictedInstances.on_mesh(
            contents.mesh,
            [one.id for one in objects],
            [one.confidence for one in objects],
            [one.class_name for one in objects],
        )
        judged, missed = judge(predictions, truth)
        pictures = _pictures_of_true(truth, list(missed), scene, photographer, footage)
        return cls(
            {one.id: one for one in judged},
            tuple(Missed(key, name, pictures.get(key)) for key, name in sorted(missed.items())),
        )


def _pictures_of_true(
    truth: SceneTruth, ids: list[int], scene: MapScene | None, photographer: Photographer | None, footage: Footage
) -> dict[int, Picture]:
    """Of true instances, with the part of each that was mapped outlined."""
    if scene is None or photographer is None or not ids:
        return {}
    true_ids = transfer_labels(truth.points_world, truth.instance_ids, scene.mesh.vertices, MAX_DISTANCE)
    labels = np.where(np.isin(true_ids, ids), true_ids, 0).astype(np.int32)
    best = sightings(scene.mesh, labels, scene.contents.poses, footage.camera, footage.clarity).best
    color: UInt8 = np.array(TRUE_COLOR, np.uint8)
    return photographer.pictures(labels, best, dict.fromkeys(best, color))
