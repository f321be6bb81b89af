"""Tests for the resolution of relative paths."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.files.search_paths import PROJECT_ROOT, folder_of


def test_folder_of_relative_path_prefers_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert folder_of(Path("framework")) == PROJECT_ROOT / "framework"
    (tmp_path / "framework").mkdir()
    assert folder_of(Path("framework")) == tmp_path / "framework"
    assert folder_of(Path("~/framework")) == tmp_path / "framework"
    assert folder_of(Path("nowhere")) == Path("nowhere")
