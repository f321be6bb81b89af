"""Tests for stored runs, including damaged and missing runs."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from framework.errors import DataError
from framework.files.manifest import Manifest, RunStatus
from framework.runs import stored_runs
from framework.runs.inputs import inputs_sha256
from framework.runs.plugin_code import plugin_code
from framework.runs.provenance import config_hash
from framework.runs.stored_runs import MAPPED, find_records, is_recorded, read_config, read_record

CONFIG = {"seed": 3, "fuser": {"voxel_size": 0.02, "far": 1e-9, "storage": "EXACT", "none": None}, "on": [1, "2", True]}


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Return a complete run directory."""
    directory = tmp_path / "run"
    directory.mkdir()
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(CONFIG)))
    write(directory, config_hash=config_hash(CONFIG))
    for name in MAPPED:
        (directory / name).touch()
    (directory / "manifest.json").write_text("{}")
    return directory


@pytest.fixture(autouse=True)
def code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_runs, "code_version", lambda: {"git_commit": "abcdef0123", "git_dirty": False})


def write(directory: Path, **metrics: object) -> None:
    expected = {"instances.ap50": 0.5, "git_commit": "abcdef0123", "git_dirty": False}
    (directory / "metrics.json").write_text(json.dumps(expected | metrics))


def test_read_record_returns_config_and_metrics(directory: Path) -> None:
    record = read_record(directory)
    assert record.config == CONFIG
    assert record.metrics["instances.ap50"] == 0.5
    assert record.commit == "abcdef0"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("metrics.json", "", "metrics.json: expected"),
        ("metrics.json", '{"seed": 0', "metrics.json: expected"),
        ("metrics.json", "[" * 100_000, "metrics.json: expected"),
        ("metrics.json", "\xff", "metrics.json: expected"),
        ("metrics.json", "[1, 2]", r"metrics\.json: expected a JSON object, got \[1, 2\]"),
        ("metrics.json", '{"fps": [1]}', r"metrics\.json: expected flat values, got nested values below 'fps'"),
        ("metrics.json", '{"instances.ap50": "best"}', r"instances\.ap50: expected a number or null, got 'best'"),
        (
            "metrics.json",
            '{"trajectory.ate_rmse_m": NaN}',
            r"trajectory\.ate_rmse_m: expected a number or null, got nan",
        ),
        ("metrics.json", '{"fps": 1e999}', "fps: expected a number or null, got inf"),
        ("metrics.json", '{"frames": true}', "frames: expected a number or null, got True"),
        ("metrics.json", "{}", "expected the config_hash of config.yaml, "),
        ("config.yaml", "seed: 4", "expected the config_hash of config.yaml, "),
        ("config.yaml", "", "expected the config_hash of config.yaml, "),
        ("config.yaml", "seed: [", "config.yaml: expected valid YAML"),
        ("config.yaml", "word", "expected the config_hash of config.yaml, "),
        ("config.yaml", "7", r"config\.yaml: expected keys and values, got a single value"),
        ("config.yaml", "- 1", r"config\.yaml: expected keys and values, got a list"),
        (
            "config.yaml",
            "fuser: {true: 1, voxel_size: 2}",
            "expected the config_hash of config.yaml, ",
        ),
    ],
)
def test_read_record_invalid_file_raises_one_line_error(directory: Path, name: str, content: str, message: str) -> None:
    (directory / name).write_text(content, encoding="latin-1")
    with pytest.raises(DataError, match=message) as caught:
        read_record(directory)
    assert "\n" not in str(caught.value)
    found, others = find_records(directory.parent)
    assert found == []
    assert [(one.directory, one.reason) for one in others] == [(directory, str(caught.value))]
    assert not is_recorded(directory, OmegaConf.create(CONFIG))


def test_read_record_without_config_raises(directory: Path) -> None:
    (directory / "config.yaml").unlink()
    with pytest.raises(DataError, match=r"config.yaml: expected a file, got none"):
        read_record(directory)


@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({}, "incomplete: running or killed"),
        ({"instancemap.log": "12:00:00 INFO    mapping\n"}, "incomplete: running or killed"),
        (
            {"instancemap.log": "12:00:00 INFO    mapping\n12:00:01 ERROR   fuser: bad\nTraceback\n  x\n"},
            "failed: fuser: bad",
        ),
        (
            {"instancemap.log": "12:00:01 ERROR   fuser: bad\n12:00:02 INFO    mapping again\n"},
            "incomplete: running or killed",
        ),
        ({"metrics.partial.json": '{"partial": "interrupted by Ctrl-C"}'}, "partial: interrupted by Ctrl-C"),
        ({"metrics.partial.json": "{"}, "expected valid JSON"),
    ],
)
def test_find_records_gives_reason_for_incomplete_run(directory: Path, files: dict[str, str], reason: str) -> None:
    (directory / "metrics.json").unlink()
    (directory / "instancemap.log").write_text("")
    for name, content in files.items():
        (directory / name).write_text(content)
    found, [other] = find_records(directory.parent)
    assert found == []
    assert reason in other.reason


def test_find_records_ignores_other_files(directory: Path) -> None:
    (directory.parent / "table.md").write_text("")
    (directory.parent / ".hydra").mkdir()
    (directory.parent / ".hydra" / "metrics.json").write_text("{}")
    found, others = find_records(directory.parent)
    assert [record.directory for record in found] == [directory]
    assert others == []


def test_is_recorded_changed_plugin_code_is_false(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    refiner = {"_target_": "plugins.refiners.identity.Identity"}
    config = CONFIG | {"refiner": refiner}
    metrics = json.loads((directory / "metrics.json").read_text()) | {"config_hash": config_hash(config)}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(config))
    for code, is_complete in ((plugin_code(config), True), ({"code.refiner": "mean 0.1 3f"}, False)):
        (directory / "metrics.json").write_text(json.dumps(metrics | code))
        assert is_recorded(directory, OmegaConf.create(config)) is is_complete
    assert f"repeating the run: the code changed since the run in {directory}: refiner: mean 0.1 3f ->" in caplog.text


def test_read_config_of_other_run_raises(directory: Path) -> None:
    assert read_config(directory) == CONFIG
    Manifest(RunStatus.COMPLETE, {}, {}, {}).with_files(directory, ["config.yaml"]).write(directory)
    (directory / "config.yaml").write_text("seed: 4\n")
    with pytest.raises(DataError, match=r"config\.yaml: expected the SHA-256"):
        read_config(directory)
    (directory / "config.yaml").unlink()
    assert read_config(directory) == {}


def test_is_recorded_without_manifest_is_false(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    (directory / "manifest.json").unlink()
    assert not is_recorded(directory, OmegaConf.create(CONFIG))
    assert f"repeating the run: {directory / 'manifest.json'}: expected a file, got none" in caplog.text


def test_is_recorded_same_config_is_true(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert is_recorded(directory, OmegaConf.create(CONFIG | {"debug": True}))
    assert caplog.messages == [f"skipped: the completed run in {directory}"]


def test_is_recorded_logs_missing_map_files(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The user may have removed the map files to save disk space. The metrics remain valid."""
    (directory / "map.npz").unlink()
    (directory / "mesh.ply").unlink()
    assert is_recorded(directory, OmegaConf.create(CONFIG))
    assert (
        f"{directory}: expected map.npz, mesh.ply, got none; set skip_completed=false to repeat the run"
        in caplog.messages
    )


def test_is_recorded_other_config_is_false(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    assert not is_recorded(directory, OmegaConf.create(CONFIG | {"seed": 4}))
    assert caplog.messages == [f"repeating the run: the config in {directory} differs"]


@pytest.mark.parametrize("theirs", [{"git_commit": "1234567890"}, {"git_dirty": True}])
def test_is_recorded_other_code_is_true_with_warning(
    directory: Path, caplog: pytest.LogCaptureFixture, theirs: dict[str, object]
) -> None:
    write(directory, config_hash=config_hash(CONFIG), **theirs)
    assert is_recorded(directory, OmegaConf.create(CONFIG))
    [record] = caplog.records
    assert record.levelno == logging.WARNING
    assert "the current commit is abcdef0" in record.getMessage()


SETTINGS = {"threads": 4, "prefetch": 2, "detection_cache": "off"}
MACHINE = {"environment.processor": "a", "environment.cpus": 4}


def record_of(directory: Path, config: dict[str, object], monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a complete directory of a run with this config on the machine MACHINE."""
    monkeypatch.setattr(stored_runs, "environment", lambda: MACHINE)
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    write(directory, config_hash=config_hash(config), inputs_sha256=inputs_sha256(config), **MACHINE)


@pytest.mark.parametrize("changed", [{"threads": 1}, {"prefetch": 0}, {"detection_cache": "read_write"}])
def test_is_recorded_speed_experiment_needs_same_settings(
    directory: Path, changed: dict[str, object], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    config = CONFIG | SETTINGS
    record_of(directory, config, monkeypatch)
    about_results = {"table": {"columns": ["instances.ap50", "stage_ms.fusion.median"]}}
    about_speed = {"table": {"columns": ["fps"]}}
    assert is_recorded(directory, OmegaConf.create(config | about_speed))
    assert is_recorded(directory, OmegaConf.create(config | changed | about_results))
    assert is_recorded(directory, OmegaConf.create(config | changed))
    caplog.clear()
    assert not is_recorded(directory, OmegaConf.create(config | changed | about_speed))
    assert caplog.messages == [
        f"repeating the run: the times in {directory} were measured with other settings or on another machine: "
        "threads=4, prefetch=2, detection_cache=off, processor=a, cpus=4"
    ]


def test_is_recorded_speed_experiment_needs_same_machine(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = CONFIG | SETTINGS | {"table": {"columns": ["fps"]}}
    record_of(directory, config, monkeypatch)
    assert is_recorded(directory, OmegaConf.create(config))
    monkeypatch.setattr(stored_runs, "environment", lambda: MACHINE | {"environment.cpus": 8})
    assert not is_recorded(directory, OmegaConf.create(config))


def test_is_recorded_changed_weights_or_data_is_false(
    directory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    weights, data = tmp_path / "net.onnx", tmp_path / "data" / "room" / "depth"
    data.mkdir(parents=True)
    weights.write_bytes(b"one")
    (data / "0.png").write_bytes(b"depth")
    dataset = {"root": str(tmp_path / "data"), "scene": "room"}
    config = CONFIG | {"dataset": dataset, "detector": {"weights": str(weights), "labels": "auto"}}
    for change in (
        lambda: weights.write_bytes(b"two"),
        lambda: (data / "1.png").write_bytes(b"depth"),
        lambda: (data / "0.png").write_bytes(b"other depth"),
        lambda: os.utime(data / "0.png", ns=(1, 1)),
        lambda: (tmp_path / "data" / "camera.json").write_text("{}"),
    ):
        record_of(directory, config, monkeypatch)
        assert is_recorded(directory, OmegaConf.create(config))
        change()
        caplog.clear()
        assert not is_recorded(directory, OmegaConf.create(config))
        assert caplog.messages == [f"repeating the run: weights or data changed since the run in {directory}"]
    record_of(directory, config, monkeypatch)
    (tmp_path / "data" / "another room").mkdir()
    (tmp_path / "data" / "another room" / "0.png").write_bytes(b"depth")
    (data / "outputs").mkdir()
    (data / "outputs" / "table.md").write_text("of runs that were begun here")
    os.utime(weights, ns=(1, 1))
    assert is_recorded(directory, OmegaConf.create(config)), "expected no effect of these changes on the inputs"


def test_is_recorded_without_inputs_hash_is_true(directory: Path, tmp_path: Path) -> None:
    config = CONFIG | {"dataset": {"root": str(tmp_path), "scene": ""}}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    write(directory, config_hash=config_hash(config))
    assert is_recorded(directory, OmegaConf.create(config))


def test_is_recorded_empty_folder_is_false(tmp_path: Path) -> None:
    assert not is_recorded(tmp_path, OmegaConf.create(CONFIG))
    assert find_records(tmp_path) == ([], [])


def test_find_records_completes_interrupted_replacement(directory: Path) -> None:
    replacing = directory / ".replacing"
    replacing.mkdir()
    for name in ("metrics.json", "config.yaml"):
        (directory / name).rename(replacing / name)
    records, others = find_records(directory.parent)
    assert ([one.directory for one in records], others) == ([directory], [])
    assert not replacing.exists()
