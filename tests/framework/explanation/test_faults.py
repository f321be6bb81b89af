"""Tests of explanations: a fault is injected into one stage of a run that finds all objects."""

from __future__ import annotations

import pytest

from framework.explanation.causes import State
from framework.explanation.contributions import Contributions, Stage
from framework.mapping.instances.association import InstanceSource
from framework.pipeline import Pipeline
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.refiners.ground_truth import GroundTruthRefiner
from plugins.trackers.ground_truth import GroundTruth
from tests.support.scenes.corner_room import CornerRoom, KeepAll, SphereDetector
from tests.support.stage_faults import Fault, FaultTest, halve, hide, jump, merge

pytestmark = pytest.mark.integration


def stages(replaced: frozenset[Stage]) -> Pipeline:
    """Return the stages that map the corner room. They have no errors that the ground truth could remove."""
    refiner = GroundTruthRefiner() if Stage.REFINEMENT in replaced else KeepAll()
    source = InstanceSource.GROUND_TRUTH if Stage.ASSOCIATION in replaced else InstanceSource.SURFACE_LOOKUP
    fuser = assemble(BayesianTsdf, voxel_size=0.03, min_observations=2, association=source)
    return Pipeline(SphereDetector(), GroundTruth(), refiner, fuser, prefetch=0)


@pytest.fixture(scope="module")
def without_fault() -> FaultTest:
    return FaultTest(CornerRoom(frames=6), stages)


def test_explain_run_without_errors_finds_all_objects(without_fault: FaultTest) -> None:
    explanation = without_fault.explanation
    assert [(one.id, one.state, one.cause) for one in explanation.objects] == [
        (1, State.FOUND, None),
        (2, State.FOUND, None),
    ]
    assert not explanation.false_instances
    assert explanation.contributions is not None
    assert explanation.contributions.loss == 0


@pytest.mark.parametrize(
    "fault",
    [
        hide(1),
        halve(2, CornerRoom(frames=6).scene_truth()),  # type: ignore[arg-type]  # not None
        merge(1, 2),
        jump(1, (0.2, 0.2, 0.0)),
    ],
    ids=lambda fault: fault.stage.value,
)
def test_explain_injected_fault_names_stage(without_fault: FaultTest, fault: Fault) -> None:
    explanation = without_fault.with_fault(fault)
    lost = without_fault.lost(explanation)
    assert lost
    assert set(lost.values()) == {fault.stage.value}
    assert lost.keys() <= set(fault.objects or lost)
    assert without_fault.fraction_of_loss(fault, explanation) >= 0.8
    assert isinstance(contributions := explanation.contributions, Contributions)
    assert sum(contributions.named().values()) == pytest.approx(contributions.loss)
