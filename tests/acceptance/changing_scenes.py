"""Maps of sequences with people."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from framework.api import begin, load_map, open_dataset
from framework.config.composition import composed
from framework.data import LIKELY, Float32, Float64, Int32
from framework.evaluation.trajectory import evaluate
from framework.runtime.corrected_frames import TrackedFrame
from framework.synthetic.dynamics import Dynamics
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from tests.acceptance.runner import CHECKOUT

CLOSE = 0.02  # m, maximum distance of a vertex of the person
APART = 0.02  # m, minimum distance of a vertex from all surfaces of the room, such as the floor under the person
ROOM = {"kind": RoomKind.STUDIO, "seed": 0}  # the defaults of dataset=synthetic
PARTS = 10  # number of parts of a sequence whose trajectories are compared


@dataclass(frozen=True)
class PersonRun:
    """Results of a run, with or without a person in its frames."""

    ate: float  # m
    frames_lost: int
    vertices: float  # fraction of the vertices on the person
    instances: int  # number of likely instances of class person

    @classmethod
    def of(cls, dynamics: Dynamics, *overrides: str) -> PersonRun:
        """Map the studio, and print the results."""
        with tempfile.TemporaryDirectory() as directory:
            run = Path(directory, "run")
            chosen = ("dataset=synthetic", f"dataset.dynamics={dynamics.name}", "detector=ground_truth", *overrides)
            subprocess.run(
                [sys.executable, "-m", "framework", *chosen, f"hydra.run.dir={run}"], cwd=CHECKOUT, check=True
            )
            metrics = json.loads((run / "metrics.json").read_text())
            scene = load_map(run / "map.npz").scene
            persons = [
                k for k, (label, score) in scene.most_likely_classes().items()
                if scene.classes[label] == "person" and score >= LIKELY
            ]  # fmt: skip
            found = cls(
                metrics["trajectory.ate_rmse_m"],
                metrics["frames_lost"],
                fraction_on_person(scene.mesh().vertices),
                len(persons),
            )
        print(" ".join(chosen), found, flush=True)
        return found


@functools.cache
def without_person() -> PersonRun:
    return PersonRun.of(Dynamics.NONE)


@functools.cache
def masked() -> tuple[PersonRun, PersonRun]:
    """Return the runs with masking, with detections on every frame and on every fifth."""
    every, fifth = (
        PersonRun.of(Dynamics.PERSON, "masking=people", f"detection_interval={interval}") for interval in (1, 5)
    )
    return every, fifth


def fraction_on_person(vertices: Float32) -> float:
    """Return the fraction of vertices (V, 3) that are close to the person in a frame, and apart from the room."""
    synthetic = Synthetic(**ROOM, dynamics=Dynamics.PERSON, width=80, height=60)  # type: ignore[arg-type]
    person, surfaces = synthetic.moving, synthetic.room.surfaces
    assert person is not None
    on_person = np.zeros(len(vertices), np.bool_)
    for k in range(synthetic.frames):
        own = person.vertices_at(k)
        inside = (vertices > own.min(axis=0) - CLOSE) & (vertices < own.max(axis=0) + CLOSE)
        candidates = np.flatnonzero(inside.all(axis=1) & ~on_person)
        on_person[candidates] = distances(vertices[candidates], own, person.surfaces.triangles) < CLOSE
    candidates = np.flatnonzero(on_person)
    apart = distances(vertices[candidates], surfaces.vertices, surfaces.triangles) > APART
    return float(np.count_nonzero(apart) / len(vertices))


def distances(points: Float32, vertices: Float32, triangles: Int32) -> Float32:
    """Return the distance (N,) of points (N, 3) from a triangle mesh, m."""
    if not len(points):
        return np.zeros(0, np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles.astype(np.uint32)))
    return np.asarray(scene.compute_distance(o3d.core.Tensor(points)).numpy(), np.float32)


@dataclass(frozen=True)
class MaskingEffect:
    """Differences between a run with masking and one without."""

    ate_changes: Float64  # (PARTS,) relative change of the ATE of each part
    additional_lost: int  # number of additional lost frames

    @classmethod
    def on(cls, root: Path, *detector: str) -> MaskingEffect:
        """Map a TUM RGB-D sequence with masking and without."""
        (ates, lost), (ates_without, lost_without) = (
            part_errors(
                begin(composed("~dataset", *detector, f"masking={name}"))
                .run(open_dataset("tum_rgbd", root=root))
                .tracked
            )
            for name in ("people", "none")
        )
        return cls(ates / ates_without - 1, lost - lost_without)


def part_errors(frames: Sequence[TrackedFrame]) -> tuple[Float64, int]:
    """Return the ATE of each part of a sequence (PARTS,), m, and the number of lost frames."""
    parts = [frames[k * len(frames) // PARTS : (k + 1) * len(frames) // PARTS] for k in range(PARTS)]
    ates = [evaluate([it.T_world_camera_truth for it in part], [it.pose for it in part]).ate_rmse_m for part in parts]
    return np.array(ates), sum(it.pose.lost for it in frames)
