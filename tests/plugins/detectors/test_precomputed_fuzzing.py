"""Fuzz tests for detection files. A file must be usable or raise a one-line error.

The following command tries 2000 cases per format:

    INSTANCEMAP_FUZZ=2000 pytest tests/plugins/detectors/test_precomputed_fuzzing.py
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from framework.data import Camera, Frame
from framework.errors import DataError
from plugins.detectors.precomputed import Precomputed
from tests.support.recordings.damaged_files import EXAMPLES, changed_json, check, damaged

pytestmark = pytest.mark.integration

CAMERA = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
FRAME = Frame(0, 0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), CAMERA)
RUNS = {"image_id": 0, "category_name": "cup", "score": 0.5, "segmentation": {"size": [6, 8], "counts": [10, 6, 32]}}
PACKED = RUNS | {"segmentation": {"size": [6, 8], "counts": ":6P1"}, "bbox": [0, 0, 3.5, 2], "exact": True}
OUTLINE = {"image_id": "color/000000.png", "category_id": 47, "score": 1, "segmentation": [[1, 1, 6.5, 1, 6, 4]]}
WHOLE = RUNS | {"class_probabilities": {"cup": 0.75, "chair": 0.25}}
ENTRIES = [RUNS, PACKED, OUTLINE, WHOLE]
LISTED = [{"id": 3, "class": "cup", "score": 0.5}, {"id": 4, "class": "chair", "score": 1.0}]
TOKENS = (
    b"[" * 3000,
    b'{"a":' * 3000,
    b'"',
    b"\\ud800",
    b"NaN",
    b"-Infinity",
    b"null",
    b"1e400",
    b"," * 20,
    b"\xef\xbb\xbf",
)

fuzzed = settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))


def use(path: Path) -> None:
    Precomputed(path).detect(FRAME)


def use_folder(description: Path) -> None:
    """Read the folder. An error must name the file or the folder."""
    try:
        use(description.parent)
    except DataError as error:
        assert str(description.parent) in str(error)
        raise DataError(f"{description}: {error}") from error


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ids = np.full((6, 8), 3, np.uint16)
    ids[2:] = 4
    cv2.imwrite(str(tmp_path / "000000.png"), ids)
    return tmp_path / "000000.json"


def test_precomputed_unchanged_results_are_valid(tmp_path: Path, folder: Path) -> None:
    assert check(use, tmp_path / "results.json", json.dumps(ENTRIES).encode()) == ""
    assert len(Precomputed(tmp_path / "results.json").detect(FRAME)) == len(ENTRIES)
    (tmp_path / "results.json").unlink()
    assert check(use_folder, folder, json.dumps(LISTED).encode()) == ""


@fuzzed
@given(content=changed_json(ENTRIES))
def test_precomputed_changed_file_raises_only_one_line_errors(
    content: Any, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "results.json"
    check(use, path, json.dumps(content).encode())


@fuzzed
@given(content=damaged(json.dumps(ENTRIES).encode(), TOKENS))
def test_precomputed_damaged_file_raises_only_one_line_errors(
    content: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    check(use, tmp_path_factory.getbasetemp() / "results.json", content)


@fuzzed
@given(content=st.one_of(changed_json(LISTED).map(lambda found: json.dumps(found).encode()),
                         damaged(json.dumps(LISTED).encode(), TOKENS)))  # fmt: skip
def test_precomputed_mask_folder_raises_only_one_line_errors(content: bytes, folder: Path) -> None:
    check(use_folder, folder, content)
