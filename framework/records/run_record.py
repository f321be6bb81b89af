"""The directory that a run leaves behind: every file whole or not at all, metrics.json last."""

from __future__ import annotations

import csv
import logging
import sys
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from framework.files.json_file import write_json
from framework.files.tum_trajectory import write_tum
from framework.files.whole_files import written_whole
from framework.interfaces import RGBDSequence
from framework.journal import RunResult
from framework.records.inputs import INPUTS, inputs_sha256
from framework.records.instances_file import write_instances
from framework.records.mesh_file import write_mesh
from framework.records.metrics import Metrics, class_name, instance_metrics, run_metrics, trajectory_metrics
from framework.records.provenance import code_version, config_hash, environment
from framework.records.stored_runs import CONFIG, METRICS, PARTIAL_METRICS
from framework.registry import STAGES
from framework.rendering.overview import write_overview

log = logging.getLogger(__name__)

LIKELY = 0.3  # confidence from which on an instance is in the picture and in what a run says; files have them all


@dataclass(frozen=True)
class RunRecord:
    """Writes one run's directory."""

    directory: Path
    config: Mapping[str, Any]  # resolved
    choices: Mapping[str, str | None]  # the option chosen of each config group
    inputs: str  # inputs_sha256

    @classmethod
    def begin(cls, directory: Path, config: DictConfig, choices: Mapping[str, str | None]) -> RunRecord:
        """Takes `directory` over: an earlier run's metrics are removed, so that they cannot pass for this one's."""
        resolved = OmegaConf.to_container(config, resolve=True)
        assert isinstance(resolved, dict)
        directory.mkdir(parents=True, exist_ok=True)
        for name in (METRICS, PARTIAL_METRICS):
            (directory / name).unlink(missing_ok=True)
        with written_whole(directory / CONFIG) as temporary:
            OmegaConf.save(OmegaConf.create(resolved), temporary)
        _reset_peak_memory()
        asked = {str(key): value for key, value in resolved.items()}
        return cls(directory, asked, choices, inputs_sha256(asked))

    def write(self, sequence: RGBDSequence, result: RunResult, counts: Mapping[str, int] | None = None) -> Metrics:
        """Writes everything that the run found, and says the main figures in the log.

        `counts` are further figures for metrics.json, by key. What was mapped is written before it is judged: where the
        truth turns out to be unusable, it stays.
        """
        scene, classes = result.scene, result.scene.classes
        mesh, instances = scene.mesh(), scene.instances()
        names = {key: class_name(instance, classes) for key, instance in instances.items()}
        trusted = [frame for frame in result.tracked if not frame.pose.lost]
        poses = np.array([frame.pose.T_world_camera for frame in trusted]).reshape(-1, 4, 4)
        write_mesh(self.directory / "mesh.ply", mesh)
        write_instances(self.directory / "instances.json", mesh, instances, classes)
        write_tum(self.directory / "trajectory.txt", np.array([frame.timestamp for frame in trusted]), poses)
        write_timings(self.directory / "timings.csv", result)
        scene.save(self.directory / "map.npz")
        metrics: Metrics = {
            "sequence": sequence.name,
            **{f"choice.{group}": self.choices.get(group) for group in STAGES},
            **run_metrics(result),
            **(counts or {}),
            **instance_metrics(sequence, mesh, instances, classes),
            **trajectory_metrics(result),
            "peak_rss_bytes": peak_memory(),
            "seed": self.config.get("seed"),
            "config_hash": config_hash(self.config),
            INPUTS: self.inputs,
            **code_version(),
            **environment(),
        }
        title = headline(metrics)
        likely = {key: name or "object" for key, name in names.items() if instances[key].confidence >= LIKELY}
        labels = {key: (name, instances[key].confidence) for key, name in likely.items()}
        write_overview(self.directory / "overview.png", mesh, labels, poses, title)
        if result.stopped_by is None:
            write_json(self.directory / METRICS, metrics)
        else:
            write_json(self.directory / PARTIAL_METRICS, {"partial": reason(result.stopped_by), **metrics})
        self._announce(title, Counter(likely.values()), len(names) - len(likely), result)
        return metrics

    def _announce(self, title: str, likely: Counter[str], unlikely: int, result: RunResult) -> None:
        log.info("%s", title)
        found = ", ".join(f"{count} {name}" for name, count in likely.most_common()) or "no likely instance"
        rest = f"; {unlikely} of a confidence below {LIKELY} are in the files alone" if unlikely else ""
        log.info("found: %s%s", found, rest)
        for name in ("overview.png", "mesh.ply", "instances.json"):
            log.info("%s", self.directory / name)
        if result.stopped_by is not None:
            log.warning("partial run, %s: its figures are in %s", reason(result.stopped_by), PARTIAL_METRICS)


_FAULTS = {"frames_lost": "lost", "frames_skipped": "skipped"}
_QUALITY = {"instances.ap50": "AP50", "instances.ap25": "AP25"}


def headline(metrics: Mapping[str, Any]) -> str:
    """The main figures of a run in one line."""
    parts = [str(metrics["sequence"]), f"{metrics['frames']} frames at {metrics['fps']:.1f}/s"]
    parts += [f"{metrics[key]} {word}" for key, word in _FAULTS.items() if metrics[key]]
    if metrics["pose_source"] == "ground_truth":
        parts.append("given poses")
    elif metrics.get("trajectory.ate_rmse_m") is not None:
        parts.append(f"ATE {metrics['trajectory.ate_rmse_m']:.3f} m")
    parts.append(f"{metrics['instances.count']} instances")
    parts += [f"{word} {metrics[key]:.2f}" for key, word in _QUALITY.items() if metrics.get(key) is not None]
    return " | ".join(parts)


def reason(stopped_by: BaseException) -> str:
    """Why a run is partial, in words."""
    return str(stopped_by) or "interrupted by Ctrl-C"


def write_timings(path: Path, result: RunResult) -> None:
    """Writes how long each stage took for each frame, in the order in which it happened."""
    with written_whole(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("frame", "stage", "milliseconds"))
        writer.writerows((time.frame, time.stage, f"{time.milliseconds:.3f}") for time in result.timings)


def peak_memory() -> int | None:
    """The largest resident size of this process so far, bytes: since the run began, where the kernel can say so.

    None on Windows, which has no `resource`.
    """
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # Linux counts in KiB


def _reset_peak_memory() -> None:
    """Forgets the peak of what this process did before: an earlier job of a sweep may have needed more."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
