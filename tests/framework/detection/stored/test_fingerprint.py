"""Tests for detector fingerprints."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import pytest
import torch

from framework.detection.stored import fingerprint as module
from framework.detection.stored.fingerprint import content_hash, fingerprint
from framework.errors import ConfigError


class Color(Enum):
    RED = 1
    BLUE = 2


@dataclass
class Network:
    """Parameters of a detector."""

    weights: Path = Path()
    threshold: float = 0.5
    color: Color = Color.RED
    device: str = "cpu"
    labels: str = "coco"


@dataclass
class Other(Network):
    pass


def test_fingerprint_equal_detectors_match() -> None:
    assert fingerprint(Network()) == fingerprint(Network())


@pytest.mark.parametrize("changed", [Network(threshold=0.5000001), Network(color=Color.BLUE), Other()])
def test_fingerprint_depends_on_class_and_parameters(changed: Network) -> None:
    assert fingerprint(changed) != fingerprint(Network())


def test_fingerprint_depends_on_file_content_not_name(tmp_path: Path) -> None:
    for name, content in (("a.npz", b"weights"), ("b.npz", b"weights"), ("c.npz", b"Weights")):
        (tmp_path / name).write_bytes(content)
    a, b, c = (fingerprint(Network(tmp_path / name)) for name in ("a.npz", "b.npz", "c.npz"))
    assert a == b != c
    assert a != fingerprint(Network())


def test_content_hash_covers_folder_files_and_names(tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "a").write_bytes(b"1")
    seen = [content_hash(folder)]
    (folder / "deep" / "a").write_bytes(b"2")
    seen.append(content_hash(folder))
    (folder / "deep" / "a").rename(folder / "deep" / "b")
    seen.append(content_hash(folder))
    (folder / "empty").write_bytes(b"")
    seen.append(content_hash(folder))
    assert len(set(seen)) == 4


def test_content_hash_resolves_path_in_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "weights").write_bytes(b"1")
    monkeypatch.chdir(tmp_path)
    assert content_hash(Path("weights")) == content_hash(tmp_path / "weights")


def test_fingerprint_missing_path_raises(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="absent: expected an existing file, got none"):
        fingerprint(Network(tmp_path / "absent"))


def test_fingerprint_depends_on_source_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mine.py"
    code = "from dataclasses import dataclass\n@dataclass\nclass Mine:\n    a: int = 1\n"
    seen = []
    for text in (code, code + "    # edited\n"):
        path.write_text(text)
        spec = importlib.util.spec_from_file_location("mine", path)
        assert spec is not None
        assert spec.loader is not None
        mine = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "mine", mine)
        spec.loader.exec_module(mine)
        seen.append(fingerprint(mine.Mine()))
    assert seen[0] != seen[1]


def test_fingerprint_covers_all_detection_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    hashed: list[Path] = []
    monkeypatch.setattr(module, "path_hash", lambda path: str(hashed.append(path)))
    fingerprint(Network())
    folder = Path(module.__file__).parents[1]
    assert {path for path in folder.rglob("*.py") if path.stat().st_size} <= set(hashed)
    assert folder / "mask_rcnn" / "roi_align.py" in hashed


def test_fingerprint_without_source_file_raises() -> None:
    notebook = type("Mine", (), {"__module__": "a_notebook"})
    with pytest.raises(ConfigError, match="Mine: expected a class defined in a source file, got the module a_notebook"):
        fingerprint(dataclass(notebook)())


def test_fingerprint_auto_device_includes_device_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    on_cpu = fingerprint(Network(device="auto"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")
    assert fingerprint(Network(device="auto")) != on_cpu


def test_fingerprint_of_file_option_depends_on_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options such as the labels can be a name or a path."""
    monkeypatch.chdir(tmp_path)
    before = fingerprint(Network(labels="labels.txt"))
    (tmp_path / "labels.txt").write_text("chair")
    chair = fingerprint(Network(labels="labels.txt"))
    (tmp_path / "labels.txt").write_text("bed")
    assert len({before, chair, fingerprint(Network(labels="labels.txt"))}) == 3
