"""Faults in single stages of runs of synthetic rooms, and their explanations."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial

from framework.commands.results.explain import pipeline_of
from framework.config.composition import composed, resolved
from framework.data import Frame, SceneTruth
from framework.explanation.replay import Explanation
from framework.interfaces import RGBDSequence, RGBDVideo
from framework.registry import build
from tests.support.stage_faults import Fault, FaultTest, halve, hide, jump, merge

SCENES = ("room0", "room1", "room2")
SETTINGS = (
    *("dataset=synthetic", "dataset.frames=60", "dataset.stride=3", "dataset.width=320", "dataset.height=240"),
    *("detector=simulated_yolo11n", "tracker=ground_truth", "fuser.voxel_size=0.02"),
)
METRIC = "instances.mean_iou"  # unlike AP50 of a class, it does not couple the objects of a class
JUMP = 6, (0.2, 0.2, 0.0)  # first frame and motion, m


@dataclass(frozen=True)
class ExplainedFault:
    """The explanation of a run with one fault, compared with the run without it."""

    scene: str
    stage: str  # faulty stage
    lost: dict[int, str]  # cause of each object that only the run with the fault has lost, by id
    possible: tuple[int, ...]  # objects that the fault can affect; () = all
    fraction: float  # fraction of the additional loss that is attributed to the faulty stage
    rest: float  # difference between the loss and the sum of the contributions

    @property
    def named(self) -> bool:
        """True if objects are lost, and the cause of all of them is the faulty stage."""
        return bool(self.lost) and set(self.lost.values()) == {self.stage}


@cache
def explained_faults() -> tuple[ExplainedFault, ...]:
    """Return the explanations of four faults in each scene."""
    return tuple(found for scene in SCENES for found in faults_in(scene))


def faults_in(scene: str) -> Iterator[ExplainedFault]:
    with fault_test(scene) as test:
        assert test.truth is not None
        found = sorted(
            (one for one in test.explanation.objects if one.cause is None and one.id in test.truth.class_names),
            key=lambda one: -one.figures.iou,
        )
        best = [one.id for one in found if one.figures.iou > 0]
        for fault in (hide(best[0]), halve(best[0], test.truth), merge(best[0], best[1]), jump(*JUMP)):
            result = explained(test, scene, fault)
            print(result, flush=True)
            yield result


def explained(test: FaultTest, scene: str, fault: Fault) -> ExplainedFault:
    explanation: Explanation = test.with_fault(fault)
    contributions = explanation.contributions
    assert contributions is not None
    rest = abs(contributions.loss - sum(contributions.named().values()))
    fraction = test.fraction_of_loss(fault, explanation)
    return ExplainedFault(scene, fault.stage.value, test.lost(explanation), fault.objects, fraction, rest)


@dataclass
class Recorded(RGBDSequence):
    """The frames of a sequence in memory, so that they are rendered only once."""

    sequence: RGBDSequence

    def __post_init__(self) -> None:
        self.name, self.camera, self.domain = self.sequence.name, self.sequence.camera, self.sequence.domain
        self.frames, self.truth = list(self.sequence), self.sequence.scene_truth()

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Frame:
        return self.frames[k]

    def scene_truth(self) -> SceneTruth | None:
        return self.truth


@contextmanager
def fault_test(scene: str) -> Iterator[FaultTest]:
    """Yield the run of a scene without faults. Its detections are cached until the context ends."""
    config = composed(*SETTINGS, f"dataset.scene={scene}")
    video = build(RGBDVideo, config.dataset)
    assert isinstance(video, RGBDSequence)
    with tempfile.TemporaryDirectory() as detections:
        yield FaultTest(Recorded(video), partial(pipeline_of, resolved(config), detections), METRIC)
