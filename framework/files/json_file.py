"""JSON files of a run's record."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from framework.errors import DataError
from framework.files.whole_files import written_whole


def write_json(path: Path, content: Any) -> None:
    """Writes `content`, whole or not at all; floats with as many digits as it takes to read them back exactly."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """What a JSON file holds. Raises DataError, naming the file, when it cannot be read."""
    try:
        return json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read: {str(error).partition(chr(10))[0]}") from error


def _finite(content: Any) -> Any:
    """NaN is not JSON: a figure that is not defined, such as the AP of a class that is not there, is null."""
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content
