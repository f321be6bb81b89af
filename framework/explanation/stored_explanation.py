"""The file explanation.json of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from enum import Enum
from pathlib import Path
from typing import Any

from framework.explanation.contributions import Contributions
from framework.explanation.replay import Explanation
from framework.files.json_file import write_json

EXPLANATION = "explanation.json"


def write_explanation(path: Path, explanation: Explanation) -> None:
    """Write the explanation of a run as JSON."""
    contributions = explanation.contributions
    write_json(
        path,
        {
            "objects": [_plain(asdict(one)) for one in explanation.objects],
            "false_instances": [_plain(asdict(one)) for one in explanation.false_instances],
            "contributions": None if contributions is None else contributions_entry(contributions),
        },
    )


def contributions_entry(contributions: Contributions) -> dict[str, Any]:
    """Return contributions as a JSON object."""
    return {"metric": contributions.metric, "loss": contributions.loss, **contributions.named()}


def _plain(value: Any) -> Any:
    """Return a value for JSON: enums by value, keys as text, undefined numbers as null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, Enum):
        return value.value
    return None if isinstance(value, float) and not math.isfinite(value) else value
