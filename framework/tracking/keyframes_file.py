"""What a tracker remembers of places, in one file beside the map: by it the next recording finds itself in that map."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from framework.data import Array
from framework.files.atomic_write import is_there
from framework.mapping.storage.map_file import faults_of, read_arrays, write_map

FORMAT = "places 1"  # of the file; a change of meaning counts it up


def write_keyframes(path: Path, keyframes: Mapping[str, Array]) -> None:
    """Writes the arrays, whole or not at all."""
    write_map(path, {"format": FORMAT, "names": sorted(keyframes)}, keyframes)


def read_keyframes(path: Path) -> dict[str, Array]:
    """What `write_keyframes` wrote, nothing where there is no file. Raises DataError for a file that is none."""
    if not is_there(path):
        return {}
    with faults_of(path):
        return read_arrays(path, FORMAT)
