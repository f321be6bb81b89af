"""Report section about the causes of lost objects and false instances, from explanation.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from framework.data import UInt8
from framework.explanation.stored_explanation import EXPLANATION, Explained, StoredExplanation
from framework.reporting.charts import contribution_bar
from framework.reporting.pictures import QUALITY, Picture, cropped, webp_url
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import RunSource

TRUE_COLOR: UInt8 = np.array((255, 196, 0), np.uint8)  # RGB, outline of the true object
OUTDATED = f"{EXPLANATION} explains an earlier run in this folder. Run `instancemap explain` again."


def explanation_section(contents: RunContents, source: RunSource) -> dict[str, Any] | None:
    """Return the variables of the explanation section in run.html, or None for a run without an explanation.

    Args:
        contents: Outputs of the run.
        source: Sequence of the run.
    """
    stored = StoredExplanation.read(contents.record.directory)
    if stored is None:
        return None
    if not stored.is_current:
        return {"outdated": OUTDATED, "rows": [], "bar": "", "contributions": [], "metric": ""}
    pictures = lost_objects(stored, contents, source)
    contributions = stored.contributions
    return {
        "outdated": "",
        "rows": [*((one, pictures.get(one.id)) for one in stored.lost), *((one, None) for one in stored.false)],
        "bar": "" if contributions is None else contribution_bar(contributions),
        "contributions": [] if contributions is None else list(contributions.named().items()),
        "metric": "" if contributions is None else contributions.metric,
    }


def lost_objects(stored: StoredExplanation, contents: RunContents, source: RunSource) -> Mapping[int, Picture]:
    """Return an image of each lost object in the frame that shows the cause, by id.

    Lost frames have no image.
    """
    numbers = {frame: k for k, frame in enumerate(contents.tracked_frames)}
    pictures = {}
    for one in stored.lost:
        if one.frame in numbers and (picture := _picture(one, numbers[one.frame], source)) is not None:
            pictures[one.id] = picture
    return pictures


def _picture(one: Explained, k: int, source: RunSource) -> Picture | None:
    frame = source.frame(k)
    if frame is None or frame.truth is None:
        return None
    mask = frame.truth.instance_ids == one.id
    if not mask.any():
        return None
    crop = cropped(frame.color, mask, TRUE_COLOR, 1.0)
    return Picture(webp_url(Image.fromarray(crop), QUALITY), f"frame {one.frame}")
