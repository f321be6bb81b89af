"""`instancemap show-refinement dataset=D detector=X refiner=R out=FILE`: draw a frame before and after refinement.

The figure shows the masks in the image, their 3D points viewed from the side, and metrics.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from typing import TYPE_CHECKING

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from framework.commands.command_line import Jobs
from framework.config.validation import checked_file
from framework.errors import ConfigError, DataError, FrameError
from framework.files.search_paths import CONF
from framework.interfaces import ClusterRefiner, Detector, RGBDSequence

if TYPE_CHECKING:  # heavy imports are local
    from framework.data import Detections, Frame

log = logging.getLogger(__name__)
jobs = Jobs()

CANDIDATES = 6  # number of evenly spaced candidates for the default frame


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="show_refinement")
@jobs.reported
def job(config: DictConfig) -> None:
    """Build dataset, detector and refiner, and draw the refinement of one frame."""
    if config.out is None:
        raise ConfigError("out: expected a file name, got none; set out=refinement.png")
    out = checked_file("out", config.out, ".png")

    from framework.detection.stored.cache import with_cache
    from framework.evaluation.refined_points import Refinement
    from framework.figures.refinement_figure import write_refinement
    from framework.registry import build  # local: config errors are reported before heavy imports
    from framework.runtime.process_settings import Settings

    settings = Settings.of(config)
    settings.apply()
    sequence = build(RGBDSequence, config.dataset)
    detector = with_cache(build(Detector, config.detector), config)
    settings.apply()  # apply to torch, if the detector has loaded it
    refiner = build(ClusterRefiner, config.refiner)
    position, frame, detections = detected(sequence, detector, config.frame)
    if len(detections) == 0:
        log.warning("frame %d of %s: no detections to refine; set frame=K or another detector", position, sequence.name)
    hydra_config = HydraConfig.get()
    choices, overrides = hydra_config.runtime.choices, hydra_config.overrides.task
    number = "" if frame.index == position else f" (frame {frame.index} of the recording)"
    title = f"{sequence.name}, frame {position}{number}, detector={choices['detector']}"
    write_refinement(out, Refinement.of(refiner, detections, frame), title, called(choices["refiner"], overrides))
    log.info("%s: %d detections in frame %d of %s", out, len(detections), position, sequence.name)


def detected(sequence: RGBDSequence, detector: Detector, position: object) -> tuple[int, Frame, Detections]:
    """Return a frame with its position in the selection and its detections.

    Args:
        sequence: Sequence.
        detector: Detector.
        position: Position among the selected frames; None = candidate frame with the most detections.

    Raises:
        ConfigError: The position is invalid.
        FrameError: The frame is unusable.
        DataError: No candidate frame is usable.
    """
    from framework.detection.domain import warn_outside_domain

    warn_outside_domain(detector, sequence)
    detector.check_sequence(sequence)
    if position is not None:
        if isinstance(position, bool) or not isinstance(position, int) or not 0 <= position < len(sequence):
            raise ConfigError(
                f"frame: expected a position in [0, {len(sequence) - 1}] among the selected frames of "
                f"{sequence.name}, got {position!r}"
            )
        frame = sequence[position]
        return position, frame, detector.detect(frame)
    tried = sorted({k * len(sequence) // CANDIDATES for k in range(CANDIDATES)}) if len(sequence) else []
    best: tuple[int, Frame, Detections] | None = None
    for k in tried:
        try:
            frame = sequence[k]
            found = detector.detect(frame)
        except FrameError as error:
            log.warning("frame skipped: %s", error)
            continue
        if best is None or len(found) > len(best[2]):
            best = k, frame, found
    if best is None:
        fix = "set frame=K to the position of a usable frame among the selected frames"
        raise DataError(f"{sequence.name}: expected a usable frame, got none among {len(tried)} candidates; {fix}")
    return best


def called(refiner: str, overrides: Iterable[str]) -> str:
    """Return the overrides that select the refiner and set its parameters, as one string."""
    return " ".join(
        [f"refiner={refiner}", *(item for item in overrides if item.lstrip("+~").startswith(("refiner.", "refiner@")))]
    )


def main() -> None:
    """Run the command `instancemap show-refinement`."""
    jobs.run(job)
