"""Tests for the command `doctor`, also with simulated errors."""

from __future__ import annotations

import getpass
import json
import os
import subprocess
import sys
import tomllib
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

from framework.commands.installation.doctor import _kernels as kernel_checks
from framework.compilation.catalog import DEFAULT, listed
from framework.detection.mask_rcnn.published_weights import PUBLISHED
from framework.doctor import isolated, machine, networks, packages
from framework.doctor.check_result import Check, Status, anonymous, run_checks

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[3]
CHECKS = (networks.included_and_hub, networks.published)
HUB_VARIABLES = ("HF_HOME", "HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "INSTANCEMAP_OFFLINE", "TRANSFORMERS_OFFLINE")
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]


def doctor(directory: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(filter(None, [variables.pop("PYTHONPATH", ""), str(CHECKOUT)]))
    line = [sys.executable, "-m", "framework", "doctor", *arguments]
    environment = os.environ | {"PYTHONPATH": path} | variables
    return subprocess.run(line, cwd=directory, env=environment, capture_output=True, text=True, timeout=120)


def broken_library(folder: Path, name: str, text: str) -> None:
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(text)


def test_doctor_broken_libraries_are_one_line_errors(tmp_path: Path) -> None:
    """One library raises an error on import, and the other one ends the process."""
    broken_library(tmp_path, "torch", "raise ImportError('libtorch.so: no such\\nfile')")
    broken_library(tmp_path, "open3d", "import os, signal\nos.kill(os.getpid(), signal.SIGILL)")
    done = doctor(tmp_path, PYTHONPATH=str(tmp_path), HOME=str(tmp_path))
    assert done.returncode == 1
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    [torch], [open3d] = ([line for line in lines if line.startswith(f"  !!  {name} ")] for name in ("torch", "open3d"))
    assert "ImportError: libtorch.so: no such file" in torch
    assert "process ended with status" in open3d
    assert "pip install --force-reinstall --no-deps 'open3d==" in lines[lines.index(open3d) + 1]
    assert any(line.startswith("  ok  numpy ") for line in lines)
    assert lines[-1].startswith("2 required checks")
    assert str(tmp_path) not in done.stdout.replace("~", "")
    assert done.stdout.isascii()
    written = {path.name for path in tmp_path.iterdir()} - {"torch", "open3d"}
    assert written <= {".config", ".cache"}, "expected only the folders that matplotlib creates when it is imported"


def test_doctor_json_lists_every_section(tmp_path: Path) -> None:
    done = doctor(tmp_path, "--json", "debug=true", INSTANCEMAP_OFFLINE="1")
    sections: list[dict[str, Any]] = json.loads(done.stdout)
    found = {section["title"]: {check["name"]: check for check in section["checks"]} for section in sections}
    checks = [check for section in found.values() for check in section.values()]
    assert done.returncode == any(check["status"] == "error" for check in checks)
    assert list(found["Libraries"]) == [Requirement(line).name for line in PROJECT["dependencies"]]
    assert {check["status"] for check in found["Libraries"].values()} == {"ok"}
    assert set(found["Extras (optional)"]) == PROJECT["optional-dependencies"].keys()
    for check in checks:
        assert check["status"] in ("ok", "missing", "error")
        assert "\n" not in check["detail"] + check["fix"]
    assert "3." in found["Networks"]["maskrcnn2go"]["detail"]
    assert "INSTANCEMAP_OFFLINE" in found["Networks"]["resnet50_fpn_coco_detectron2"]["detail"]
    assert found["Environment variables"]["INSTANCEMAP_OFFLINE"]["detail"] == "1"
    assert found["Compiled kernels"]["default stages"]["detail"].split()[2] == str(len(listed(DEFAULT)))


def test_doctor_package_wrong_version_or_missing_has_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [Requirement("numpy<1"), Requirement("no-such-library>=2")]
    extras = {"some": [Requirement("numpy"), Requirement("no-such-library")]}
    monkeypatch.setattr(packages, "declared", lambda: (">=3.11", lines, extras))
    old, missing = packages.libraries(defaultdict(lambda: ("", "")))
    assert (old.status, old.fix) == (Status.ERROR, "pip install 'numpy<1'")
    assert "<1" in old.detail
    assert (missing.detail, missing.fix) == ("not installed", "pip install 'no-such-library>=2'")
    [extra] = packages.extras()
    assert (extra.status, extra.fix) == (Status.MISSING, "pip install 'instancemap[some]'")


def test_doctor_package_modules_are_importable() -> None:
    modules = [packages.import_statement(line.name).split()[1] for line in packages.declared()[1]]
    assert [module for module in modules if find_spec(module) is None] == []
    assert {"cv2", "sklearn", "torch"} < {*modules}


def test_doctor_isolated_code_returns_last_line_or_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_library(tmp_path, "ending", "import os\nos._exit(3)")
    broken_library(tmp_path, "hanging", "import time\ntime.sleep(60)")
    broken_library(tmp_path, "talking", "print('loading')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    codes = ["import json", "import ending", "import talking; print('loaded')", "import missing_library"]
    assert list(isolated.run_all(codes).values()) == [
        ("", ""),
        ("", "process ended with status 3"),
        ("loaded", ""),
        ("", "ModuleNotFoundError: No module named 'missing_library'"),
    ]
    monkeypatch.setattr(isolated, "TIMEOUT_S", 2.0)
    assert "2 s" in isolated.run_all(["import hanging"])["import hanging"][1]


def test_doctor_failing_check_does_not_stop_others() -> None:
    def broken_check() -> list[Check]:
        raise OSError(5, "Input/output error")

    good = Check("good", Status.OK, "")
    expected = Check("broken check", Status.ERROR, "OSError: [Errno 5] Input/output error")
    assert run_checks(broken_check, lambda: [good]) == [expected, good]


def test_doctor_anonymous_removes_home_and_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/alice")
    monkeypatch.setattr(getpass, "getuser", lambda: "alice")
    assert anonymous("/home/alice/.cache in /media/alice/disk") == "~/.cache in /media/USER/disk"


def test_doctor_missing_library_and_network_have_fixes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "SYSTEM_LIBRARIES", {"libnone.so.9": ("libnone9", "Open3D")})
    [missing] = machine.system_libraries()
    assert (missing.name, missing.status, missing.fix) == ("libnone9", Status.ERROR, "apt-get install libnone9")
    monkeypatch.setattr(networks, "PROJECT_ROOT", tmp_path)
    errors = [check.name for check in networks.included_and_hub() if check.status is Status.ERROR]
    assert errors == ["maskrcnn2go"], "expected an error for the default detector only"


def test_doctor_networks_list_every_option_with_weights() -> None:
    named = [result.name for check in CHECKS for result in check()]
    assert len(named) == len(set(named))
    found: set[str] = set()
    for path in (CHECKOUT / "conf" / "detector").glob("*.yaml"):
        content: dict[str, Any] = yaml.safe_load(path.read_text())
        given = {key: content[key] for key in ("weights", "model", "mask_model") if content.get(key, "???") != "???"}
        for key, value in given.items():
            found.add(value if value in PUBLISHED else path.stem if len(given) == 1 else f"{path.stem}.{key}")
    assert found | PUBLISHED.keys() == set(named)
    assert {"with_embeddings", "open_vocabulary.model", "open_vocabulary.mask_model"} < found


def test_doctor_networks_list_new_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    detectors = tmp_path / "conf" / "detector"
    detectors.mkdir(parents=True)
    (tmp_path / "conf" / "config.yaml").write_text("defaults:\n  - _self_\n  - detector: own\n")
    (detectors / "own.yaml").write_text("_target_: some.Class\nnetwork: plugins/own.onnx # comes with the project\n")
    (detectors / "two.yaml").write_text("first: somebody/one\nsecond: somebody/two\nwords: [a/b]\nrate: 0.5\n")
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "own.onnx").write_bytes(bytes(2_500_000))
    monkeypatch.setattr(networks, "CONF", tmp_path / "conf")
    monkeypatch.setattr(networks, "PROJECT_ROOT", tmp_path)
    for name in (*HUB_VARIABLES, "HF_HUB_OFFLINE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hub"))
    assert [(check.name, check.detail, check.fix) for check in networks.included_and_hub()] == [
        ("own", "included, 2.5 MB", ""),
        ("two.first", "somebody/one is not downloaded", "instancemap detector=two"),
        ("two.second", "somebody/two is not downloaded", "instancemap detector=two"),
    ]


def test_doctor_hub_model_is_found_when_complete(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def rf_detr_seg() -> tuple[Status, str]:
        return next(
            (check.status, check.detail) for check in networks.included_and_hub() if check.name == "rf_detr_seg"
        )

    for name in HUB_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    model = "Roboflow/rf-detr-seg-nano"
    assert rf_detr_seg() == (Status.MISSING, f"{model} is not downloaded, but HF_HUB_OFFLINE is set")
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    snapshot = tmp_path / "huggingface/hub/models--Roboflow--rf-detr-seg-nano/snapshots/0123"
    blobs = snapshot.parents[1] / "blobs"
    snapshot.mkdir(parents=True)
    blobs.mkdir()
    (snapshot.parent / ".DS_Store").touch()
    (blobs / "abc").write_bytes(b"{}")
    (blobs / "def.incomplete").write_bytes(bytes(1_000_000))
    (snapshot / "config.json").symlink_to(blobs / "abc")
    assert rf_detr_seg() == (Status.MISSING, f"{model} is partly downloaded")
    (blobs / "def.incomplete").rename(blobs / "def")
    (snapshot / "model.safetensors").symlink_to(blobs / "def")
    assert rf_detr_seg() == (Status.OK, f"{model}, 1 MB in {anonymous(str(tmp_path))}/huggingface/hub")


def test_doctor_reports_nearly_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1e8})())
    checks = list(machine.disk())
    assert [check.detail.partition(" in ")[0] for check in checks] == ["0.1 GB free"] * 3
    assert all(check.status is Status.MISSING and check.fix for check in checks)


def test_doctor_repair_deletes_damaged_cache_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    compile_one = [sys.executable, "-m", "framework", "compile", "binary_masks_kernels.mask_bounds"]
    subprocess.run(compile_one, cwd=CHECKOUT, check=True)
    [path] = tmp_path.rglob("*.nbc")
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    before = {check.name: check for check in kernel_checks(isolated.run_all([isolated.KERNELS]))}
    assert before["cache files"].detail == f"1 damaged, such as {anonymous(path)}"
    assert before["cache files"].fix == "instancemap doctor --repair"
    assert path.read_bytes() == content[:-1]
    repaired = isolated.run_all([isolated.REPAIR])
    after = {check.name: check for check in kernel_checks({**repaired, **isolated.run_all([isolated.KERNELS])})}
    assert after["repair"].detail == "1 damaged files deleted"
    assert after["cache files"].status is Status.OK
    assert not path.exists()
