"""The file explanation.json in a run directory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.explanation.contributions import REST, STAGES, Contributions
from framework.explanation.replay import Explanation
from framework.files.atomic_write import path_exists
from framework.files.hashing import path_hash
from framework.files.json_file import read_json, write_json
from framework.runs.stored_runs import INSTANCES

EXPLANATION = "explanation.json"


@dataclass(frozen=True)
class Explained:
    """A lost object or a false instance in explanation.json."""

    state: str  # a value of State, or "false"
    class_name: str
    id: int  # true object, or false instance
    cause: str
    reason: str
    frame: int  # Frame.index of the frame that shows the cause of a lost object best, -1 = none


@dataclass(frozen=True)
class StoredExplanation:
    """The contents of explanation.json that reports show."""

    lost: tuple[Explained, ...]
    false: tuple[Explained, ...]
    contributions: Contributions | None  # None = not computed
    is_current: bool  # False = the run was repeated after the explanation

    @classmethod
    def read(cls, directory: Path) -> StoredExplanation | None:
        """Read the explanation of a run, None = the run is not explained.

        Raises:
            DataError: The file is invalid.
        """
        path = directory / EXPLANATION
        if not path_exists(path):
            return None
        found = read_json(path)
        try:
            lost = [_explained(one, one["state"], one["frame"]) for one in found["objects"] if one["cause"] is not None]
            false = [_explained(one, "false", -1) for one in found["false_instances"]]
            is_current = found["instances_sha256"] == path_hash(directory / INSTANCES)
            contributions = None if found["contributions"] is None else _contributions(found["contributions"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: expected the file of `instancemap explain`, got an error ({error!r})") from error
        return cls(tuple(lost), tuple(false), contributions, is_current)


def write_explanation(directory: Path, explanation: Explanation) -> None:
    """Write the explanation of a run to explanation.json in the run directory."""
    contributions = explanation.contributions
    content = {
        "instances_sha256": path_hash(directory / INSTANCES),
        "objects": [_plain(asdict(one)) for one in explanation.objects],
        "false_instances": [_plain(asdict(one)) for one in explanation.false_instances],
        "contributions": None
        if contributions is None
        else {"metric": contributions.metric, "loss": contributions.loss, **contributions.named()},
    }
    write_json(directory / EXPLANATION, content)


def _explained(entry: Mapping[str, Any], state: str, frame: int) -> Explained:
    name, cause, reason = str(entry["class_name"]), str(entry["cause"]), str(entry["reason"])
    return Explained(str(state), name, int(entry["id"]), cause, reason, int(frame))


def _contributions(entry: Mapping[str, Any]) -> Contributions:
    stages = {stage: float(entry[stage.value]) for stage in STAGES}
    return Contributions(str(entry["metric"]), float(entry["loss"]), stages, float(entry[REST]))


def _plain(value: Any) -> Any:
    """Return a value with text as keys and the values of enums, for JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    return value.value if isinstance(value, Enum) else value
