"""Image domains, i.e. the kinds of images that a detector was trained on.

A detector that was trained only on rendered images is unreliable on photographs.
"""

from __future__ import annotations

import logging

from framework.interfaces import Detector, RGBDVideo

log = logging.getLogger(__name__)

RENDERED_ROOMS = "rendered rooms"
"""The domain of images from `framework.synthetic`."""


def warn_outside_domain(detector: Detector, video: RGBDVideo | None) -> None:
    """Log a warning if a video does not belong to the detector's training domain.

    `video` is None for frames of unknown origin.
    """
    if detector.domain in ("", video.domain if video else ""):
        return
    log.warning(
        "the detector was trained on %s only; results on %s may be unreliable even at high confidence; "
        "use detector=maskrcnn2go",
        detector.domain,
        video.name if video else "your frames",
    )
