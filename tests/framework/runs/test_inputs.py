"""Tests for the hash of the inputs. A completed run is skipped if the hashes of its config and inputs are unchanged."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.runs.inputs import inputs_sha256


@pytest.mark.parametrize("where", ["{home}/weights.bin", "~/weights.bin"])
def test_inputs_sha256_changes_with_weights_content(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    config = {"detector": {"weights": where.format(home=tmp_path)}}
    seen = []
    for content in (b"first", b"other", b"first"):
        (tmp_path / "weights.bin").write_bytes(content)
        seen.append(inputs_sha256(config))
    assert seen[0] != seen[1]
    assert seen[0] == seen[2]


def test_inputs_sha256_follows_symlinked_folders(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "root" / "scene").mkdir(parents=True)
    (tmp_path / "root" / "scene" / "depth").symlink_to(tmp_path / "disk")
    config = {"dataset": {"root": str(tmp_path / "root"), "scene": "scene"}}
    before = inputs_sha256(config)
    (tmp_path / "disk" / "0.png").write_bytes(b"new")
    assert inputs_sha256(config) != before
    (tmp_path / "disk" / "around").symlink_to(tmp_path / "root")
    assert inputs_sha256(config) == inputs_sha256(config), "expected a hash that follows cyclic links once"


@pytest.mark.parametrize("scene", ["", "scene0000_00"])
def test_inputs_sha256_includes_label_tables_above_scene(scene: str, tmp_path: Path) -> None:
    root = tmp_path / "scans"
    (root / scene).mkdir(parents=True)
    config = {"dataset": {"root": str(root), "scene": scene}}
    before = inputs_sha256(config)
    (tmp_path / "scannetv2-labels.combined.tsv").write_text("new")
    assert inputs_sha256(config) != before
