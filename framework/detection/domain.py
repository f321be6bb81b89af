"""Image domains: a detector trained only on rendered images is unreliable on photographs, even at high confidence."""

from __future__ import annotations

import logging

from framework.interfaces import Detector, RGBDVideo

log = logging.getLogger(__name__)

RENDERED_ROOMS = "rendered rooms"
"""The domain of images from `framework.synthetic`."""


def warn_outside_domain(detector: Detector, video: RGBDVideo | None) -> None:
    """Log a warning if the images of `video` are outside the detector's training domain; None = unknown images."""
    if detector.domain in ("", video.domain if video else ""):
        return
    log.warning(
        "the detector was trained on %s only; results on %s may be unreliable even at high confidence; "
        "use detector=maskrcnn2go",
        detector.domain,
        video.name if video else "your frames",
    )
