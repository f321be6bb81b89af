"""Hashes of the input files of a run, such as weights and recordings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain, islice
from pathlib import Path
from typing import Any

from framework.datasets.ground_truth.named_truth import KEY, truth_files
from framework.datasets.scannet.scannet_annotation import FIRST_LABEL_TABLE, LABEL_TABLE
from framework.detection.stored.fingerprint import content_hash
from framework.errors import ConfigError, DataError
from framework.files.search_paths import folder_of
from framework.runs.provenance import leaves, relevant

INPUTS = "inputs_sha256"  # key in metrics.json
ROOT = "dataset.root"  # config key of the folder of the recording
MAX_FILES = 200_000  # maximum number of hashed files of a recording (takes 3 s); known datasets have up to 20,000
OUTPUTS = {"outputs", "multirun"}  # Hydra's output folders


def input_hashes(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the SHA-256 (hex) of each input file in a resolved config, by config key.

    Files and folders are hashed by content. A recording is hashed by the names, sizes and modification times of its
    files, because this is faster.
    """
    found = {}
    for key, value in leaves(relevant(config)):
        if isinstance(value, str) and key == KEY:
            found[key] = "".join(map(_content, _truth_files(value)))
        elif isinstance(value, str) and key not in (ROOT, "dataset.scene"):
            found[key] = _content(value)
    dataset = config.get("dataset") or {}
    if root := dataset.get("root"):
        digest = hashlib.sha256()
        for entry in islice(_listed(folder_of(Path(root)), str(dataset.get("scene") or "")), MAX_FILES):
            digest.update(f"{entry};".encode())
        found[ROOT] = digest.hexdigest()
    return {key: sha256 for key, sha256 in found.items() if sha256}


def inputs_sha256(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of all input files in a resolved config."""
    return hash_of(input_hashes(config))


def hash_of(inputs: Mapping[str, str]) -> str:
    """Return the SHA-256 (hex) of a result of `input_hashes`."""
    return hashlib.sha256(repr(sorted(inputs.items())).encode()).hexdigest()


def _truth_files(value: str) -> list[str]:
    """Return the files of `dataset.ground_truth`, or an empty list if a file is missing."""
    try:
        return [str(path) for path in truth_files(Path(value))]
    except (ConfigError, DataError):  # reported by the run itself
        return []


def _content(value: str) -> str:
    """Return the hash of a file or folder, or "" if it does not exist."""
    try:
        return content_hash(Path(value))
    except (ConfigError, DataError, OSError, ValueError):
        return ""


def _listed(root: Path, scene: str) -> Iterator[tuple[str, str, int, int]]:
    above = (root / scene).resolve().parents[:2]  # possible folders of the label tables of ScanNet
    walks: list[Iterable[tuple[str, list[str], list[str]]]]
    walks = [[(str(folder), [], [LABEL_TABLE, FIRST_LABEL_TABLE]) for folder in above]]
    if scene:
        walks.append(islice(os.walk(root), 1))  # files shared by scenes, such as cam_params.json of Replica
    walks.append(os.walk(root / scene, followlinks=True))  # MAX_FILES limits cyclic links
    for folder, folders, files in chain.from_iterable(walks):
        folders[:] = sorted(set(folders) - OUTPUTS)
        for name in sorted(files):
            try:
                found = Path(folder, name).stat()
            except OSError:  # broken link or missing table
                continue
            yield os.path.relpath(folder, root), name, found.st_size, found.st_mtime_ns
