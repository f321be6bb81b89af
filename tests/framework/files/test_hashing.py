"""Tests for the hashes of arrays and folders. Stored hashes must remain valid."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from framework.data import Array, SceneTruth
from framework.files.hashing import add_array, add_values, path_hash
from framework.runs.metrics import truth_sha256

NUMBERS = np.arange(6, dtype=np.int16).reshape(2, 3)


def digest_of(add: Callable[[hashlib._Hash, Array], None], array: Array) -> str:
    digest = hashlib.sha256()
    add(digest, array)
    return digest.hexdigest()


@pytest.mark.parametrize("add", [add_values, add_array])
def test_array_hash_ignores_memory_order(add: Callable[[hashlib._Hash, Array], None]) -> None:
    assert digest_of(add, np.asfortranarray(NUMBERS)) == digest_of(add, NUMBERS) != digest_of(add, NUMBERS.T)


@pytest.mark.parametrize("other", [NUMBERS.view(np.uint16), NUMBERS.reshape(3, 2), NUMBERS.astype(np.int32)])
def test_array_hash_depends_on_type_and_shape(other: Array) -> None:
    assert digest_of(add_array, other) != digest_of(add_array, NUMBERS)


def test_value_hash_covers_only_bytes() -> None:
    assert digest_of(add_values, NUMBERS) == hashlib.sha256(b"\0\0\1\0\2\0\3\0\4\0\5\0").hexdigest()


def test_path_hash_of_file_and_folder_matches_definition(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1")
    of_file = hashlib.sha256(b"1").hexdigest()
    assert path_hash(tmp_path / "a") == of_file
    assert path_hash(tmp_path) == hashlib.sha256(f"1:a:{of_file}".encode()).hexdigest()


def test_truth_hash_matches_stored_hash() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0.5]], np.float32)
    ids = np.array([0, 3], np.int32)
    truth = SceneTruth(points, ids, {3: "chair"}, ("chair", "desk"))
    assert truth_sha256(truth) == "1e0d8c2f8e4a897f2869469f5484e1a85d701f89c5e08781ddde12813170287d"
