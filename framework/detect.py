"""`python -m framework.detect detector=X dataset=D out=FILE`: writes a sequence's detections as a COCO result file."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import hydra
from omegaconf import DictConfig
from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from framework.command_line import CONF, EXIT_FAILED, Jobs, one_line_errors
from framework.errors import ConfigError, DataError, FrameError
from framework.interfaces import Detector, RGBDSequence

log = logging.getLogger(__name__)
jobs = Jobs()


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="detect")
@jobs.reported
def job(config: DictConfig) -> None:
    """Builds the dataset and the detector that the config names, and writes what the one finds in the other."""
    if config.out is None:
        raise ConfigError("out must be given: out=detections.json")
    out = Path(config.out).expanduser().absolute()
    if not out.parent.is_dir():
        raise ConfigError(f"out: there is no folder {out.parent}")

    from framework.build import build  # here, so that such faults are answered before the heavy libraries load
    from framework.detection.cache import with_cache
    from framework.label_spaces import COCO
    from framework.run import Settings

    Settings.of(config).apply()
    sequence = build(RGBDSequence, config.dataset)  # type: ignore[type-abstract]
    detector = with_cache(build(Detector, config.detector), config)  # type: ignore[type-abstract]
    write_detections(out, detector, sequence)
    how = f"detector=precomputed detector.path={out}"
    if detector.classes != COCO:
        how += f" detector.labels={write_labels(out, detector.classes)}"
    log.info("read it with: %s", how)


def write_detections(path: Path, detector: Detector, sequence: RGBDSequence) -> int:
    """Writes a result file that `detector=precomputed` reads back to the same detections; returns their number.

    Frames that cannot be used are told and left out. Raises DataError when none can.
    """
    from framework.detection.coco_results import results_file

    skipped = 0
    with (
        results_file(path, detector.classes) as results,
        logging_redirect_tqdm(),
        tqdm(total=len(sequence), unit=" frames", disable=None, dynamic_ncols=True) as bar,
    ):
        for k in range(len(sequence)):
            bar.update()
            try:
                frame = sequence[k]
                results.write(frame.index, detector.detect(frame))
            except FrameError as error:
                skipped += 1
                log.warning("frame skipped: %s", error)
        if skipped == len(sequence):
            raise DataError(f"{sequence.name}: none of the {skipped} frames can be used")
    frames = len(sequence) - skipped
    log.info("%s: %d detections in %d frames of %s", path, results.count, frames, sequence.name)
    return results.count


def write_labels(path: Path, classes: tuple[str, ...]) -> Path:
    """Writes the classes beside a result file, one a line: what its probabilities are over."""
    from framework.atomic_files import written_whole

    labels = path.with_suffix(".labels.txt")
    with written_whole(labels) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in classes))
    return labels


def main() -> None:
    with one_line_errors():
        job()
    if jobs.failed:
        sys.exit(EXIT_FAILED)


if __name__ == "__main__":
    main()
