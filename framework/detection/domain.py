"""What pictures a network is for: what knows rendered rooms alone finds nonsense in photographs, and is sure of it."""

from __future__ import annotations

import logging
from typing import Protocol, runtime_checkable

from framework.interfaces import Detector, RGBDVideo

log = logging.getLogger(__name__)

RENDERED_ROOMS = "rendered rooms"
"""The domain of what `framework.synthetic` makes."""

OF_PHOTOGRAPHS = "maskrcnn2go"
"""The detector that is advised instead, the default of what is recorded."""


@runtime_checkable
class OfADomain(Protocol):
    """A detector that is good for pictures of some kind only."""

    domain: str  # what `RGBDVideo.domain` must be; "" = whatever it is


def domain_of(detector: Detector) -> str:
    """The domain that a detector has, "" where it has none."""
    return detector.domain if isinstance(detector, OfADomain) else ""


def warn_outside_domain(detector: Detector, video: RGBDVideo | None) -> None:
    """Says so in the log, in one line, when a detector sees what it is not for. `video`: None = it is not known."""
    domain = domain_of(detector)
    if domain in ("", video.domain if video else ""):
        return
    pictures = f"the pictures of {video.name} are" if video else "your frames are"
    log.warning(
        "the detector was trained on %s alone, and nothing says that %s such: what it finds there may be nonsense, "
        "however sure it is; use detector=%s",
        domain,
        pictures,
        OF_PHOTOGRAPHS,
    )
