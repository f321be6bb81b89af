"""Tests for manifest.json."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.runs.manifest import Manifest, RunStatus


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Return a run directory with two files and a manifest."""
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    (tmp_path / "metrics.json").write_text("{}\n")
    manifest = Manifest(RunStatus.COMPLETE, {}, {"detector.weights": "0f" * 32}, {"seed": "0"})
    manifest.with_files(tmp_path, ["config.yaml", "metrics.json", "map.npz"]).write(tmp_path)
    return tmp_path


def test_manifest_round_trip_keeps_contents(directory: Path) -> None:
    found = Manifest.read(directory)
    assert (found.status, dict(found.inputs)) == (RunStatus.COMPLETE, {"detector.weights": "0f" * 32})
    assert dict(found.parameters) == {"seed": "0"}
    assert {name: size for name, (size, _) in found.files.items()} == {"config.yaml": 8, "metrics.json": 3}
    assert found.changed_files(directory) == []


def test_manifest_changed_and_missing_files_are_named(directory: Path) -> None:
    (directory / "config.yaml").write_text("seed: 1\n")  # of the same size
    (directory / "metrics.json").unlink()
    first, second = Manifest.read(directory).changed_files(directory)
    assert first.startswith(f"{directory / 'config.yaml'}: expected the SHA-256 ")
    assert second == f"{directory / 'metrics.json'}: expected a file of 3 bytes, got none"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"status": "PARTIAL"}, "expected the digest"),
        ({"digest": "0" * 64}, "expected the digest"),
        ({"digest": None}, "expected the digest"),
    ],
)
def test_manifest_edited_raises(directory: Path, changes: dict[str, object], message: str) -> None:
    content = json.loads((directory / "manifest.json").read_text()) | changes
    (directory / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        Manifest.read(directory)


def test_manifest_without_object_raises(directory: Path) -> None:
    (directory / "manifest.json").write_text("[]")
    with pytest.raises(DataError, match="expected a JSON object, got list"):
        Manifest.read(directory)
