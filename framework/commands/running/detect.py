"""`instancemap detect detector=X dataset=D out=FILE`: write detections of a sequence to a COCO results file.

For a sequence with ground truth, the command also reports the AP of masks and boxes, and the rates of detection errors.
With -m, each job has its own file, and a table compares the jobs.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from framework.commands.command_line import Jobs, is_of_sweep, print_error
from framework.commands.running.choices import swept_keys
from framework.commands.running.sweep import ending, overrides_of
from framework.config.text_values import typed
from framework.config.validation import checked_file, checked_path
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError
from framework.files.search_paths import CONF
from framework.interfaces import Detector, RGBDSequence

if TYPE_CHECKING:  # heavy imports are local
    from framework.data import Bool, Detections
    from framework.detection.stored.coco_results import ResultWriter
    from framework.evaluation.detection_errors import DetectionErrors
    from framework.tables.detection_table import DetectionMetrics

log = logging.getLogger(__name__)
jobs = Jobs()

MIN_PIXELS = 100  # minimum number of pixels of evaluated objects


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="detect")
@jobs.reported
def job(config: DictConfig) -> None:
    """Build the dataset and the detector of the config and write the detections of all frames."""
    if config.out is None:
        raise ConfigError("out: expected a file name, got none; set out=detections.json")
    hydra_config = HydraConfig.get()
    of_sweep = is_of_sweep(hydra_config)
    folder = Path(hydra_config.runtime.output_dir)
    out = file_of_job(config.out, folder) if of_sweep else checked_file("out", config.out)

    from framework.detection.stored.cache import with_cache
    from framework.registry import build  # local: config errors are reported before heavy imports
    from framework.runtime.process_settings import Settings
    from framework.vocabulary.label_spaces import COCO, ClassNames, coco_name, keeps_names

    settings = Settings.of(config)
    settings.apply()
    sequence = build(RGBDSequence, config.dataset)
    detector = with_cache(build(Detector, config.detector), config)
    settings.apply()  # apply to torch, if the detector has loaded it
    metrics = write_detections(out, detector, sequence)
    if of_sweep:
        from framework.tables.detection_table import write_metrics

        write_metrics(out.parent, list(hydra_config.overrides.task), metrics)
    how = ["detector=precomputed", typed("detector.path", out)]
    if detector.classes != COCO:
        how.append(typed("detector.label_space", write_labels(out, detector.classes)))
        if not keeps_names(detector.classes, ClassNames.AUTO) and any(coco_name(k) != k for k in detector.classes):
            how.append("detector.class_names=OWN")
    log.info("use the file with: %s", " ".join(how))


def file_of_job(out: object, folder: Path) -> Path:
    """Return the output file of a job of a sweep.

    Raises:
        ConfigError: `out` is not a file name without a folder.
    """
    name = checked_path("out", out).name
    if name != out:
        raise ConfigError(
            f"out: expected a file name without a folder in a sweep, got {out}; set {typed('out', name)} (each job "
            "writes its own file below hydra.sweep.dir)"
        )
    folder.mkdir(parents=True, exist_ok=True)
    return folder / name


def write_detections(path: Path, detector: Detector, sequence: RGBDSequence) -> DetectionMetrics:
    """Write a COCO results file for `detector=precomputed`, and return its metrics.

    Unusable frames are logged and skipped.

    Raises:
        DataError: No frame is usable.
    """
    from framework.detection.domain import warn_outside_domain
    from framework.detection.stored.coco_results import results_file
    from framework.evaluation.detection_ap import detection_ap
    from framework.evaluation.detection_errors import DetectionErrors
    from framework.tables.detection_table import detection_metrics

    warn_outside_domain(detector, sequence)
    detector.check_sequence(sequence)
    errors = DetectionErrors()
    with results_file(path, detector.classes) as results:
        precision = detection_ap(_written(results, detector, sequence, errors), detector.classes, MIN_PIXELS)
    log.info("%s: %d detections in %d frames of %s", path, results.count, results.frames, sequence.name)
    if precision.masks.objects:
        log.info(
            "mask AP50 %.2f, mask AP %.2f (mean of %d classes, %d ground-truth objects of at least %d px)",
            precision.masks.ap50,
            precision.masks.ap,
            sum(not math.isnan(ap) for ap in precision.masks.ap50_by_class.values()),
            precision.masks.objects,
            MIN_PIXELS,
        )
        log.info("box AP50 %.2f, box AP %.2f", precision.boxes.ap50, precision.boxes.ap)
        for name, value in errors.table().items():
            log.info("%-40s %.2f", name, value)
    return detection_metrics(sequence.name, results.frames, results.count, precision, errors)


def _written(
    results: ResultWriter, detector: Detector, sequence: RGBDSequence, errors: DetectionErrors
) -> Iterator[tuple[Bool, list[str | None], Detections]]:
    """Write the detections of each frame, and yield the input of `detection_ap`.

    For frames with ground truth, errors are also counted.
    """
    with logging_redirect_tqdm(), tqdm(total=len(sequence), unit=" frames", disable=None, dynamic_ncols=True) as bar:
        for k in range(len(sequence)):
            bar.update()
            try:
                frame = sequence[k]
                found = detector.detect(frame)
            except FrameError as error:
                log.warning("frame skipped: %s", error)
                continue
            results.write(frame.index, found)
            try:
                true_ids = None if frame.truth is None else frame.truth.instance_ids
            except FrameError as error:
                log.warning("frame skipped in the evaluation: %s", error)
                continue
            if frame.truth is not None and true_ids is not None:
                errors.add(frame.truth, found)
                names = frame.truth.class_names
                ids = np.array([i for i in np.unique(true_ids).tolist() if i and i in names], np.int32)
                yield true_ids == ids[:, None, None], [names[i] for i in ids.tolist()], found
    if results.frames == 0:
        raise DataError(
            f"{sequence.name}: expected usable frames, got none among {len(sequence)}; the log lists the reasons"
        )


def write_labels(path: Path, classes: tuple[str, ...]) -> Path:
    """Write the class names, one per line, to a text file next to a results file, and return its path."""
    from framework.files.atomic_write import atomic_write

    labels = path.with_suffix(".labels.txt")
    with atomic_write(labels) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in classes))
    return labels


class TableCallback(Callback):
    """Hydra callback that prints the table of the jobs at the end of a sweep.

    The table is also printed after errors.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        ending.callback(print_table, Path(config.hydra.sweep.dir).absolute(), swept_keys(overrides_of(config.hydra)))


def print_table(directory: Path, swept: set[str]) -> None:
    """Write and print the table of the jobs of a sweep, or print the error."""
    from framework.tables.detection_table import write_detection_table

    try:
        print(write_detection_table(directory, swept, MIN_PIXELS))
    except InstanceMapError as error:
        print_error(error)
        return
    print(f"{os.path.relpath(directory / 'table.md')}, table.tex, table.csv")


def main() -> None:
    """Run the command `instancemap detect`."""
    jobs.run(job_or_sweep)


def job_or_sweep() -> None:
    """Execute one job or, with -m, a sweep."""
    with ending:
        job()
