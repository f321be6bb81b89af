"""Tests for the version and hash of plugin code."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from framework.runs.plugin_code import changed_code, plugin_code


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder on the import path with a package and a single-file plugin."""
    package = tmp_path / "mean_refiner"
    (package / "conf/refiner").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "plugin.py").write_text("class Mean: ...\n")
    (package / "conf/refiner/mean.yaml").write_text("_target_: mean_refiner.plugin.Mean\n")
    (tmp_path / "median_refiner.py").write_text("class Median: ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    return tmp_path


def config(*targets: str) -> dict[str, object]:
    """Return a config whose refiner is a chain of these classes."""
    links = {f"link{k}": {"_target_": target} for k, target in enumerate(targets)}
    return {"refiner": {"_target_": "plugins.refiners.chain.Chain", "links": links}}


def test_plugin_code_edited_package_changes_hash(folder: Path) -> None:
    both = config("mean_refiner.plugin.Mean", "median_refiner.Median")
    seen = [plugin_code(both)]
    for name in ("plugin.py", "conf/refiner/mean.yaml", "sizes.json"):
        with (folder / "mean_refiner" / name).open("a") as file:
            file.write("# edited\n")
        seen.append(plugin_code(both))
    assert len({code["code.refiner"] for code in seen}) == 4
    single = plugin_code(config("median_refiner.Median"))
    (folder / "median_refiner.py").write_text("class Median:\n    size = 3\n")
    assert plugin_code(config("median_refiner.Median")) != single
    assert list(single) == ["code.refiner"]


SOURCES = {
    "__init__.py": "from .mean import Mean\nfrom my_methods.blobs import Blobs as Blobs, Other\n",
    "mean.py": "import numpy\ndef fit():\n    from . import sizes\nclass Mean: ...\n",
    "blobs.py": "from .shapes.round import *\nfrom ..nothing import x\nclass Blobs: ...\n",
    "sizes.py": "SIZE = 3\n",
    "unused.py": "",
    "weights.bin": "3",
    "shapes/__init__.py": "from . import square\n",
    "shapes/round.py": "import my_methods.sizes\n",
    "shapes/square.py": "",
}


@pytest.mark.parametrize(
    ("target", "required"),
    [
        ("my_methods.mean.Mean", {"__init__.py", "mean.py", "sizes.py", "weights.bin"}),
        ("my_methods.Mean", {"__init__.py", "mean.py", "sizes.py", "weights.bin"}),
        (
            "my_methods.Blobs",
            {"__init__.py", "blobs.py", "sizes.py", "weights.bin", "shapes/__init__.py", "shapes/round.py"},
        ),
        ("my_methods.missing.Mean", set(SOURCES) - {"unused.py", "shapes/square.py"}),
    ],
)
def test_plugin_code_hashes_required_files_only(
    target: str, required: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, text in SOURCES.items():
        (tmp_path / "my_methods" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "my_methods" / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    before, changed = plugin_code(config(target)), set()
    for name, text in SOURCES.items():
        (tmp_path / "my_methods" / name).write_text(f"{text}# edited\n")
        if plugin_code(config(target)) != before:
            changed.add(name)
        (tmp_path / "my_methods" / name).write_text(text)
    assert changed == required


def test_plugin_code_import_by_name_hashes_all_files(folder: Path) -> None:
    (folder / "mean_refiner/plugin.py").write_text("import importlib\nX = importlib.import_module('mean_refiner.y')\n")
    before = plugin_code(config("mean_refiner.plugin.Mean"))
    (folder / "mean_refiner/y.py").write_text("")
    assert plugin_code(config("mean_refiner.plugin.Mean")) != before


def test_plugin_code_other_package_keeps_hash(folder: Path) -> None:
    before = plugin_code(config("mean_refiner.plugin.Mean"))
    (folder / "median_refiner.py").write_text("class Median:\n    size = 3\n")
    (folder / "mean_refiner/__pycache__").mkdir()
    (folder / "mean_refiner/__pycache__/plugin.cpython-311.pyc").write_bytes(b"?")
    assert plugin_code(config("mean_refiner.plugin.Mean")) == before


def test_plugin_code_names_package_version_and_hash() -> None:
    code = plugin_code({"detector": {"_target_": "numpy.ndarray"}})["code.detector"]
    name, version, digest = code.split()
    assert (name, len(digest)) == ("numpy", 12)
    assert version[0].isdigit()


def test_plugin_code_of_project_ignores_comments_and_docstrings(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("framework.runs.plugin_code.OWN", ("median_refiner",))
    target = config("median_refiner.Median")
    seen = []
    for text, size in (('"""A."""', 3), ('"""B."""  # note', 3), ('"""B."""', 4)):
        (folder / "median_refiner.py").write_text(f"class Median:\n    {text}\n    size = {size}\n")
        seen.append(plugin_code(target))
    assert seen[0] == seen[1]
    assert seen[1] != seen[2]


def test_plugin_code_missing_or_broken_package_is_named(folder: Path) -> None:
    (folder / "broken.py").write_text("def")
    code = plugin_code(config("nowhere.plugin.Mean", "broken.Plugin"))["code.refiner"]
    assert "nowhere missing" in code
    assert "broken " in code


def test_changed_code_names_stage_and_both_versions() -> None:
    now = {"code.refiner": "mean_refiner 0.2 9c", "code.fuser": "plugins.fusers.bayesian_tsdf 11"}
    assert changed_code({"frames": 3}, now) == []
    assert changed_code(now, now) == []
    stored = now | {"code.refiner": "mean_refiner 0.1 3f"}
    assert changed_code(stored, now) == ["refiner: mean_refiner 0.1 3f -> mean_refiner 0.2 9c"]
