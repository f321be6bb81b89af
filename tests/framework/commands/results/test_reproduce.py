"""Tests for the commands `reproduce` and `bundle`."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from tests.support.reported_run import store_parameter

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]
FAKE_CONF = ("--config-dir", str(CHECKOUT / "tests/support/fake_conf"))
FAKES = [*FAKE_CONF, *(f"{stage}=fake" for stage in ("dataset", "detector", "tracker", "refiner", "fuser"))]
REFINER = """
from dataclasses import dataclass, replace
import numpy as np
from instancemap import ClusterRefiner

@dataclass
class Shift(ClusterRefiner):
    distance: float = 0.0
    weights: str = ""

    def refine(self, clusters, frame):
        return replace(clusters, points_world=clusters.points_world + np.float32(self.distance))
"""


def command(folder: Path, *words: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command of InstanceMap in `folder`. `path` is an additional folder for imports."""
    paths = [str(CHECKOUT), *([str(path)] if path else [])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    line = [sys.executable, "-m", "framework", *words]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a run of the fake stages and a third-party refiner, and the package of the refiner."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "package/shift_refiner").mkdir(parents=True)
    (folder / "package/shift_refiner/__init__.py").write_text(REFINER)
    (folder / "conf/refiner").mkdir(parents=True)
    (folder / "conf/refiner/shift.yaml").write_text("_target_: shift_refiner.Shift\ndistance: 0.0\nweights: ''\n")
    (folder / "network.onnx").write_bytes(b"weights")
    conf = folder / "fake_conf"
    shutil.copytree(CHECKOUT / "tests/support/fake_conf", conf)
    shutil.copy(folder / "conf/refiner/shift.yaml", conf / "refiner")
    words = ["--config-dir", str(conf), *FAKES[2:-2], "refiner=shift", FAKES[-1], "hydra.run.dir=sweep/run"]
    words.append(f"refiner.weights={folder / 'network.onnx'}")
    done = command(folder, *words, path=folder / "package")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def run(runs: Path, tmp_path: Path) -> Path:
    """Return a copy of the run directory."""
    return Path(shutil.copytree(runs / "sweep/run", tmp_path / "sweep/run"))


def reproduce(runs: Path, run: Path, *words: str) -> subprocess.CompletedProcess[str]:
    conf = ("--config-dir", str(runs / "fake_conf"))
    return command(run.parent, "reproduce", str(run), *words, *conf, path=runs / "package")


def test_reproduce_unchanged_run_is_byte_identical(runs: Path, run: Path) -> None:
    done = reproduce(runs, run)
    assert (done.returncode, done.stdout) == (0, "run: byte-identical\n"), done.stderr


def test_reproduce_changed_parameter_is_named(runs: Path, run: Path) -> None:
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("distance: 0.0", "distance: 0.5"))
    done = reproduce(runs, run)
    assert done.returncode == 1
    assert "config.yaml: refiner.distance: expected 0.0, got 0.5" in done.stdout


def test_reproduce_edited_metrics_are_named(runs: Path, run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(metrics | {"instances.ap50": 0.99}))
    done = reproduce(runs, run, "--check-only")
    assert done.returncode == 1
    assert "metrics.json: expected the SHA-256" in done.stdout


def test_reproduce_replaced_network_is_named(runs: Path, run: Path) -> None:
    network = runs / "network.onnx"
    network.write_bytes(b"other weights")
    done = reproduce(runs, run, "--check-only")
    network.write_bytes(b"weights")
    assert done.returncode == 1
    assert re.search(rf"changed: refiner.weights: expected the file with the SHA-256 .* in {network}", done.stdout)


def test_reproduce_edited_table_reports_changed_cell(runs: Path, run: Path) -> None:
    assert command(run.parent.parent, "tables", "sweep").returncode == 0
    table = run.parent / "table.csv"
    lines = table.read_text().splitlines()
    count = dict(zip(*csv.reader(lines), strict=True))["frames"]
    table.write_text("\n".join([lines[0], lines[1].replace(f",{count},", ",97,")]) + "\n")
    done = command(run.parent.parent, "reproduce", "sweep/table.csv", "--check-only")
    assert done.returncode == 1
    assert f"table.csv: run: frames: expected {count} as in the runs, got 97" in done.stdout


def test_reproduce_changed_plugin_names_package_frame_and_stage(runs: Path, run: Path, tmp_path: Path) -> None:
    package = Path(shutil.copytree(runs / "package", tmp_path / "package"))
    source = package / "shift_refiner/__init__.py"
    source.write_text(source.read_text().replace("np.float32(self.distance)", "np.float32(0.3)"))
    conf = ("--config-dir", str(runs / "fake_conf"))
    done = command(tmp_path, "reproduce", str(run), *conf, path=package)
    assert done.returncode == 1
    assert "run: changed: plugin code of refiner: shift_refiner " in done.stdout
    assert "run: first difference: frame 0, refinement; different files: " in done.stdout


def test_reproduce_override_of_unknown_key_is_rejected(runs: Path, run: Path) -> None:
    done = reproduce(runs, run, "dataset.nothing=3")
    assert done.returncode == 1
    assert "dataset.nothing=3: expected KEY=VALUE with a key and a type of the run's config" in done.stderr


def test_reproduce_stored_config_cannot_read_environment(
    runs: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "hunter2")
    store_parameter(run, "refiner.weights", "${oc.env:SECRET}")
    command(run.parent, "verify", str(run), "--accept", "config.yaml", "metrics.json")
    done = reproduce(runs, run)
    assert done.returncode == 1
    assert "refiner.weights: expected a resolved value in the run's config.yaml, got ${oc.env:SECRET}" in done.stderr
    assert "hunter2" not in done.stdout + done.stderr


def test_reproduce_unknown_row_lists_rows(runs: Path, run: Path) -> None:
    done = reproduce(runs, run, "--row", "nothing")
    assert done.returncode == 1
    assert "error: --row: expected one of the rows all runs, got 'nothing'" in done.stderr


def test_bundle_with_plugin_is_reproduced_without_package(runs: Path, run: Path, tmp_path: Path) -> None:
    done = command(tmp_path, "bundle", "sweep", "--out", "experiment.zip", path=runs / "package")
    assert done.returncode == 0, done.stderr
    assert "experiment.zip: 1 run, " in done.stdout
    names = zipfile.ZipFile(tmp_path / "experiment.zip").namelist()
    assert {"run/metrics.json", "run/manifest.json", "plugins/shift_refiner/__init__.py"} <= set(names)
    assert "run/map.npz" not in names
    refused = command(tmp_path, "reproduce", "experiment.zip", *FAKE_CONF)
    assert "expected --trust-code for a bundle with plugin code" in refused.stderr
    done = command(tmp_path, "reproduce", "experiment.zip", "--trust-code", *FAKE_CONF)
    assert (done.returncode, done.stdout) == (0, "run: byte-identical\n"), done.stderr


def test_bundle_of_edited_run_is_rejected(runs: Path, run: Path, tmp_path: Path) -> None:
    (run / "trajectory.txt").write_text("")
    done = command(tmp_path, "bundle", "sweep", path=runs / "package")
    assert done.returncode == 1
    assert "trajectory.txt: expected the SHA-256" in done.stderr
    assert not (tmp_path / "sweep.zip").exists()
