"""Tests for the fuser of preset=paper, compared with slow references in float64."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from framework.data import Bool, Float64, Frame, Int32, PointClusters, Pose
from framework.geometry import inverse
from framework.mapping.instance_map import InstanceMap
from framework.mapping.instances.association import InstanceSource, Matches
from framework.mapping.instances.overlaps import OverlapRule
from framework.mapping.labels.class_slots import NO_CLASS
from framework.mapping.labels.evidence_rows import Storage
from framework.mapping.labels.pixel_lists import PixelLists, list_points_by_pixel
from framework.refinement.lifting import lift
from plugins.fusers.bayesian_tsdf import MIN_LIKELIHOOD, RULE, BayesianTsdf
from tests.support.registered import built
from tests.support.scenes.analytic_scene import Scene, pose, room, walk
from tests.support.true_masks import detections_of, fuse_masks, masks_of

VOXEL = 0.02  # m
SCORES = (0.9, 0.6, 0.35)
PROBABILITIES = [(0.8, 0.2), (0.35, 0.65), (0.5, 0.5)]


def paper_fuser(*overrides: str) -> BayesianTsdf:
    """Return fuser=bayesian_tsdf_paper with a voxel size for the small test camera."""
    fuser = built("fuser", "bayesian_tsdf_paper", f"fuser.voxel_size={VOXEL}", "fuser.max_depth=4", *overrides)
    assert isinstance(fuser, BayesianTsdf)
    return fuser


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(4))]


# Association


def slow_matches(fuser: BayesianTsdf, frame: Frame, clusters: PointClusters) -> list[int]:
    """Return the instance of each cluster, 0 = new or none. Complete masks are compared with the ray-cast view."""
    assert frame.T_world_camera is not None
    seen = fuser.scene.render(frame.camera, frame.T_world_camera).instance_ids
    ids = sorted(set(np.unique(seen).tolist()) - {0})
    masks = np.zeros((len(clusters), *frame.depth.shape), np.bool_)
    for (u, v), k in zip(clusters.pixels, clusters.cluster, strict=True):
        masks[k, v, u] = True
    pairs = []
    for k, mask in enumerate(masks):
        for i in ids:
            both, cluster, instance = (int(of.sum()) for of in (mask & (seen == i), mask, seen == i))
            least = fuser.association.create_points
            if both / max(min(cluster, instance), least) > fuser.association.min_overlap:
                pairs.append((-both / max(cluster + instance - both, least), i, k))
    matched: dict[int, int] = {}
    for _, i, k in sorted(pairs):
        if k not in matched and i not in matched.values():
            matched[k] = i
    return [matched.get(k, 0) for k in range(len(clusters))]


def test_paper_fuser_association_agrees_with_slow_reference(frames: list[Frame]) -> None:
    fuser = paper_fuser()
    assert fuser.association.association is InstanceSource.RAYCAST
    assert fuser.association.overlap_rule is OverlapRule.SMALLER
    for k, frame in enumerate(frames):
        masks = [np.roll(mask, 7 * k, axis=1) for mask in masks_of(frame)]
        detections = detections_of(frame, masks, SCORES)
        assert frame.T_world_camera is not None
        clusters = lift(detections, frame, Pose(frame.T_world_camera))
        known = fuser.scene.table.last_id
        _, matches = fuser.association.match(fuser.scene, frame, Pose(frame.T_world_camera), clusters)
        found = np.where(matches.instance_ids <= known, matches.instance_ids, 0)
        assert found.tolist() == slow_matches(fuser, frame, clusters)
        fuse_masks(fuser, frame, masks, SCORES)
        assert k == 0 or found.any()


@pytest.mark.parametrize(("source", "found"), [("RAYCAST", True), ("SURFACE_LOOKUP", False)])
def test_paper_fuser_new_surface_votes_for_occluded_instance(source: str, found: bool) -> None:
    """A new sphere appears in front of the mapped sphere."""
    behind, front = (Scene([(np.array([0.0, 0.0, -1.0]), -2.5)], [(np.array([0.0, 0.0, z]), 0.35)]) for z in (2.0, 1.6))
    fuser = paper_fuser(f"fuser.association={source}")
    fuse_masks(fuser, behind.frame(pose(), 0), masks_of(behind.frame(pose(), 0)), [0.9])
    after = front.frame(pose(), 1)
    fuse_masks(fuser, after, masks_of(after), [0.9])
    assert (fuser.scene.table.last_id == 1) == found


# Bayesian recursions


@dataclasses.dataclass
class RecordedMatches:
    """Points and matches of all frames that a fuser has fused."""

    points: list[PixelLists]
    matches: list[Matches]


def recorded(fuser: BayesianTsdf, monkeypatch: pytest.MonkeyPatch) -> RecordedMatches:
    found, match = RecordedMatches([], []), fuser.association.match

    def recording(scene: InstanceMap, frame: Frame, at: Pose, clusters: PointClusters) -> tuple[PixelLists, Matches]:
        points, matches = match(scene, frame, at, clusters)
        found.points.append(points)
        found.matches.append(matches)
        return points, matches

    monkeypatch.setattr(fuser.association, "match", recording)
    return found


def labeled_voxels(scene: InstanceMap) -> tuple[Int32, Float64]:
    """Return the indices (L,) and the positions (L, 3), m, of the labeled voxels."""
    grid, labels = scene.volume.voxels.grid, scene.labels
    blocks = np.flatnonzero(grid.label_row[: scene.volume.voxels.block_count] >= 0)
    labeled = labels.evidence.labeled[grid.label_row[blocks]]
    which, n = np.nonzero(labeled >= 0)
    inside = np.stack([n & 7, n >> 3 & 7, n >> 6], axis=1)
    return labeled[which, n], (8 * grid.block_coords[blocks[which]] + inside) * float(grid.voxel_size)


def slow_distributions(
    fuser: BayesianTsdf, frame: Frame, position: Float64, masks: list[list[Bool]], matches: list[Matches]
) -> tuple[Float64, Float64] | None:
    """Return the class and instance distributions of a voxel by eqs. (6) to (8), where instance 0 = none.

    The result is None if it depends on rounding.
    """
    assert frame.T_world_camera is not None
    x, y, z = (inverse(frame.T_world_camera) @ [*position, 1.0])[:3]
    u, v = (frame.camera.fx * x / z + frame.camera.cx, frame.camera.fy * y / z + frame.camera.cy)
    column, row = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    band = fuser.voxels.hashing.near - abs(float(frame.depth[row, column]) - z)
    if min(abs(u + 0.5 - round(u + 0.5)), abs(v + 0.5 - round(v + 0.5))) < 1e-3 or abs(band) < 1e-5:
        return None
    classes = np.full(2, 0.5)
    last = max(int(found.instance_ids.max()) for found in matches)
    instances = np.full(last + 1, 1 / (last + 1))
    floor, known = fuser.class_floor, 0
    for of_frame, found in zip(masks, matches, strict=True):
        known = max(known, int(found.instance_ids.max()))
        for k, mask in enumerate(of_frame):
            if not mask[row, column] or band < 0:
                continue
            p = found.clusters.class_probabilities[k].astype(np.float64)
            classes = classes * ((1 - floor) * p + floor / 2)
            classes /= classes.sum()
            i, score = found.instance_ids[k], float(found.clusters.scores[k])
            if i:
                likelihood = np.full(last + 1, (1 - score) / known)
                likelihood[i] = score
                instances = instances * likelihood
                instances /= instances.sum()
    return classes, instances


@pytest.mark.parametrize(("storage", "tolerance"), [("EXACT", 1e-4), ("COMPACT", 0.03)])
def test_paper_fuser_recursions_agree_with_slow_reference(
    frames: list[Frame], storage: str, tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    fuser = paper_fuser(f"fuser.storage={storage}", "fuser.create_score=0.4")
    assert fuser.voxels.storage is Storage[storage]
    found, frame, seen = recorded(fuser, monkeypatch), frames[0], []
    for k in range(4):
        whole = masks_of(frame)
        # two masks overlap, and the score of the last one is too low
        masks = [whole[0] | whole[1], np.roll(whole[1], k, axis=0), whole[2]]
        seen.append(masks)
        fuse_masks(fuser, dataclasses.replace(frame, index=k), masks, SCORES, PROBABILITIES)
    assert any((matches.instance_ids == 0).any() for matches in found.matches), "expected an unmatched mask"
    evidence, scale = fuser.scene.labels.evidence, fuser.scene.labels.score_scale
    voxels, positions = labeled_voxels(fuser.scene)
    compared = np.random.default_rng(0).permutation(len(voxels))[:2000]
    checked = several = 0
    for voxel, position in zip(voxels[compared], positions[compared], strict=True):
        expected = slow_distributions(fuser, frame, position, seen, found.matches)
        if expected is None:
            continue
        classes, instances = expected
        values = np.zeros(2)
        for label, value in zip(evidence.class_ids[voxel], evidence.class_value[voxel], strict=True):
            if label:
                values[label - 1] = value / scale
        assert values[0] - values[1] == pytest.approx(np.log(classes[0] / classes[1]), abs=4 * tolerance)
        stored = {
            int(i): float(value)
            for i, value in zip(evidence.instance_ids[voxel], evidence.instance_value[voxel], strict=True)
            if i
        }
        for i in range(1, len(instances)):
            assert stored.get(i, 0.0) == pytest.approx(np.log(instances[i] / instances[0]), abs=1e-4)
        checked += 1
        several += len(stored) > 1
    assert checked > 1000
    assert several > 50


def test_paper_fuser_zero_instance_floor_splits_remainder(frames: list[Frame]) -> None:
    fuser = paper_fuser()
    assert fuser.instance_floor == 0
    at = Pose(pose())
    clusters = lift(detections_of(frames[0], masks_of(frames[0]), (1.0, 0.5, 0.2)), frames[0], at)
    ratios = np.exp(fuser.evidence(clusters, 4).instances.astype(np.float64))
    expected = [(1 - MIN_LIKELIHOOD) * 4 / MIN_LIKELIHOOD, 4.0, 0.2 * 4 / 0.8]
    np.testing.assert_allclose(ratios, expected, rtol=1e-4)


# Class of an instance


def roll_classes(scene: InstanceMap, shift: int) -> None:
    """Shift the class evidence of every voxel by `shift` classes."""
    used = scene.labels.in_use()
    named = used.class_ids != NO_CLASS
    used.class_ids[named] = (used.class_ids[named] - 1 + shift) % len(scene.classes) + 1
    scene.relabel()


@pytest.mark.parametrize(("source", "changes"), [("VOXELS", True), ("DETECTIONS", False)])
def test_paper_fuser_voxel_evidence_sets_instance_class(frames: list[Frame], source: str, changes: bool) -> None:
    fuser = paper_fuser(f"fuser.instance_class={source}")
    for frame in frames:
        fuse_masks(fuser, frame, masks_of(frame), SCORES, PROBABILITIES)
    before = {k: int(found.class_probabilities.argmax()) for k, found in fuser.scene.instances().items()}
    roll_classes(fuser.scene, 1)
    after = {k: int(found.class_probabilities.argmax()) for k, found in fuser.scene.instances().items()}
    assert before.keys() == after.keys() != set()
    assert (before != after) == changes


def test_paper_fuser_instance_class_is_sum_over_its_voxels(frames: list[Frame], tmp_path: Path) -> None:
    fuser = paper_fuser()
    for frame in frames:
        fuse_masks(fuser, frame, masks_of(frame), SCORES, PROBABILITIES)
    scene, used = fuser.scene, fuser.scene.labels.in_use()
    sums = np.zeros((scene.table.last_id + 1, 2))
    for voxel in range(len(used.class_ids)):
        values = used.instance_value[voxel]
        ids = [int(i) for i in used.instance_ids[voxel] if i and scene.confirmation.is_met(scene.table.records[int(i)])]
        best = max(ids, key=lambda i: (values[used.instance_ids[voxel].tolist().index(i)], -i), default=0)
        if best and values[used.instance_ids[voxel].tolist().index(best)] > 0:
            for label, value in zip(used.class_ids[voxel], used.class_value[voxel], strict=True):
                if label:
                    sums[best, label - 1] += value / scene.labels.score_scale
    scene.save(tmp_path / "map.npz")
    for of in (scene, InstanceMap.load(tmp_path / "map.npz")):
        evidence = of.class_evidence()
        assert len(evidence) == 3
        for k, found in evidence.items():
            np.testing.assert_allclose(found, sums[k], rtol=1e-12)


def test_paper_fuser_unmatched_masks_update_classes_only_if_set(frames: list[Frame]) -> None:
    for setting, rows in (("true", True), ("false", False)):
        fuser = paper_fuser(f"fuser.update_unmatched={setting}")
        fuse_masks(fuser, frames[0], masks_of(frames[0])[:1], [0.1])
        assert fuser.scene.table.last_id == 0
        assert (fuser.scene.labels.row_count > 0) == rows
        assert not fuser.scene.render(frames[0].camera, pose()).instance_ids.any()


def test_paper_fuser_pixels_of_all_masks_are_listed(frames: list[Frame]) -> None:
    """In the paper, each mask is a separate update."""
    fuser = paper_fuser()
    whole, small = masks_of(frames[0])[0], masks_of(frames[0])[0].copy()
    small[:, : int(np.median(np.nonzero(whole)[1]))] = False
    at = Pose(pose())
    clusters = lift(detections_of(frames[0], [whole, small], [0.9, 0.8]), frames[0], at)
    points, matches = fuser.association.match(fuser.scene, frames[0], at, clusters)
    evidence = fuser.evidence(clusters, 2)
    measurement = fuser.voxels.measurement(fuser.scene.table, points, matches, evidence, RULE)
    expected = list_points_by_pixel(clusters, frames[0].depth.shape)
    np.testing.assert_array_equal(measurement.clusters, expected.clusters)
