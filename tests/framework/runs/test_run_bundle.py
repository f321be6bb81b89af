"""Tests for bundles of runs."""

from __future__ import annotations

import os
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from framework.errors import DataError
from framework.files.manifest import Manifest, RunStatus
from framework.runs.run_bundle import opened_bundle, write_bundle
from tests.support import metric_runs

DAMAGED = 200  # number of damaged bundles
NAMES = ("config.yaml", "metrics.json")


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return the directory of a run with a manifest."""
    (tmp_path / "runs").mkdir()
    directory = metric_runs.run(tmp_path / "runs", {})
    Manifest(RunStatus.COMPLETE, {}, {}, {}).with_files(directory, NAMES).write(directory)
    return directory


@pytest.mark.parametrize("seconds", [0, 5_700_000_000], ids=["1970", "2150"])
def test_bundle_of_files_with_odd_times_is_written(seconds: int, run: Path, tmp_path: Path) -> None:
    for path in run.iterdir():
        os.utime(path, (seconds, seconds))
    assert write_bundle(run, tmp_path / "bundle.zip") == 1
    with opened_bundle(tmp_path / "bundle.zip", trust_code=False) as folder:
        assert Manifest.read(folder / run.name).changed_files(folder / run.name) == []


def test_damaged_bundle_raises_error_with_file_name(run: Path, tmp_path: Path) -> None:
    path, generator, errors = tmp_path / "bundle.zip", np.random.default_rng(0), set()
    write_bundle(run, path)
    content = path.read_bytes()
    for _ in range(DAMAGED):
        damaged = bytearray(content)
        damaged[int(generator.integers(len(content)))] ^= 1 << int(generator.integers(8))
        path.write_bytes(damaged)
        try:
            with opened_bundle(path, trust_code=False):
                pass
        except DataError as error:
            assert str(error).startswith(f"{path}: expected ")
            errors.add(type(error.__cause__))
    assert {zipfile.BadZipFile, zlib.error} <= errors
