"""`instancemap detect detector=X dataset=D out=FILE`: write detections of a sequence to a COCO results file.

If the sequence has ground truth, the command also reports the mask AP and the rates of detection errors.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hydra
import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from framework.commands.command_line import Jobs
from framework.config.validation import checked_file
from framework.errors import ConfigError, DataError, FrameError
from framework.files.search_paths import CONF
from framework.interfaces import Detector, RGBDSequence

if TYPE_CHECKING:  # heavy imports are local
    from framework.data import Bool, Detections
    from framework.detection.stored.coco_results import ResultWriter
    from framework.evaluation.detection_errors import DetectionErrors

log = logging.getLogger(__name__)
jobs = Jobs()

MIN_PIXELS = 100  # minimum number of pixels of evaluated objects


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="detect")
@jobs.reported
def job(config: DictConfig) -> None:
    """Build the dataset and the detector of the config and write the detections of all frames."""
    if config.out is None:
        raise ConfigError("out: expected a file name, got none; set out=detections.json")
    out = checked_file("out", config.out)

    from framework.detection.stored.cache import with_cache
    from framework.registry import build  # local: config errors are reported before heavy imports
    from framework.runtime.process_settings import Settings
    from framework.vocabulary.label_spaces import COCO

    settings = Settings.of(config)
    settings.apply()
    sequence = build(RGBDSequence, config.dataset)
    detector = with_cache(build(Detector, config.detector), config)
    settings.apply()  # apply to torch, if the detector has loaded it
    write_detections(out, detector, sequence)
    how = f"detector=precomputed detector.path={out}"
    if detector.classes != COCO:
        how += f" detector.label_space={write_labels(out, detector.classes)}"
    log.info("use it with: %s", how)


def write_detections(path: Path, detector: Detector, sequence: RGBDSequence) -> int:
    """Write a COCO results file for `detector=precomputed`, and return the number of detections.

    Unusable frames are logged and skipped. Raises DataError if no frame is usable.
    """
    from framework.detection.domain import warn_outside_domain
    from framework.detection.stored.coco_results import results_file
    from framework.evaluation.detection_errors import DetectionErrors
    from framework.evaluation.mask_ap import mask_ap

    warn_outside_domain(detector, sequence)
    errors = DetectionErrors()
    with results_file(path, detector.classes) as results:
        precision = mask_ap(_written(results, detector, sequence, errors), detector.classes, MIN_PIXELS)
    log.info("%s: %d detections in %d frames of %s", path, results.count, results.frames, sequence.name)
    if precision.objects:
        log.info(
            "mask AP50 %.2f, mask AP %.2f (mean of %d classes, %d ground-truth objects of at least %d px)",
            precision.ap50,
            precision.ap,
            sum(not math.isnan(ap) for ap in precision.ap50_by_class.values()),
            precision.objects,
            MIN_PIXELS,
        )
        for name, value in errors.table().items():
            log.info("%-40s %.2f", name, value)
    return results.count


def _written(
    results: ResultWriter, detector: Detector, sequence: RGBDSequence, errors: DetectionErrors
) -> Iterator[tuple[Bool, list[str | None], Detections]]:
    """Write the detections frame by frame. With ground truth, count errors, and yield the input of `mask_ap`."""
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
            f"{sequence.name}: expected usable frames, got none of {len(sequence)}; the log lists the reasons"
        )


def write_labels(path: Path, classes: tuple[str, ...]) -> Path:
    """Write the class names to a text file next to a results file, one per line, and return its path."""
    from framework.files.atomic_write import atomic_write

    labels = path.with_suffix(".labels.txt")
    with atomic_write(labels) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in classes))
    return labels


def main() -> None:
    """Run the command `instancemap detect`."""
    jobs.run(job)
