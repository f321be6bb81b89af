"""`python -m framework detect detector=X dataset=D out=FILE`: writes a sequence's detections as a COCO result file.

Where the frames come with their true instances, it also says how good the masks are, and what goes wrong how often.
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

if TYPE_CHECKING:  # what is imported where it is used loads heavy libraries
    from framework.data import Bool, Detections
    from framework.detection.stored.coco_results import ResultWriter
    from framework.evaluation.detection_faults import DetectionFaults

log = logging.getLogger(__name__)
jobs = Jobs()

SMALLEST = 100  # px, of a true object that counts


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="detect")
@jobs.reported
def job(config: DictConfig) -> None:
    """Builds the dataset and the detector that the config names, and writes what the one finds in the other."""
    if config.out is None:
        raise ConfigError("out must be given: out=detections.json")
    out = checked_file("out", config.out)

    from framework.detection.stored.cache import with_cache
    from framework.registry import build  # here, so that such faults are answered before the heavy libraries load
    from framework.runtime.process_settings import Settings
    from framework.vocabulary.label_spaces import COCO

    settings = Settings.of(config)
    settings.apply()
    sequence = build(RGBDSequence, config.dataset)
    detector = with_cache(build(Detector, config.detector), config)
    settings.apply()  # to torch, if the detector has loaded it
    write_detections(out, detector, sequence)
    how = f"detector=precomputed detector.path={out}"
    if detector.classes != COCO:
        how += f" detector.label_space={write_labels(out, detector.classes)}"
    log.info("read it with: %s", how)


def write_detections(path: Path, detector: Detector, sequence: RGBDSequence) -> int:
    """Writes a result file that `detector=precomputed` reads back to the same detections; returns their number.

    Frames that cannot be used are told and left out. Raises DataError when none can.
    """
    from framework.detection.domain import warn_outside_domain
    from framework.detection.stored.coco_results import results_file
    from framework.evaluation.detection_faults import DetectionFaults
    from framework.evaluation.mask_ap import mask_ap

    warn_outside_domain(detector, sequence)
    faults = DetectionFaults()
    with results_file(path, detector.classes) as results:
        precision = mask_ap(_written(results, detector, sequence, faults), detector.classes, SMALLEST)
    log.info("%s: %d detections in %d frames of %s", path, results.count, results.frames, sequence.name)
    if precision.objects:
        log.info(
            "mask AP50 %.2f, AP %.2f: the mean of %d classes, %d true objects of %d px or more",
            precision.ap50,
            precision.ap,
            sum(not math.isnan(ap) for ap in precision.ap50_by_class.values()),
            precision.objects,
            SMALLEST,
        )
        for name, value in faults.table().items():
            log.info("%-40s %.2f", name, value)
    return results.count


def _written(
    results: ResultWriter, detector: Detector, sequence: RGBDSequence, faults: DetectionFaults
) -> Iterator[tuple[Bool, list[str | None], Detections]]:
    """Detects and writes, frame by frame; where there is truth, counts faults and yields what `mask_ap` compares."""
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
                log.warning("frame not compared with the ground truth: %s", error)
                continue
            if frame.truth is not None and true_ids is not None:
                faults.add(frame.truth, found)
                names = frame.truth.class_names
                ids = np.array([i for i in np.unique(true_ids).tolist() if i and i in names], np.int32)
                yield true_ids == ids[:, None, None], [names[i] for i in ids.tolist()], found
    if results.frames == 0:
        raise DataError(f"{sequence.name}: none of the {len(sequence)} frames can be used")


def write_labels(path: Path, classes: tuple[str, ...]) -> Path:
    """Writes the classes beside a result file, one a line: what its probabilities are over."""
    from framework.files.atomic_write import written_whole

    labels = path.with_suffix(".labels.txt")
    with written_whole(labels) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in classes))
    return labels


def main() -> None:
    jobs.run(job)
