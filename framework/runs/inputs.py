"""What a run reads beside its config: weights, other files and the recording, as one hash."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, islice
from pathlib import Path
from typing import Any

from framework.datasets.scannet.scannet_annotation import FIRST_LABEL_TABLE, LABEL_TABLE
from framework.detection.stored.fingerprint import content_hash
from framework.errors import ConfigError, DataError
from framework.files.search_paths import folder_of
from framework.runs.provenance import leaves, relevant

INPUTS = "inputs_sha256"  # the key of metrics.json
MOST_FILES = 200_000  # of a recording, 3 s; the longest of the datasets read here have 20,000
OUTPUTS = {"outputs", "multirun"}  # Hydra's folders: what runs leave behind where they were begun is no recording


def inputs_sha256(config: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of what the paths in a resolved config lead to.

    Files and folders count by their bytes. A recording would take as long to read as to map: it counts by the names,
    sizes and times of change of the files in dataset.root and of all below dataset.scene.
    """
    digest = hashlib.sha256()
    for key, value in leaves(relevant(config)):
        if isinstance(value, str) and key not in ("dataset.root", "dataset.scene"):
            digest.update(f"{key} {_content(value)};".encode())
    dataset = config.get("dataset") or {}
    if root := dataset.get("root"):
        for entry in islice(_listed(folder_of(Path(root)), str(dataset.get("scene") or "")), MOST_FILES):
            digest.update(f"{entry};".encode())
    return digest.hexdigest()


def _content(value: str) -> str:
    """Of a file or folder; "" for a word that names none."""
    try:
        return content_hash(Path(value))
    except (ConfigError, DataError, OSError, ValueError):
        return ""


def _listed(root: Path, scene: str) -> Iterator[tuple[str, str, int, int]]:
    above = (root / scene).resolve().parents[:2]  # where ScanNet's label tables are
    walks: list[Iterable[tuple[str, list[str], list[str]]]]
    walks = [[(str(folder), [], [LABEL_TABLE, FIRST_LABEL_TABLE]) for folder in above]]
    if scene:
        walks.append(islice(os.walk(root), 1))  # what all scenes share, such as Replica's cam_params.json
    walks.append(os.walk(root / scene, followlinks=True))  # MOST_FILES ends a circle
    for folder, folders, files in chain.from_iterable(walks):
        folders[:] = sorted(set(folders) - OUTPUTS)
        for name in sorted(files):
            try:
                found = Path(folder, name).stat()
            except OSError:  # a link that leads nowhere, a table that is not there
                continue
            yield os.path.relpath(folder, root), name, found.st_size, found.st_mtime_ns
