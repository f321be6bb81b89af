"""Tests for `python -m framework` as a process."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from framework.__main__ import COMMANDS, leave_working_folder, main, module_of
from framework.files.search_paths import CONF
from framework.runs.provenance import config_hash
from tests.support.forked_commands import FAKE_CONF, clean_environment, completed

pytestmark = pytest.mark.integration
REPEATED = pytest.mark.acceptance  # the same rule with other values

CHECKOUT = Path(__file__).resolve().parents[2]
STAGES = ("dataset", "detector", "tracker", "refiner", "fuser")
FAKE_STAGES = ["--config-dir", str(FAKE_CONF), *(f"{stage}=fake" for stage in STAGES)]
RECORD = {"config.yaml", "metrics.json", "instances.json", "mesh.ply", "trajectory.txt", "timings.csv", "map.npz"}


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "framework", *FAKE_STAGES, *arguments]


def environment() -> dict[str, str]:
    return clean_environment() | {"PYTHONPATH": str(CHECKOUT)}


def start(directory: Path, *arguments: str, sweep: bool = False) -> subprocess.CompletedProcess[str]:
    places = [f"hydra.run.dir={directory}", f"hydra.sweep.dir={directory}"]
    return completed(directory, *["-m"] * sweep, *FAKE_STAGES, *places, *arguments)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("detector=fakke", ["detector: expected one of", "got fakke; did you mean fake?"]),
        (
            "dataset.frames=many",
            ["ERROR", "CornerRoom", "frames", "'many'", "expected an integer"],
        ),
        (
            "refiner._target_=this.GivenPose",
            ["ERROR", "got this.GivenPose", "refiner: expected the _target_ of a registered option of"],
        ),
        ("fuser.capcity=3", ["fuser.capcity", "did you mean fuser.capacity?"]),
        ("dataset.frames=[1", ["dataset.frames=[1", "KEY=VALUE"]),
        ("seed=-1", ["ERROR", "seed", "seed: expected an integer in [0, ", "got -1"]),
        ("skip_completed=flase", ["ERROR", "skip_completed", "'flase'"]),
        ("debug=maybe", ["ERROR", "debug: expected true or false, got 'maybe'"]),
        ("tracker=null", ["group override must be a string"]),
        ("prefetch=x", ["ERROR", "prefetch", "1000", "'x'"]),
        ("threads=1000000", ["ERROR", "threads: expected an integer in [0, 4096], got 1000000"]),
        (f"detector={'x' * 100_000}", ["File name too long", "characters)"]),
        (f"seed={'x' * 100_000}", ["seed: expected an integer in [", "characters)"]),
        (
            "--experimental-rerun=config.pickle",
            ["--experimental-rerun: expected KEY=VALUE overrides, got a pickle file"],
        ),
        (
            "--experimental-r=config.pickle",
            ["--experimental-rerun: expected KEY=VALUE overrides, got a pickle file"],
        ),
    ],
)
def test_run_invalid_override_exits_with_one_line_error(tmp_path: Path, override: str, message: list[str]) -> None:
    done = start(tmp_path, override)
    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert len(done.stderr) < 1200
    for words in message:
        assert words in done.stderr


def test_run_checks_stages_before_dataset(tmp_path: Path) -> None:
    done = start(tmp_path, "fuser.capacity=abc", "dataset.frames=many")
    assert "'abc'" in done.stderr
    assert "'many'" not in done.stderr


def test_run_escapes_invalid_unicode_file_names(tmp_path: Path) -> None:
    camera = {"width": 4, "height": 4, "fx": 4, "fy": 4, "cx": 2, "cy": 2, "depth_scale": 1000}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    for folder in ("color", "depth"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / os.fsdecode(b"\xff_0.png")).write_text("no picture")
    done = start(tmp_path, "dataset=rgbd_folder", f"dataset.root={tmp_path}")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 3, done.stderr
    for message in (done.stderr, (tmp_path / "instancemap.log").read_text("utf-8")):
        assert f"frame skipped: {tmp_path}/color/\\udcff_0.png: expected a JPEG or PNG file" in message


def test_leave_working_folder_in_deleted_folder_exits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(
        SystemExit,
        match=r"^error: working directory: expected an existing folder, got a deleted folder; change to another",
    ):
        leave_working_folder([])


@pytest.mark.parametrize(("options", "at"), [([], None), (["--config-dir", "conf"], -1), (["-cd=conf"], -1)])
def test_module_search_path_excludes_working_directory(
    options: list[str], at: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With --config-dir, Hydra appends the working directory at the end of the path."""
    monkeypatch.chdir(tmp_path)
    for first in ("", str(tmp_path)):
        monkeypatch.setattr(sys, "path", [first, "/elsewhere"])
        leave_working_folder(["detector=x", *options])
        assert sys.path == (["/elsewhere"] if at is None else ["/elsewhere", str(tmp_path)])
    monkeypatch.setattr(sys, "path", ["/usr/bin", "/elsewhere"])  # like in the console script
    leave_working_folder(options)
    assert sys.path == ["/usr/bin", "/elsewhere", *([] if at is None else [str(tmp_path)])]
    monkeypatch.chdir(CHECKOUT)
    monkeypatch.setattr(sys, "path", [str(CHECKOUT)])
    leave_working_folder([])
    assert sys.path == [str(CHECKOUT)], "expected only the project folder"


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("NUMBA_NUM_THREADS", "0"),
        ("NUMBA_DISABLE_JIT", "1"),
        pytest.param("NUMBA_THREADING_LAYER", "foo", marks=REPEATED),
        pytest.param("NUMBA_OPT", "9", marks=REPEATED),
    ],
)
def test_command_invalid_variable_is_one_line_error(tmp_path: Path, variable: str, value: str) -> None:
    line = [sys.executable, "-m", "framework", "compile", "nothing"]
    done = subprocess.run(
        line, cwd=tmp_path, env=environment() | {variable: value}, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(rf"error: {variable}: expected .*, got '{value}'; unset it.*\n", done.stderr), done.stderr


def test_commands_ignore_matplotlib_backend_of_user(tmp_path: Path) -> None:
    code = "import framework.commands, matplotlib; print(matplotlib.get_backend())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment() | {"MPLBACKEND": "foo"}, stdout=subprocess.PIPE,
        text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "agg\n"


COMPILE, MAP = ["compile", "nothing"], ["detector=simulated", "dataset=synthetic"]
LIBRARY = """
import os, signal
try:
    os.kill(os.getpid(), signal.{name})
    import time; time.sleep(10)
except KeyboardInterrupt:
    raise ImportError("expected a working library") from None
"""


@pytest.mark.skipif(sys.platform == "win32", reason="requires signals of POSIX")
@pytest.mark.parametrize(
    ("library", "arguments", "name", "line"),
    [
        ("filelock", COMPILE, "SIGINT", "interrupted by Ctrl-C"),
        ("pycolmap", MAP, "SIGUSR1", "ended by SIGUSR1"),
        pytest.param("filelock", COMPILE, "SIGUSR1", "ended by SIGUSR1", marks=REPEATED),
        pytest.param("pycolmap", MAP, "SIGINT", "interrupted by Ctrl-C", marks=REPEATED),
    ],
)
def test_command_signal_while_loading_is_one_line(
    tmp_path: Path, library: str, arguments: list[str], name: str, line: str
) -> None:
    (tmp_path / f"{library}.py").write_text(LIBRARY.format(name=name))
    path = os.pathsep.join([str(tmp_path), str(CHECKOUT)])
    done = subprocess.run(
        [sys.executable, "-m", "framework", *arguments], cwd=tmp_path, env=environment() | {"PYTHONPATH": path},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (128 + signal.Signals[name], f"{line}\n")


def test_run_log_not_writable_is_one_warning(tmp_path: Path) -> None:
    (tmp_path / "instancemap.log").symlink_to(tmp_path / "missing" / "run.log")
    done = start(tmp_path, "dataset.frames=2")
    assert done.returncode == 0
    assert done.stderr.count("instancemap.log: expected a writable file, got an error (No such file or directory)") == 1
    assert {path.name for path in tmp_path.iterdir()} >= RECORD


def test_run_directory_creation_error_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "outputs").touch()
    line = command("seed=0")
    done = subprocess.run(line, cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert re.fullmatch(r"error: outputs/.*_fake: expected a writable parent folder, got .*\n", done.stderr)


@pytest.mark.parametrize("sweep", [False, True])
def test_run_empty_output_directory_is_rejected(tmp_path: Path, sweep: bool) -> None:
    done = start(tmp_path, f"hydra.{'sweep' if sweep else 'run'}.dir=", "seed=0", sweep=sweep)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert "dir: expected a folder, got an empty name" in done.stderr
    assert not list(tmp_path.iterdir())


def test_run_debug_shows_traceback(tmp_path: Path) -> None:
    done = start(tmp_path, "dataset.frames=many", "debug=true")
    assert done.returncode == 1
    assert "Traceback (most recent call last)" in done.stderr
    assert "ValidationError" in done.stderr


def words(*arguments: str, directory: Path) -> subprocess.CompletedProcess[str]:
    return completed(directory, *arguments)


def test_help_lists_all_commands(tmp_path: Path) -> None:
    done = words("--help", directory=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    for name, states in COMMANDS.items():
        assert re.search(rf"^  {name} +{re.escape(states)}$", done.stdout, re.MULTILINE)
        assert find_spec(module_of(name))


def test_help_after_override_lists_commands(tmp_path: Path) -> None:
    assert "Commands (" in words("dataset=desk", "--help", directory=tmp_path).stdout


@pytest.mark.parametrize("command", ["check", "detect", "show-refinement", "train-detector"])
def test_help_of_hydra_command_lists_arguments(tmp_path: Path, command: str) -> None:
    done = words(command, "--help", directory=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"usage: instancemap {command} ")
    assert all(part in done.stdout for part in ("Arguments:", "Examples:", "--cfg job"))
    assert len(done.stdout.splitlines()) < 40


def test_command_misspelled_name_suggests_nearest_name(tmp_path: Path) -> None:
    done = words("tabels", "outputs", directory=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: command: expected a known command, got 'tabels'; did you mean tables?\n"


def test_command_unknown_name_suggests_run(tmp_path: Path) -> None:
    error = words("run", directory=tmp_path).stderr
    assert error.startswith("error: command: expected one of tables, figures, ")
    assert error.endswith(", got 'run'; omit the command to start a run: python -m framework KEY=VALUE ...\n")


FAULTY = {
    "tables": ["nowhere"],
    "figures": ["nowhere"],
    "import": ["old", "new"],
    "check": ["out=check.jpg"],
    "raycast": ["nowhere"],
    "report": ["nowhere"],
    "diff": ["old", "old"],
    "edit": ["nowhere", "--delete", "9"],
    "merge": ["nowhere", "old"],
    "export": ["nowhere", "--to", "glb"],
    "query": ["old", "a red chair"],
    "import-map": ["nowhere.ply", "new"],
    "evaluate": ["old"],
    "explain": ["nowhere"],
    "detect": ["dataset=synthetic", "detector=simulated"],
    "show-refinement": ["dataset=synthetic", "detector=simulated"],
    "compile": ["nothing"],
    "plugins": ["detector", "nothing"],
    "verify": ["nowhere"],
    "bundle": ["nowhere"],
    "reproduce": ["nowhere"],
    "new-plugin": ["refiner", "gmm_em"],
    "synthesize": ["new", "--scenes=999"],
    "train-detector": ["device=tpu"],
    "convert-weights": ["nothing.pth", "out.safetensors"],
    "convert-oni": ["nothing.oni", "out"],
}


# failed checks of doctor are not errors of the command
@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - {"doctor"}))
def test_command_debug_shows_traceback(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "metrics.json").write_text(json.dumps({"config_hash": config_hash({})}))
    (tmp_path / "old" / "config.yaml").write_text("{}")
    if (CONF / f"{command.replace('-', '_')}.yaml").exists():  # Hydra changes the process
        stderr = words(command, *FAULTY[command], "debug=true", directory=tmp_path).stderr
    else:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("signal.signal", lambda *_: None)
        monkeypatch.setattr(sys, "argv", ["instancemap", command, *FAULTY[command], "debug=true"])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 1
        stderr = capsys.readouterr().err
    assert "Traceback (most recent call last)" in stderr
    assert re.search("(ERROR +|error: )", stderr)
    assert not (tmp_path / "debug=true").exists()


def test_run_writes_outputs(tmp_path: Path) -> None:
    done = start(tmp_path, "dataset.unreadable=1", "dataset.frames=4")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert {path.name for path in tmp_path.iterdir()} >= RECORD | {"overview.png", "instancemap.log"}
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["frames"], metrics["frames_skipped"], metrics["choice.detector"]) == (4, 1, "fake")
    assert not list(tmp_path.glob("*partial*"))
    assert "frame skipped: frame 1" in (tmp_path / "instancemap.log").read_text()
    assert done.stderr.splitlines()[-1].endswith("INFO    overview.png, mesh.ply, instances.json")


@pytest.mark.skipif(sys.platform == "win32", reason="requires sh")
def test_run_with_closed_streams_writes_outputs(tmp_path: Path) -> None:
    line = command(f"hydra.run.dir={tmp_path}")
    closed = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *line]
    assert subprocess.run(closed, cwd=tmp_path, env=environment(), check=False).returncode == 0
    assert {path.name for path in tmp_path.iterdir()} >= RECORD
    log = (tmp_path / "instancemap.log").read_text()
    assert "ERROR" not in log


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="requires /dev/full")
@pytest.mark.parametrize("words", [["--help"], ["plugins", "viewer", "none"]], ids=" ".join)
def test_command_output_error_is_one_line(words: list[str], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        line = [sys.executable, "-m", "framework", *words]
        done = subprocess.run(
            line, cwd=tmp_path, env=environment(), stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 1
    assert re.fullmatch(r"error: .*No space left on device\n", done.stderr), done.stderr


def test_sweep_continues_after_failed_job(tmp_path: Path) -> None:
    done = start(tmp_path, "dataset.frames=2,many,1", "seed=0", sweep=True)
    assert done.returncode == 1
    assert done.stderr.count("ERROR") == 1
    assert "Traceback" not in done.stderr
    jobs = sorted(path for path in tmp_path.iterdir() if path.is_dir())
    assert [(job / "metrics.json").exists() for job in jobs] == [True, True, False]  # frames=1, 2, many
    assert "'many'" in (jobs[2] / "instancemap.log").read_text()
    assert done.stdout.splitlines()[-1] == "table.md, table.tex, table.csv"
    assert (tmp_path / "table.md").read_text() in done.stdout
    assert done.stderr.count("overview.png, mesh.ply, instances.json") == 2, "expected one line per run"


def test_sweep_rejects_misspelled_name_before_first_job(tmp_path: Path) -> None:
    done = start(tmp_path, "detector=fake,fakke", sweep=True)
    assert (done.returncode, len(done.stderr.splitlines())) == (1, 1)
    assert "detector: expected one of" in done.stderr
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_run_ctrl_c_writes_partial_outputs(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text("{}")  # of an earlier run in the same directory
    line = command(f"hydra.run.dir={tmp_path}", "dataset.frames=100000", "dataset.slow_s=0.02")
    with subprocess.Popen(line, cwd=tmp_path, env=environment(), stderr=subprocess.PIPE, text=True) as process:
        deadline, logged = time.monotonic() + 60, tmp_path / "instancemap.log"
        while not (logged.exists() and "depth sensor" in logged.read_text()) and time.monotonic() < deadline:  # tracked
            time.sleep(0.05)
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=90)
    assert process.returncode == 130
    assert "partial run (interrupted by Ctrl-C" in stderr
    assert "Traceback" not in stderr
    left = {path.name for path in tmp_path.iterdir()}
    assert left >= (RECORD - {"metrics.json"}) | {"overview.png", "metrics.partial.json"}
    assert "metrics.json" not in left
    metrics = json.loads((tmp_path / "metrics.partial.json").read_text())
    assert metrics["partial"] == "interrupted by Ctrl-C"
    assert 0 < metrics["frames"] < 100000


def test_run_full_map_writes_partial_outputs(tmp_path: Path) -> None:
    done = start(tmp_path, "fuser.capacity=2")
    assert done.returncode == 3
    assert "increase fuser.capacity" in done.stderr.splitlines()[-1]
    assert json.loads((tmp_path / "metrics.partial.json").read_text())["frames"] == 3
    assert not (tmp_path / "metrics.json").exists()
