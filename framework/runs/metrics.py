"""Metrics of a run, as stored in metrics.json."""

from __future__ import annotations

import hashlib
import logging
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from framework.data import AnnotatedObjects, Float64, Instance, InstanceMesh, Pose, SceneTruth
from framework.datasets.ground_truth.scene_truth import LabeledDepth
from framework.errors import DataError
from framework.evaluation import instances, trajectory
from framework.evaluation.compared_classes import Compared, ComparedClasses, indices, listed
from framework.evaluation.doubled_instances import doubled_instances, observed_labels
from framework.evaluation.instances import PredictedInstances, Transfer
from framework.evaluation.panoptic import evaluate_panoptic
from framework.evaluation.scannet_benchmark import BenchmarkScene, benchmark_metrics, semantic_metrics
from framework.evaluation.truth_alignment import in_map_world
from framework.evaluation.truth_coverage import TruthCoverage
from framework.files.hashing import add_values
from framework.interfaces import RGBDSequence, RGBDVideo, SceneMap
from framework.mapping.gravity import floor_height
from framework.runtime.corrected_frames import TrackedFrame
from framework.runtime.run_log import STAGES, RunResult
from framework.vocabulary.label_spaces import AGNOSTIC

log = logging.getLogger(__name__)

Metrics = dict[str, float | int | str | bool | None]

MAIN_FIGURES = (
    "ap50",
    "ap25",
    "ap",
    "ap50_agnostic",
    "mean_iou",
)  # keys below `instances.` that are stored for both directions of the label transfer
COVERAGE = "coverage."  # prefix of the fractions of the ground truth and of the map near each other
CLASSES = "evaluated_classes."  # prefix of the keys about the label space of the evaluation
VIEW_STEP = 5  # frames between two views that determine the true instances of vertices
LABEL_SPACE, CLASS_NAMES = CLASSES + "label_space", CLASSES + "names"
OF_FILE = CLASSES + "of_file"  # classes of a label space in a file, as JSON, because the file may change
IGNORED = {"map": CLASSES + "ignored_in_map", "ground truth": CLASSES + "ignored_in_ground_truth"}  # keys by side
TRUTH = "truth_sha256"  # key of the ground-truth hash in metrics.json
ANNOTATED = "annotated_sha256"  # key of the hash of the names outside of COCO, for datasets that have them


def run_metrics(result: RunResult) -> Metrics:
    """Return the frame counts, speed, pose source, stage times, map size and color delay of a run.

    The dropped frames and the latency are included for live video, and the omitted masks if there are any.
    """
    metrics: Metrics = {
        "frames": result.frames,
        "frames_lost": result.frames_lost,
        "frames_skipped": result.frames_skipped,
        "fps": result.fps,
        "fps_median": result.fps_median,
        "pose_source": result.pose_source,
        **{f"map.{name}": value for name, value in asdict(result.scene.statistics).items()},
    }
    if result.masks_omitted:
        metrics["masks_omitted"] = result.masks_omitted
    if result.disagreeing is not None:
        metrics["frames_disagreeing"] = len(result.disagreeing)
    of_stages = {stage: array("d") for stage in STAGES}
    for time in result.timings:
        of_stages.setdefault(time.stage, array("d")).append(time.milliseconds)
    for stage, milliseconds in of_stages.items():
        metrics[f"stage_ms.{stage}.median"] = float(np.median(milliseconds)) if milliseconds else None
        metrics[f"stage_ms.{stage}.p95"] = float(np.percentile(milliseconds, 95)) if milliseconds else None
    if result.color_delay is not None and result.color_delay.known:
        metrics["color_delay_s"] = result.color_delay.seconds
        metrics["color_delay_deviation_s"] = result.color_delay.deviation
    if result.live is not None:
        latencies = 1e3 * np.array(result.live.latencies)
        metrics["frames_dropped"] = result.live.frames_dropped
        metrics["latency_ms"] = float(np.median(latencies)) if len(latencies) else None
        metrics["latency_ms.p95"] = float(np.percentile(latencies, 95)) if len(latencies) else None
    return metrics


def trajectory_metrics(result: RunResult) -> Metrics:
    """Return the ATE and RPE of a run, or an empty dictionary without ground-truth poses.

    With a back end, the ATE of the poses before any correction is included.
    """
    metrics: Metrics = dict(_trajectory_errors(result.tracked, result.frames).metrics())
    if metrics and result.as_tracked is not None:
        metrics["trajectory.tracked_ate_rmse_m"] = _trajectory_errors(result.as_tracked, result.frames).ate_rmse_m
    return metrics


def _trajectory_errors(tracked: Sequence[TrackedFrame], frames: int) -> trajectory.TrajectoryError:
    """Return the errors of the poses of the tracked frames. `frames` includes the skipped frames."""
    reference: list[Float64 | None] = [None] * frames  # with skipped frames, so that no relative pose spans them
    estimated = [Pose(np.eye(4), lost=True)] * frames
    for frame in tracked:
        reference[frame.position], estimated[frame.position] = frame.T_world_camera_truth, frame.pose
    return trajectory.evaluate(reference, estimated)


def room_metrics(scene: SceneMap, mesh: InstanceMesh) -> Metrics:
    """Return the up direction, its source and the floor height in m.

    The result is empty if the up direction is unknown.
    """
    gravity = scene.gravity()
    up = gravity.up
    if up is None:
        return {}
    figures: Metrics = {f"map.up.{axis}": float(value) for axis, value in zip("xyz", up, strict=True)}
    figures["up_from"] = gravity.source
    return figures | {"map.floor_m": floor_height(mesh.vertices, mesh.triangles, up)}


def instance_metrics(
    video: RGBDVideo,
    mesh: InstanceMesh,
    found: Mapping[int, Instance],
    classes: tuple[str, ...],
    trajectory: tuple[Float64, Float64],
    compared_classes: ComparedClasses,
) -> Metrics:
    """Return the number of instances and their metrics.

    The metrics are omitted without ground truth, or if the ground truth cannot be aligned with the map.

    Args:
        video: The mapped video.
        mesh: The mesh of the map.
        found: The instances of the map by id.
        classes: The class names of the map.
        trajectory: The timestamps (F,), s, and the poses T_world_camera (F, 4, 4) of the mapped frames.
        compared_classes: The label space of the evaluation.
    """
    count: Metrics = {"instances.count": len(found)}
    truth = video.scene_truth()
    if truth is None:
        return count
    try:
        aligned = in_map_world(truth, *trajectory)
    except DataError as error:
        log.warning("instances are not evaluated: %s", error)
        return count
    predictions = PredictedInstances.of_map(mesh, found, classes)
    return count | evaluation_metrics(predictions, truth, aligned, video.annotation, compared_classes)


def doubled_metrics(video: RGBDVideo, mesh: InstanceMesh, likely: Collection[int], result: RunResult) -> Metrics:
    """Return the number of true instances that the map contains more than once.

    Every VIEW_STEP-th frame is read again. The result is empty if the frames have no true instances.

    Args:
        video: The mapped video.
        mesh: The mesh of the map.
        likely: The instances of the map that are counted.
        result: The result of the pipeline.
    """
    if not isinstance(video, RGBDSequence) or video[result.tracked[0].position].truth is None:
        return {}
    true_ids = observed_labels(mesh.vertices, _labeled_views(video, result))
    return {"map.doubled_instances": len(doubled_instances(true_ids, mesh.instance_ids, likely))}


def _labeled_views(video: RGBDSequence, result: RunResult) -> Iterator[LabeledDepth]:
    """Yield every VIEW_STEP-th mapped frame with its estimated pose and its true instances."""
    for tracked in result.tracked[::VIEW_STEP]:
        if not tracked.pose.lost:
            frame = video[tracked.position]
            assert frame.truth is not None
            depth = frame.depth if result.depth_distortion is None else result.depth_distortion.corrected(frame.depth)
            yield LabeledDepth(depth, frame.truth.instance_ids, frame.camera, tracked.pose.T_world_camera)


def evaluation_metrics(
    predictions: PredictedInstances,
    truth: SceneTruth,
    aligned: SceneTruth,
    annotation: str,
    compared_classes: ComparedClasses,
) -> Metrics:
    """Return the metrics of `evaluated`, without the overlaps."""
    return evaluated(predictions, truth, aligned, annotation, compared_classes)[0]


def evaluated(
    predictions: PredictedInstances,
    truth: SceneTruth,
    aligned: SceneTruth,
    annotation: str,
    compared_classes: ComparedClasses,
) -> tuple[Metrics, BenchmarkScene | None]:
    """Return the instance metrics, the coverage, the label space, the release of the ground truth and its hash.

    A small coverage is logged, because the ground truth may have another world frame.

    By default, labels are transferred from the map to the ground truth. The keys `instances.to_map.*` contain the main
    metrics with labels transferred from the ground truth to the map.

    Args:
        predictions: The instances of the map.
        truth: The ground truth in the world frame of the dataset, for the hash.
        aligned: The ground truth in the world frame of the map.
        annotation: The release of the ground truth, or "" for a dataset with a single release.
        compared_classes: The label space of the evaluation.

    Returns:
        The metrics, and the overlaps for ScanNet's metrics over several scenes; None = no label space.
    """
    coverage = TruthCoverage.of(predictions.points_world, aligned.points_world)
    if len(predictions.points_world) and len(aligned.points_world) and not coverage.plausible:
        log.warning(
            "ground truth: expected the world frame of the map, got only %s; check the ground truth, or transform it",
            coverage,
        )
    compared = compared_classes.compare(predictions, aligned)
    for side, ignored in (("map", compared.ignored_predictions), ("ground truth", compared.ignored_truths)):
        if ignored:
            message = "evaluation.label_space=%s: ignored %d objects of the %s: %s"
            log.info(message, compared_classes.label_space, sum(ignored.values()), side, listed(ignored))
    figures = instances.evaluate(compared.predictions, compared.truth).metrics()
    to_map = instances.evaluate(compared.predictions, compared.truth, transfer=Transfer.TO_MAP).metrics()
    of_map = {f"instances.to_map.{name}": to_map[f"instances.{name}"] for name in MAIN_FIGURES if to_map}
    scene, of_scannet = _scannet_metrics(compared, compared_classes)
    metrics: Metrics = {
        **figures,
        **of_map,
        **evaluate_panoptic(compared.predictions, compared.truth).metrics(),
        **of_scannet,
        **{f"{COVERAGE}{name}": value for name, value in asdict(coverage).items()},
        LABEL_SPACE: compared_classes.label_space,
        CLASS_NAMES: compared_classes.names_text,
        OF_FILE: compared_classes.file_text,
        IGNORED["map"]: listed(compared.ignored_predictions) or None,
        IGNORED["ground truth"]: listed(compared.ignored_truths) or None,
        "annotation_release": annotation or None,
        TRUTH: truth_sha256(truth),
        **({} if truth.annotated is None else {ANNOTATED: annotated_sha256(truth.annotated)}),
    }
    return metrics, scene


def _scannet_metrics(compared: Compared, compared_classes: ComparedClasses) -> tuple[BenchmarkScene | None, Metrics]:
    """Return the overlaps and the metrics of ScanNet's benchmarks, or None and {} without a label space."""
    if compared_classes.label_space is None:
        return None, {}
    predictions, truth, classes = compared.predictions, compared.truth, compared_classes.classes
    objects = compared_classes.object_classes
    ids = compared.predicted_ids()
    scene = BenchmarkScene.of(ids, predictions, truth, objects)
    found: Metrics = {**benchmark_metrics([scene], objects)}
    if compared_classes.label_space == AGNOSTIC:
        return scene, found
    names = dict(zip(predictions.ids.tolist(), predictions.class_names, strict=True))
    return scene, found | semantic_metrics(indices(ids, names, classes), compared.true_classes, classes)


def truth_sha256(truth: SceneTruth) -> str:
    """Return the SHA-256 (hex) of a ground truth."""
    digest = hashlib.sha256(repr((sorted(truth.class_names.items()), truth.classes)).encode())
    for values in (truth.points_world, truth.instance_ids):
        add_values(digest, values)
    return digest.hexdigest()


def annotated_sha256(annotated: AnnotatedObjects) -> str:
    """Return the SHA-256 (hex) of the annotated objects with their names."""
    names = {space: sorted(of.items()) for space, of in sorted(annotated.names.items())}
    digest = hashlib.sha256(repr((sorted(annotated.own_names.items()), names)).encode())
    add_values(digest, annotated.instance_ids)
    return digest.hexdigest()


def ignored_names(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the sides with objects that the evaluation ignored because of their names, and these names as text."""
    return [(side, str(names)) for side, key in IGNORED.items() if (names := metrics.get(key))]


def is_evaluation(key: str) -> bool:
    """Return True for the key of a metric from `evaluation_metrics`."""
    prefixes = ("instances.", "panoptic.", "semantic.", COVERAGE, CLASSES)
    return key in ("annotation_release", TRUTH, ANNOTATED) or (key.startswith(prefixes) and key != "instances.count")


def class_name(instance: Instance, classes: tuple[str, ...]) -> str | None:
    """Return the most probable class of an instance, or None in a map without classes."""
    return classes[int(np.argmax(instance.class_probabilities))] if classes else None
