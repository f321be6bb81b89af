"""The figures of one run: the flat dictionary that becomes metrics.json."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from framework.data import Instance, InstanceMesh
from framework.interfaces import RGBDSequence
from framework.journal import RunResult

Metrics = dict[str, float | int | str | bool | None]

STAGES_TIMED = ("read", "detect", "track", "lift", "refine", "fuse")


def run_metrics(result: RunResult) -> Metrics:
    """Counts, speed, time by stage and the size of the map."""
    metrics: Metrics = {
        "frames": result.frames,
        "frames_lost": result.frames_lost,
        "frames_skipped": result.frames_skipped,
        "fps": result.fps,
        "pose_source": pose_source(result),
        "map.voxels": result.scene.voxel_count,
        "map.bytes": result.scene.byte_count,
    }
    for stage in STAGES_TIMED:
        milliseconds = [time.milliseconds for time in result.timings if time.stage == stage]
        metrics[f"stage_ms.{stage}.median"] = float(np.median(milliseconds)) if milliseconds else None
        metrics[f"stage_ms.{stage}.p95"] = float(np.percentile(milliseconds, 95)) if milliseconds else None
    return metrics


def pose_source(result: RunResult) -> str:
    """`ground_truth` where each pose is exactly the frame's true one, so that nothing was tracked; else `tracked`."""
    given = [
        frame.T_world_camera_truth is not None and np.array_equal(frame.T_world_camera, frame.T_world_camera_truth)
        for frame in result.tracked
    ]
    return "ground_truth" if given and all(given) else "tracked"


def trajectory_metrics(result: RunResult) -> Metrics:
    """The error of the poses that were not lost; nothing where fewer than two true poses are known."""
    known = [
        (frame.T_world_camera, frame.T_world_camera_truth)
        for frame in result.tracked
        if not frame.lost and frame.T_world_camera_truth is not None
    ]
    if len(known) < 2:
        return {}
    from framework.evaluation.trajectory import evaluate_trajectory

    estimated, truth = (np.stack(poses) for poses in zip(*known, strict=True))
    error = evaluate_trajectory(estimated, truth)
    return {"trajectory.ate_rmse_m": error.ate_rmse_m, "trajectory.rpe_rmse_m": error.rpe_rmse_m}


def instance_metrics(
    sequence: RGBDSequence, mesh: InstanceMesh, instances: Mapping[int, Instance], classes: tuple[str, ...]
) -> Metrics:
    """How many instances were found and, where the true ones are known, how well."""
    count: Metrics = {"instances.count": len(instances)}
    truth = sequence.scene_truth()
    if truth is None:
        return count
    from framework.evaluation.instances import evaluate_instances

    found = {instance.id: (class_name(instance, classes) or "", instance.confidence) for instance in instances.values()}
    evaluation = evaluate_instances(mesh.vertices, mesh.instance_ids, found, truth)
    return {**count, **evaluation.metrics()}


def class_name(instance: Instance, classes: tuple[str, ...]) -> str | None:
    """The most probable class of an instance; None where the map knows no classes."""
    return classes[int(np.argmax(instance.class_probabilities))] if classes else None
