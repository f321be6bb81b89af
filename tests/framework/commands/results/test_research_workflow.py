"""Tests for docs/tutorials/research_project.md: plugins, an experiment over datasets and detectors, and its bundle."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from instancemap import load_runs
from tests.support import option_files
from tests.support.doc_pages import blocks
from tests.support.fresh_environment import CHECKOUT, OFFLINE, PIP, build_wheels, create_environment, run_in
from tests.support.latex import log_of_paper, requires_pdflatex
from tests.support.table_text import grids

pytestmark = pytest.mark.acceptance

TUTORIAL = "docs/tutorials/research_project.md"
PACKAGE = CHECKOUT / "examples" / "my-methods"
EXPERIMENT = "outputs/nearest_points"
DATASETS, DETECTORS = ("desk", "my_recording", "my_room"), ("maskrcnn2go", "saturated_regions")
ROWS = ("identity", "nearest_points")
SMALL = ("dataset.stop=3", "tracker=ground_truth", "fuser.voxel_size=0.03", "fuser.min_observations=1")


def write_package(folder: Path, recording: Path) -> None:
    """Copy the package of the tutorial, with a recording in the folder `recording`."""
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    option = folder / "my_methods" / "conf" / "dataset" / "my_recording.yaml"
    option.write_text(option.read_text().replace("RECORDING", str(recording)))


def commands() -> list[list[str]]:
    """Return the words of the commands in the tutorial, without `instancemap`."""
    lines = "".join(blocks("bash", TUTORIAL)).splitlines()
    assert all(line.startswith("instancemap ") for line in lines)
    return [shlex.split(line)[1:] for line in lines]


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command of InstanceMap in `folder`, with the package installed there."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(CHECKOUT), str(folder / "installed")])}
    line = [sys.executable, "-m", "framework", *words]
    return subprocess.run(line, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the installed package and the outputs of its experiment."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "recording").mkdir()
    option_files.overrides("dataset", "rgbd_folder", folder / "recording")
    write_package(folder / "my-methods", folder / "recording")
    wheels = build_wheels(folder / "package", [folder / "my-methods"])
    subprocess.run([*PIP, "install", *OFFLINE, "--target", str(folder / "installed"), *wheels], check=True, timeout=120)
    run, _, _ = commands()
    done = command(folder, *run, *SMALL)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


def test_workflow_data_frame_has_one_run_per_combination(folder: Path) -> None:
    runs = load_runs(folder / EXPERIMENT)
    combinations = runs[["dataset", "detector", "row"]].itertuples(index=False, name=None)
    assert sorted(combinations) == sorted((d, n, row) for d in DATASETS for n in DETECTORS for row in ROWS)
    assert (runs["frames"] == 3).all()
    own = runs["row"] == "nearest_points"
    assert runs["code.refiner"][own].str.startswith("my_methods 0.1 ").all()
    assert runs["code.refiner"][~own].str.startswith("plugins.refiners.identity ").all()


def test_workflow_table_has_paired_differences(folder: Path) -> None:
    text = (folder / EXPERIMENT / "table.md").read_text()
    means, differences, statistics = grids(text)
    assert [line.split(" | ")[:2] for line in means[2:]] == [["| identity", "6"], ["| nearest_points", "6"]]
    assert differences[0] == "| minus identity | pairs | instances | AP50 | refinement (ms) |"
    [line] = differences[2:]
    assert line.startswith("| nearest_points | 6 | ")
    assert any(line.startswith("| refinement (ms) | nearest_points | 6 | ") for line in statistics)
    assert "- Differences are paired by dataset, detector: mean ± standard error over dataset, detector" in text
    assert f"- Command line: {' '.join([*commands()[0][1:], *SMALL])}." in text
    assert "Missing" not in text
    assert "Incomplete" not in text


def test_workflow_writes_figure(folder: Path) -> None:
    outputs = folder / EXPERIMENT
    assert (outputs / "figure.png").stat().st_size > 10_000
    assert (outputs / "figure.pdf").read_bytes().startswith(b"%PDF")


@requires_pdflatex
def test_workflow_table_compiles_in_latex(folder: Path, tmp_path: Path) -> None:
    table = (folder / EXPERIMENT / "table.tex").read_text()
    log = log_of_paper(tmp_path, table, "tab:nearest_points", "tab:nearest_points-differences")
    assert "Overfull" not in log
    assert "undefined" not in log


def test_workflow_bundle_is_reproduced_in_new_environment(folder: Path, tmp_path: Path) -> None:
    """The new environment has InstanceMap, but not the package with the plugins."""
    _, bundle, reproduce = commands()
    done = command(folder, *bundle)
    assert done.returncode == 0, done.stderr
    assert "nearest_points.zip: 12 runs, " in done.stdout
    shutil.copy(folder / "nearest_points.zip", tmp_path)
    create_environment(tmp_path)
    absent = "import importlib.util as util; print(util.find_spec('my_methods'))"
    assert run_in(tmp_path, "python", "-c", absent) == "None\n"
    message = run_in(tmp_path, "instancemap", *reproduce)
    compared = [line for line in message.splitlines() if ": changed: " not in line]
    assert len(compared) == 12
    assert all(line.endswith(": byte-identical") for line in compared), message


def test_workflow_edited_plugin_repeats_only_its_runs(folder: Path) -> None:
    """The detector is in another module of the same package."""
    source = folder / "installed/my_methods"
    text = (source / "__init__.py").read_text()
    split = text.index("@dataclass\nclass NearestPoints")
    imports = text[: text.index("@dataclass")]
    (source / "refiners.py").write_text(imports + text[split:])
    (source / "detectors.py").write_text(text[:split])
    (source / "__init__.py").write_text(
        "from .detectors import SaturatedRegions\nfrom .refiners import NearestPoints\n"
    )
    run, _, _ = commands()
    assert command(folder, *run, *SMALL).returncode == 0
    before = modification_times(folder)
    refiner = (source / "refiners.py").read_text()
    (source / "refiners.py").write_text(refiner.replace("<= np.quantile", "< np.quantile"))
    done = command(folder, *run, *SMALL)
    assert done.returncode == 0, done.stderr[-4000:]
    repeated = {name for name, time in modification_times(folder).items() if time != before[name]}
    assert repeated == {name for name in before if "row=nearest_points" in name}
    assert len(repeated) == 6


def modification_times(folder: Path) -> dict[str, int]:
    """Return the modification time of each run by the name of its directory."""
    return {path.parent.name: path.stat().st_mtime_ns for path in (folder / EXPERIMENT).glob("*/metrics.json")}
