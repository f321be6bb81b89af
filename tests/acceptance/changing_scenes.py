"""Maps of synthetic sequences that change while they are recorded."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

from framework.api import load_map
from framework.data import Float32, Int32
from framework.synthetic.dynamics import Dynamics
from framework.synthetic.room import RoomKind
from framework.synthetic.sequence import Synthetic
from tests.acceptance.runner import CHECKOUT

CLOSE = 0.02  # m, maximum distance of a vertex of the person
APART = 0.05  # m, minimum distance of a vertex from all surfaces of the room, such as the floor under the person
LIKELY = 0.5  # minimum confidence of a likely instance
ROOM = {"kind": RoomKind.STUDIO, "seed": 0}


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
    for k in range(0, synthetic.frames):
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
