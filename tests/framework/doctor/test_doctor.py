"""What `doctor` says, on this machine and on ones where something is missing or broken."""

from __future__ import annotations

import getpass
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement

from framework.compilation.catalog import DEFAULT, listed
from framework.detection.mask_rcnn.published_weights import PUBLISHED
from framework.doctor import machine, networks, requirements, trial
from framework.doctor.check_result import Finding, State, anonymous, section

CHECKOUT = Path(__file__).resolve().parents[3]
LOOKS = (networks.shipped, networks.downloaded, networks.from_hugging_face)
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


def test_broken_libraries_are_told_each_in_one_line_and_the_others_are_looked_at(tmp_path: Path) -> None:
    """One cannot be loaded, one ends the process that loads it."""
    broken_library(tmp_path, "torch", "raise ImportError('libtorch.so: no such\\nfile')")
    broken_library(tmp_path, "open3d", "import os, signal\nos.kill(os.getpid(), signal.SIGILL)")
    done = doctor(tmp_path, PYTHONPATH=str(tmp_path), HOME=str(tmp_path))
    assert done.returncode == 1
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    [torch], [open3d] = ([line for line in lines if line.startswith(f"  !!  {name} ")] for name in ("torch", "open3d"))
    assert torch.endswith("cannot be imported: ImportError: libtorch.so: no such file")
    assert open3d.endswith("cannot be imported: ends the process (SIGILL)")
    assert "> pip install --force-reinstall --no-deps 'open3d==" in lines[lines.index(open3d) + 1]
    assert any(line.startswith("  ok  numpy ") for line in lines)
    assert lines[-1] == "2 of what the default stages need are not as it must be: see !! above"
    assert str(tmp_path) not in done.stdout.replace("~", "")
    assert done.stdout.isascii()
    written = {path.name for path in tmp_path.iterdir()} - {"torch", "open3d"}
    assert written <= {".config", ".cache"}, "matplotlib's own, when it is imported"


def test_a_sound_machine_has_all_that_the_default_stages_need(tmp_path: Path) -> None:
    done = doctor(tmp_path, "--json", "debug=true", INSTANCEMAP_OFFLINE="1")
    sections: list[dict[str, Any]] = json.loads(done.stdout)
    found = {of["title"]: {one["name"]: one for one in of["findings"]} for of in sections}
    assert done.returncode == any(one["state"] == "broken" for of in found.values() for one in of.values())
    assert list(found["Libraries"]) == [Requirement(line).name for line in PROJECT["dependencies"]]
    assert {one["state"] for one in found["Libraries"].values()} == {"there"}
    assert set(found["Extras, optional"]) == PROJECT["optional-dependencies"].keys() - requirements.NOT_OF_USERS
    for of in found.values():
        for one in of.values():
            assert one["state"] in ("there", "optional", "broken")
            assert "\n" not in one["detail"] + one["remedy"]
    assert found["Networks"]["maskrcnn2go"]["detail"].startswith("comes with the project, 3.")
    assert "but INSTANCEMAP_OFFLINE is set" in found["Networks"]["resnet50_fpn_coco_detectron2"]["detail"]
    assert found["Environment variables"]["INSTANCEMAP_OFFLINE"]["detail"] == "1"
    assert found["Compiled kernels"]["default"]["detail"].split()[2] == str(len(listed(DEFAULT)))


def test_a_version_out_of_bounds_and_a_library_that_is_missing_are_broken() -> None:
    old = requirements.of_library(Requirement("numpy<1"), None)
    assert (old.state, old.remedy) == (State.BROKEN, "pip install 'numpy<1'")
    assert old.detail.endswith("but <1 is needed")
    missing = requirements.of_library(Requirement("no-such-library>=2"), None)
    assert (missing.detail, missing.remedy) == ("not installed", "pip install 'no-such-library>=2'")
    extra = requirements.of_extra("some", [Requirement("numpy"), Requirement("no-such-library")])
    assert (extra.state, extra.remedy) == (State.OPTIONAL, "pip install 'instancemap[some]'")


def test_every_library_that_is_needed_is_imported() -> None:
    found = {requirement.name: requirements.module_of(requirement) for requirement in requirements.needs().always}
    assert None not in found.values()
    assert (found["opencv-python-headless"], found["scikit-learn"], found["torch"]) == ("cv2", "sklearn", "torch")


def test_a_name_behind_one_that_ends_the_process_is_tried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_library(tmp_path, "ending", "import os\nos._exit(3)")
    broken_library(tmp_path, "hanging", "import time\ntime.sleep(60)")
    broken_library(tmp_path, "talking", "print('loaded')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    answers = trial.tried([["json", "ending", "talking"]])
    assert answers == {"json": {}, "ending": {"fault": "ends the process (exit status 3)"}, "talking": {}}
    monkeypatch.setattr(trial, "PATIENCE", 2.0)
    assert trial.tried([["hanging"]]) == {"hanging": {"fault": "does not end within 2 s"}}


def test_what_cannot_be_looked_at_does_not_stop_the_rest() -> None:
    def _broken_look() -> list[Finding]:
        raise OSError(5, "Input/output error")

    def without_library() -> list[Finding]:
        raise ImportError("no yaml")

    fine = Finding("fine", State.THERE, "")
    found = section("x", _broken_look, without_library, lambda: [fine]).findings
    assert found[0] == Finding("broken look", State.OPTIONAL, "OSError: [Errno 5] Input/output error")
    assert (found[1].name, found[1].state, found[1].detail) == (
        "without library",
        State.BROKEN,
        "ImportError: no yaml",
    )
    assert found[2] == fine


def test_names_of_people_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/alice")
    monkeypatch.setattr(getpass, "getuser", lambda: "alice")
    assert anonymous("/home/alice/.cache in /media/alice/disk") == "~/.cache in /media/USER/disk"


def test_missing_system_libraries_and_networks_are_told_with_what_gets_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    libraries = (machine.SystemLibrary("libnone.so.9", "libnone9", "nothing", needed=True),)
    monkeypatch.setattr(machine, "SYSTEM_LIBRARIES", libraries)
    missing = Finding("libnone9", State.BROKEN, "libnone.so.9 is missing, for nothing", "apt-get install libnone9")
    assert list(machine.system_libraries()) == [missing]
    monkeypatch.setattr(networks, "PROJECT_ROOT", tmp_path)
    states = {finding.name: finding.state for finding in networks.shipped()}
    assert states.pop("maskrcnn2go") is State.BROKEN, "runs that name no detector need it"
    assert set(states.values()) == {State.OPTIONAL}


def test_every_option_of_a_detector_that_names_weights_is_listed() -> None:
    """By the parameters that weights have, where `doctor` goes by what the values look like."""
    named = [finding.name for look in LOOKS for finding in look()]
    assert len(named) == len(set(named))
    found: set[str] = set()
    for path in (CHECKOUT / "conf" / "detector").glob("*.yaml"):
        content: dict[str, Any] = yaml.safe_load(path.read_text())
        given = {key: content[key] for key in ("weights", "model", "masks") if content.get(key, "???") != "???"}
        for key, value in given.items():
            found.add(value if value in PUBLISHED else path.stem if len(given) == 1 else f"{path.stem}.{key}")
    assert found | PUBLISHED.keys() == set(named)
    assert {"with_embeddings", "open_vocabulary.model", "open_vocabulary.masks"} < found


def test_a_new_option_with_weights_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert [*networks.shipped()] == [Finding("own", State.THERE, "comes with the project, 2.5 MB")]
    details = [(finding.name, finding.detail, finding.remedy) for finding in networks.from_hugging_face()]
    assert details == [
        ("two.first", "somebody/one is not downloaded", "instancemap detector=two"),
        ("two.second", "somebody/two is not downloaded", "instancemap detector=two"),
    ]


def test_models_in_the_cache_of_hugging_face_are_found_when_they_are_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rf_detr_seg() -> tuple[State, str]:
        return next((of.state, of.detail) for of in networks.from_hugging_face() if of.name == "rf_detr_seg")

    for name in HUB_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    model, size = "Roboflow/rf-detr-seg-nano", f"downloaded, {networks.MEGABYTES['Roboflow/rf-detr-seg-nano']} MB"
    assert rf_detr_seg() == (State.OPTIONAL, f"{model} is not {size}, but HF_HUB_OFFLINE is set")
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    snapshot = tmp_path / "huggingface/hub/models--Roboflow--rf-detr-seg-nano/snapshots/0123"
    blobs = snapshot.parents[1] / "blobs"
    snapshot.mkdir(parents=True)
    blobs.mkdir()
    (snapshot.parent / ".DS_Store").touch()
    (blobs / "abc").write_bytes(b"{}")
    (blobs / "def.incomplete").write_bytes(bytes(1_000_000))
    (snapshot / "config.json").symlink_to(blobs / "abc")
    assert rf_detr_seg() == (State.OPTIONAL, f"{model} is only in part {size}")
    (blobs / "def.incomplete").rename(blobs / "def")
    (snapshot / "model.safetensors").symlink_to(blobs / "def")
    assert rf_detr_seg() == (State.THERE, f"{model}, 1 MB in {anonymous(str(tmp_path))}/huggingface/hub")


def test_the_size_of_every_model_id_is_known() -> None:
    ids = {value for _, value in networks._named() if not value.startswith(networks.SHIPPED)}
    assert ids == networks.MEGABYTES.keys()


def test_little_room_on_a_disk_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 1e8})())
    assert [finding.detail.partition(" in ")[0] for finding in machine.disk()] == ["0.1 GB free"] * 3
    assert all(finding.state is State.OPTIONAL and finding.remedy for finding in machine.disk())
