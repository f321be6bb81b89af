"""Tests for class-only fusion, compared with a recursion per voxel in float64."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from framework.baselines.semantic_map import SemanticMap, connected_components
from framework.data import Detections, Frame, Int32, Pose
from framework.errors import ConfigError, DataError
from framework.mapping.instance_map import FORMAT
from framework.mapping.instances.instance_list import MIN_VERTICES
from framework.refinement.lifting import lift
from framework.registry import assemble
from plugins.fusers.bayesian_tsdf import BayesianTsdf
from plugins.fusers.class_only_fusion import ClassOnlyFusion
from tests.support.scenes import box_scene
from tests.support.scenes.analytic_scene import CAMERA, room, walk
from tests.support.scenes.box_scene import BoxScene, look_from
from tests.support.thread_counts import by_one_thread_and_two
from tests.support.true_masks import CLASSES, PROBABILITIES, fuse_masks, masks_of

VIEWS = [look_from(x, -1.5, 1.6, (0.0, 1.0, 0.3)) for x in (-1.0, -0.3, 0.4, 1.1)]
LEFT, RIGHT = (-0.6, 0.8, 0.0, -0.1, 1.2, 0.5), (0.2, 0.8, 0.0, 0.7, 1.2, 0.5)
SECOND_FOUND = (1, 3, 5)  # frames in which the second sphere is detected
TOUCHING = (-0.1, 0.8, 0.0, 0.4, 1.2, 0.5)  # touches the left box


def new_fuser(**parameters: object) -> ClassOnlyFusion:
    return assemble(ClassOnlyFusion, voxel_size=0.03, max_depth=4.0, **parameters)


def mapped_boxes(boxes: list[box_scene.Box], class_ids: list[int]) -> SemanticMap:
    """Map boxes on the floor from all views with true masks.

    A side of a box with few visible pixels is a separate component, which `min_area` excludes.
    """
    scene, fuser = BoxScene([[box] for box in boxes]), new_fuser(min_area=0.03)
    for k, T in enumerate(VIEWS):
        frame = scene.frame(T, k)
        assert frame.truth is not None
        masks = [frame.truth.instance_ids == i for i in range(1, len(boxes) + 1)]
        fuser.fuse(frame, Pose(T), lift(box_scene.detected(masks, class_ids), frame, Pose(T)))
    return fuser.scene


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [room().frame(T, k) for k, T in enumerate(walk(10))]


@pytest.fixture(scope="module")
def mapped(frames: list[Frame]) -> SemanticMap:
    """Map three spheres.

    The first one is detected in all frames, the second one in three, and the third one in none.
    """
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        found = 1 + (k in SECOND_FOUND)
        fuse_masks(fuser, frame, masks_of(frame)[:found], [0.6, 0.68][:found])
    return fuser.scene


# Components


def test_class_only_separate_boxes_are_two_instances() -> None:
    instances = mapped_boxes([LEFT, RIGHT], [0, 0]).instances()
    assert list(instances) == [1, 2]
    for instance, box in zip(sorted(instances.values(), key=lambda i: i.aabb.center[0]), [LEFT, RIGHT], strict=True):
        np.testing.assert_allclose(instance.aabb.center[[0, 2]], np.add(box[:3], box[3:])[[0, 2]] / 2, atol=0.06)
        assert instance.class_probabilities.argmax() == 0


def test_class_only_touching_boxes_are_one_instance() -> None:
    [instance] = mapped_boxes([LEFT, TOUCHING], [0, 0]).instances().values()
    assert instance.aabb.extent[0] == pytest.approx(1.0, abs=0.1)


def test_class_only_touching_classes_are_two_instances() -> None:
    scene = mapped_boxes([LEFT, TOUCHING], [0, 1])
    instances = scene.instances()
    assert sorted(i.class_probabilities.argmax() for i in instances.values()) == [0, 1]
    mesh = scene.mesh()
    for instance in instances.values():
        assert set(mesh.class_ids[instance.vertices]) == {instance.class_probabilities.argmax()}
        assert instance.aabb.extent[0] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("when", [0, 9])
def test_class_only_single_false_detection_is_removed(frames: list[Frame], when: int) -> None:
    fuser = new_fuser()
    for k, frame in enumerate(frames):
        found = [masks_of(frame)[0]] if k == when else []
        fuse_masks(fuser, frame, found, [0.5] * len(found))
        if when == k == 0:
            assert len(fuser.scene.instances()) == 1
    assert not fuser.scene.instances()
    class_ids = fuser.scene.render(CAMERA, walk(10)[5]).class_ids
    assert (class_ids >= 0).sum() < 0.01 * masks_of(frames[5])[0].sum(), "expected only points at the silhouette"


def test_class_only_absence_ratio_of_one_ignores_unmasked_frames(frames: list[Frame]) -> None:
    fuser = new_fuser(absence_likelihood_ratio=1.0)
    for k, frame in enumerate(frames):
        found = [masks_of(frame)[0]] if k == 0 else []
        fuse_masks(fuser, frame, found, [0.6] * len(found))
    assert len(fuser.scene.instances()) == 1


def test_class_only_instance_below_min_area_is_excluded(frames: list[Frame]) -> None:
    fuser = new_fuser(min_area=40.0)
    fuse_masks(fuser, frames[0], masks_of(frames[0])[:1], [0.6])
    assert not fuser.scene.instances()
    assert (fuser.scene.mesh().class_ids == -1).all()
    assert (fuser.scene.render(CAMERA, walk(10)[0]).class_ids == 0).any(), (
        "expected labels in the view: voxels have no area limit"
    )


# Attributes of an instance


def test_class_only_voxel_evidence_matches_reference(mapped: SemanticMap, frames: list[Frame]) -> None:
    """The reference is eq. (7) over the classes and the background, for each frame in which the voxel is visible."""
    grid, evidence, fuser = mapped.volume.voxels.grid, mapped.labels.evidence, new_fuser()
    rows = np.flatnonzero(grid.label_row[: mapped.volume.voxels.block_count] >= 0)
    rng = np.random.default_rng(0)
    differing = seen = 0
    for block, n in zip(rng.choice(rows, 600), rng.integers(0, 512, 600), strict=True):
        voxel = (8 * grid.block_coords[block] + (n & 7, (n >> 3) & 7, n >> 6)) * 0.03
        log, masked, unmasked = np.zeros(3), 0, 0  # two classes and the background
        for k, frame in enumerate(frames):
            assert frame.T_world_camera is not None
            x, y, z = np.linalg.inv(frame.T_world_camera)[:3] @ [*voxel, 1]
            u, v = (round(f * a / z + c) for f, a, c in ((CAMERA.fx, x, CAMERA.cx), (CAMERA.fy, y, CAMERA.cy)))
            if not (z > 0.2 and 0 <= u < CAMERA.width and 0 <= v < CAMERA.height):
                continue
            if not (0.2 < frame.depth[v, u] < 4.0 and abs(frame.depth[v, u] - z) <= 0.06):
                continue
            under = [mask[v, u] for mask in masks_of(frame)[: 1 + (k in SECOND_FOUND)]]
            if any(under):
                objects = (0.6 if under[0] else 0.68) / max(PROBABILITIES)
                p = [objects * PROBABILITIES[0], objects * PROBABILITIES[1], 1 - objects]
                log += np.log(0.9 * np.array(p) + 0.1 / 3)
                masked += 1
            else:
                log += np.log([fuser.absence_likelihood_ratio, fuser.absence_likelihood_ratio, 1])
                unmasked += 1
        row = grid.label_row[block]
        held = np.zeros(2)
        for label, ratio in zip(evidence.class_ids[row, n], evidence.log_ratio[row, n], strict=True):
            if label:
                held[label - 1] = ratio
        held += np.log(fuser.absence_likelihood_ratio) * evidence.unmasked[block, n]
        seen += masked > 0
        same = (evidence.masked[row, n], evidence.unmasked[block, n]) == (masked, unmasked)
        differing += not (same and np.allclose(held, log[:2] - log[2], atol=1e-3))
    assert seen > 50
    assert differing <= 6, "expected differences only by rounding at pixel borders"


def test_class_only_instance_attributes_match_voxel_reference(mapped: SemanticMap) -> None:
    grid, evidence, mesh = mapped.volume.voxels.grid, mapped.labels.evidence, mapped.mesh()
    voxels = mapped.volume.surface().voxels
    instances = mapped.instances()
    assert list(instances) == (sorted(mapped.instance_ids()))
    assert len(instances) >= 1
    for instance in instances.values():
        posteriors, counts, firsts, lasts = [], [0], [], []
        for block, n in (divmod(int(voxel), 512) for voxel in voxels[instance.vertices]):
            row = grid.label_row[block]
            if row < 0:
                posteriors.append(np.zeros(2))
                continue
            log = np.array([evidence.rest[row, n]] * 2 + [0.0])
            for label, ratio in zip(evidence.class_ids[row, n], evidence.log_ratio[row, n], strict=True):
                if label:
                    log[label - 1] = ratio
            log[:2] += np.log(mapped.elections.absence_likelihood_ratio) * evidence.unmasked[block, n]
            posteriors.append((np.exp(log) / np.exp(log).sum())[:2])
            counts.append(evidence.masked[row, n])
            firsts += [evidence.first_frame[row, n]] if counts[-1] else []
            lasts += [evidence.last_frame[row, n]] if counts[-1] else []
        mean = np.mean(posteriors, axis=0)
        np.testing.assert_allclose(instance.class_probabilities, mean / mean.sum(), atol=1e-4)
        assert instance.confidence == pytest.approx(mean[mesh.class_ids[instance.vertices[0]]], abs=1e-4)
        assert (instance.observations, instance.first_frame, instance.last_frame) == (
            max(counts),
            min(firsts),
            max(lasts),
        )


def test_class_only_detected_spheres_are_instances(mapped: SemanticMap) -> None:
    first, second = sorted(mapped.instances().values(), key=lambda instance: -instance.observations)
    assert (first.observations, first.first_frame, first.last_frame) == (10, 0, 9)
    assert (second.observations, second.first_frame, second.last_frame) == (3, 1, 5)
    center, radius = room().spheres[0]
    points = mapped.mesh().vertices[first.vertices]
    assert np.quantile(np.abs(np.linalg.norm(points - center, axis=1) - radius), 0.9) < 0.03
    view = mapped.render(CAMERA, walk(10)[5])
    assert (view.class_ids[masks_of(room().frame(walk(10)[5]))[0]] == 0).mean() > 0.9
    assert not view.instance_ids.any(), "expected no instance ids: voxels have no instance"


def test_class_only_score_is_probability_of_best_class(frames: list[Frame]) -> None:
    """The probability of the best class is 0.7, so the background wins with score 0.33 but not with 0.6."""
    for score, label in ((0.33, -1), (0.6, 0)):
        fuser = new_fuser()
        fuse_masks(fuser, frames[0], masks_of(frames[0])[:1], [score])
        view = fuser.scene.render(CAMERA, walk(10)[0])
        assert np.median(view.class_ids[masks_of(frames[0])[0]]) == label


# The map


def test_class_only_map_does_not_depend_on_thread_count(frames: list[Frame]) -> None:
    def mapped() -> list[bytes]:
        fuser = new_fuser()
        for frame in frames[:5]:
            fuse_masks(fuser, frame, masks_of(frame), [0.6, 0.5, 0.4])
        mesh, labels = fuser.scene.mesh(), fuser.scene.labels.saved().values()
        return [array.tobytes() for array in (*labels, mesh.vertices, mesh.instance_ids, mesh.class_ids)]

    by_one, by_two = by_one_thread_and_two(mapped)
    assert by_one == by_two


def test_class_only_map_file_round_trip_is_exact(mapped: SemanticMap, tmp_path: Path) -> None:
    mapped.save(tmp_path / "map.npz")
    loaded = SemanticMap.load(tmp_path / "map.npz")
    for name in ("vertices", "triangles", "colors", "instance_ids", "class_ids"):
        assert np.array_equal(getattr(mapped.mesh(), name), getattr(loaded.mesh(), name)), name
    for ours, theirs in itertools.zip_longest(mapped.instances().values(), loaded.instances().values()):
        assert (ours.confidence, ours.observations, ours.last_frame) == (
            theirs.confidence,
            theirs.observations,
            theirs.last_frame,
        )
    assert (loaded.elections, loaded.statistics.bytes) == (mapped.elections, mapped.statistics.bytes)
    loaded.save(tmp_path / "again.npz")
    assert (tmp_path / "map.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_class_only_loaded_map_can_be_extended(frames: list[Frame], tmp_path: Path) -> None:
    whole, resumed = new_fuser(), new_fuser()
    for k, frame in enumerate(frames[:4]):
        if k == 2:
            resumed.scene.save(tmp_path / "map.npz")
            resumed.scene = SemanticMap.load(tmp_path / "map.npz")
            resumed.scene.volume.integrator.frames = k  # the rounding of averages depends on the frame number
        for fuser in (whole, resumed):
            fuse_masks(fuser, frame, masks_of(frame), [0.6, 0.5, 0.4])
    ours, theirs = whole.scene.labels.saved(), resumed.scene.labels.saved()
    assert all(np.array_equal(ours[name], theirs[name]) for name in ours)


def test_class_only_loading_of_instance_map_raises(tmp_path: Path) -> None:
    BayesianTsdf().scene.save(tmp_path / "map.npz")
    with pytest.raises(DataError, match=f"expected map format semantic 5, got {FORMAT}"):
        SemanticMap.load(tmp_path / "map.npz")


def test_class_only_different_label_space_raises(frames: list[Frame]) -> None:
    fuser = new_fuser()
    fuse_masks(fuser, frames[0], [], [])
    assert fuser.scene.classes == CLASSES
    clusters = lift(Detections.none(CAMERA.shape, ("chair",)), frames[1], Pose(np.eye(4)))
    with pytest.raises(DataError, match=r"label space of the map \(length 2\), got a different .* \(length 1\)"):
        fuser.fuse(frames[1], Pose(np.eye(4)), clusters)


def test_class_only_invalid_parameter_raises() -> None:
    for wrong in (
        {"absence_likelihood_ratio": 0.0},
        {"class_floor": 1.0},
        {"smoothness": -1.0},
        {"max_weight": 256.0},
        {"voxel_size": float("nan")},
    ):
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            assemble(ClassOnlyFusion, **wrong)


def with_smoothness(mapped: SemanticMap, tmp_path: Path, smoothness: float) -> SemanticMap:
    """Return the map with this smoothness and without a minimum area."""
    mapped.save(tmp_path / "map.npz")
    scene = SemanticMap.load(tmp_path / "map.npz")
    scene.elections = scene.elections._replace(min_area=0.0, smoothness=smoothness)
    return scene


def slowly_smoothed(scene: SemanticMap, smoothness: float) -> Int32:
    """Return the class ids (V,) after iterated conditional modes, computed vertex by vertex in float64."""
    surface, grid, evidence = scene.volume.surface(), scene.volume.voxels.grid, scene.labels.evidence
    class_ids = scene.mesh().class_ids.tolist()
    neighbors: list[set[int]] = [set() for _ in class_ids]
    for corners in surface.triangles.tolist():
        for one, other in itertools.permutations(corners, 2):
            neighbors[one].add(other)
    before = None
    while class_ids != before:
        before = list(class_ids)
        for v, (block, n) in enumerate(divmod(int(voxel), 512) for voxel in surface.voxels):
            row = grid.label_row[block]
            absent = np.log(scene.elections.absence_likelihood_ratio) * evidence.unmasked[block, n]
            log = [absent + (evidence.rest[row, n] if row >= 0 else 0)] * 2 + [0.0]  # two classes, background
            for label, ratio in zip(evidence.class_ids[row, n], evidence.log_ratio[row, n], strict=True):
                if row >= 0 and label:
                    log[label - 1] = ratio + absent
            values = [
                value + smoothness * sum(class_ids[w] == c for w in neighbors[v])
                for c, value in zip((0, 1, -1), log, strict=True)
            ]
            if max(values) > values[class_ids[v]] + 1e-5:
                class_ids[v] = (0, 1, -1)[int(np.argmax(values))]
    result = np.array(class_ids, np.int32)
    return np.where(connected_components(surface.triangles, result, MIN_VERTICES) > 0, result, -1)


@pytest.mark.parametrize("smoothness", [0.5, 3.0])
def test_class_only_smoothness_matches_icm_reference(mapped: SemanticMap, smoothness: float, tmp_path: Path) -> None:
    plain = with_smoothness(mapped, tmp_path, 0.0)
    expected = slowly_smoothed(plain, smoothness)
    smooth = with_smoothness(mapped, tmp_path, smoothness).mesh().class_ids
    assert (smooth != expected).sum() <= 2, "expected at most two differences: float32 may break a tie differently"
    assert (expected != plain.mesh().class_ids).sum() > 2


def test_class_only_smoothness_shortens_borders(mapped: SemanticMap, tmp_path: Path) -> None:
    borders = []
    for smoothness in (0.0, 0.3, 3.0):
        mesh = with_smoothness(mapped, tmp_path, smoothness).mesh()
        corners = mesh.class_ids[mesh.triangles]
        borders.append(int((corners != corners[:, :1]).any(axis=1).sum()))
    assert borders[0] > borders[1] > borders[2]
