"""Tests for the command `new-plugin`. The generated repositories are installed and tested outside of the checkout."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import framework
from framework.commands.installation.new_plugin import LONGEST_NAME, check_name, files_of, write_repository
from framework.errors import ConfigError
from framework.registry import GROUPS
from tests.support import option_files
from tests.support.doc_pages import blocks
from tests.support.fresh_environment import create_environment, run_in

pytestmark = pytest.mark.integration

CHECKOUT = Path(__file__).resolve().parents[4]
EXAMPLE = CHECKOUT / "examples" / "instancemap-depth-median"


def test_new_plugin_output_matches_example_plugin() -> None:
    written = files_of("refiner", "depth_median")
    files = {path.relative_to(EXAMPLE) for path in EXAMPLE.rglob("*") if path.is_file()}
    left = {path for path in files if not {"__pycache__", ".ruff_cache", ".pytest_cache"}.intersection(path.parts)}
    assert left == set(map(Path, written))
    for path, text in written.items():
        assert (EXAMPLE / path).read_text() == text, (
            f"{path}: expected the output of new-plugin, got other text; regenerate {EXAMPLE.name} with new-plugin"
        )


@pytest.mark.parametrize("name", ["x", "a" * LONGEST_NAME])
@pytest.mark.parametrize("stage", GROUPS)
def test_new_plugin_files_pass_ruff(stage: str, name: str, tmp_path: Path) -> None:
    made = write_repository(stage, name, tmp_path)
    for line in (["check", "--no-cache"], ["format", "--check", "--no-cache"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *line], cwd=made, capture_output=True, text=True, timeout=60
        )
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gmm_em", "NAME: expected a new name, got the existing option refiner=gmm_em"),
        ("../up", "got '../up'"),
        ("/tmp/x", "got '/tmp/x'"),
        ("My", "got 'My'"),
        ("", "got ''"),
        ("a__b", "got 'a__b'"),
        ("2d", "got '2d'"),
        ("x" * (LONGEST_NAME + 1), f"at most {LONGEST_NAME} characters"),
        ("class", "NAME: expected a name other than a Python keyword, conf or"),
        ("conf", "NAME: expected a name other than a Python keyword, conf or"),
        ("null", "NAME: expected a name that YAML reads as a string, got null (null, a boolean or a number)"),
        ("nan", "NAME: expected a name that YAML reads as a string, got nan (null, a boolean or a number)"),
        ("on", "NAME: expected a name that YAML reads as a string, got on (null, a boolean or a number)"),
        ("config_error", "not used in the template, got config_error (class ConfigError)"),
        ("cluster_refiner", "not used in the template, got cluster_refiner (class ClusterRefiner)"),
    ],
)
def test_new_plugin_invalid_name_raises(name: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_name("refiner", name)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_new_plugin_failure_keeps_existing_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = write_repository("refiner", "mine", tmp_path)
    (made / "README.md").write_text("my own")
    with pytest.raises(ConfigError, match="expected a missing path"):
        write_repository("refiner", "mine", tmp_path)
    assert (made / "README.md").read_text() == "my own"
    with pytest.raises(ConfigError, match="--in: expected an existing folder"):
        write_repository("refiner", "other", tmp_path / "nowhere")
    (tmp_path / "instancemap-linked").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="expected a missing path"):
        write_repository("refiner", "linked", tmp_path)

    def full(path: Path, *_: object, **__: object) -> int:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(Exception, match=r"instancemap-other: .* got an error \(No space left on device\)"):
        write_repository("refiner", "other", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {made.name, "instancemap-linked"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with one plugin repository per group and the virtual environment `env`.

    The plugins and InstanceMap are installed in `env` from wheels. The dependencies are those of the current
    environment.
    """
    folder = tmp_path_factory.mktemp("stranger")
    for stage in GROUPS.keys() - {"refiner"}:
        write_repository(stage, f"my_{stage}", folder)
    line = [sys.executable, "-m", "framework", "new-plugin", "refiner", "my_refiner", "--in", str(folder)]
    message = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, check=True, timeout=60).stdout
    assert len(message.splitlines()) == 3
    create_environment(folder, folder.glob("instancemap-my-*"))
    return folder


@pytest.mark.acceptance
def test_new_plugin_installed_plugins_pass_their_tests(place: Path) -> None:
    where = run_in(place, "python", "-c", "import framework, instancemap_my_refiner; print(framework.__file__)")
    assert where.startswith(str(place))
    (place / "pytest.ini").touch()
    tests = [str(path) for path in place.glob("instancemap-my-*/tests/test_*.py")]
    assert len(tests) == len(GROUPS)
    message = run_in(place, "python", "-m", "pytest", "--quiet", "-p", "no:dash", "--import-mode=importlib", *tests)
    assert " passed" in message
    assert "skipped" not in message


@pytest.mark.acceptance
def test_new_plugin_and_builtin_option_are_in_one_sweep_table(place: Path) -> None:
    (place / "DIR").mkdir()
    option_files.overrides("dataset", "rgbd_folder", place / "DIR")
    chosen = "dataset=rgbd_folder dataset.root=DIR detector=simulated tracker=ground_truth fuser.min_observations=1"
    more = ("viewer=my_viewer", "hydra.sweep.dir=outputs/first_sweep")
    message = run_in(place, "instancemap", "-m", "refiner=gmm_em,my_refiner", *chosen.split(), *more)
    records = [json.loads(path.read_text()) for path in (place / "outputs" / "first_sweep").glob("*/metrics.json")]
    assert [record["frames"] for record in records] == [3, 3]
    assert all(record["instances.count"] > 0 for record in records)
    for job in ("refiner=gmm_em", "refiner=my_refiner"):
        [log] = (place / "outputs" / "first_sweep").glob(f"*{job}*/frames.jsonl")
        assert [json.loads(line)["frame"] for line in log.read_text().splitlines()] == [0, 1, 2]
    assert run_in(place, "instancemap", "tables", "outputs/first_sweep").strip() in message
    with (place / "outputs" / "first_sweep" / "table.csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [row["refiner"] for row in rows] == ["gmm_em", "my_refiner"]
    assert "refiner=my_refiner" in message
    listed = run_in(place, "instancemap", "plugins", "refiner", "my_refiner")
    assert "my_refiner  [from instancemap-my-refiner]" in listed


@pytest.mark.acceptance
def test_installed_package_runs_doctor_and_new_plugin(place: Path) -> None:
    sections = json.loads(run_in(place, "instancemap", "doctor", "--json"))
    found = {section["title"]: {check["name"]: check for check in section["checks"]} for section in sections}
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    assert set(found["Libraries"]) == {Requirement(line).name for line in project["dependencies"]}
    assert set(found["Extras (optional)"]) == project["optional-dependencies"].keys()
    assert found["InstanceMap"]["commit"]["detail"] == "no checkout"
    assert "written: instancemap-other" in run_in(place, "instancemap", "new-plugin", "tracker", "other")
    assert (place / "instancemap-other" / "instancemap_other" / "other.py").exists()


@pytest.mark.acceptance
def test_installed_package_maps_desk(place: Path) -> None:
    """The command with its default dataset and the Python example of the README run on a few frames."""
    assert run_in(place, "instancemap", "--version") == f"instancemap {framework.__version__}\n"
    run_in(place, "instancemap", "dataset.stop=3", "hydra.run.dir=desk")
    assert json.loads((place / "desk" / "metrics.json").read_text())["frames"] == 3
    run_in(place, "python", "-c", blocks("python", "README.md")[0].replace("stop=14", "stop=3"))
    assert (place / "desk.npz").exists()
