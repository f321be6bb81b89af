"""Entry point of `instancemap [COMMAND] ...` and `python -m framework [COMMAND] ...`.

Without a command, it starts a run or sweep.
"""

from __future__ import annotations

import os
import signal
import sys
from difflib import get_close_matches
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path

import framework
from framework.runtime.plain_output import escape_log_records, escape_streams

COMMANDS = {
    "tables": "write the tables of an experiment or sweep: Markdown, LaTeX, CSV",
    "figures": "draw the figure of an experiment or sweep",
    "raycast": "draw a ray-cast view of a map: depth, normals, vertex map, RGB, object indices",
    "report": "write HTML reports of runs and compare them",
    "import": "convert a phone or sensor recording to an RGB-D folder for dataset=rgbd_folder",
    "check": "validate an RGB-D sequence and suggest parameter fixes",
    "diff": "list objects that appeared, vanished or moved between two runs",
    "edit": "merge, split, rename and delete instances of a run, for use as ground truth",
    "merge": "merge the overlapping maps of two runs",
    "export": "export a run to standard 3D and map formats: GLB, USD, PLY, OBJ, ROS map, scene graph",
    "verify": "compare the files of runs with the hashes in their manifests",
    "bundle": "pack the runs, tables and plugin code of an experiment into a ZIP file",
    "reproduce": "run stored runs or a bundle again and compare the results",
    "query": 'rank the objects of a run by a text query: "a red chair"',
    "import-map": "convert the map of another system to a run directory, as a row of tables",
    "evaluate": "re-evaluate stored runs without re-running them",
    "explain": "list the stage that lost each object of a run, and each stage's contribution to the loss",
    "detect": "write the detections of a sequence to a COCO results file",
    "show-refinement": "draw the masks of a frame before and after refinement",
    "compile": "compile the kernels in advance, once per installation",
    "doctor": "check the installation and print the fix for each problem",
    "plugins": "list the plugins of each stage and their parameters",
    "new-plugin": "create a package with a working plugin: code, config option, tests, CI",
    "synthesize": "render a benchmark of synthetic scenes in SceneNN format",
    "train-detector": "train Mask R-CNN on rendered synthetic scenes",
    "convert-weights": "convert Mask R-CNN weights of torchvision or detectron2",
    "convert-oni": "convert an OpenNI recording to images for dataset=scenenn",
}
"""Summary of each command."""

FOLDERS = {
    "running": ("run", "detect", "show-refinement"),
    "results": (
        *("tables", "figures", "raycast", "report", "diff", "edit", "merge", "export", "query"),
        *("import-map", "evaluate", "verify", "bundle", "reproduce", "explain"),
    ),
    "recordings": ("import", "check", "synthesize", "convert-oni"),
    "installation": ("compile", "doctor", "plugins", "new-plugin", "train-detector", "convert-weights"),
}
"""Commands by the folder of framework.commands that contains their modules."""

PRINTING = (*FOLDERS["results"], "plugins", "doctor")  # commands that end silently on a closed pipe (`| head`)

HELP = """\
{program} [COMMAND] ...    build object-level 3D maps from RGB-D video

Without a command, KEY=VALUE ... starts a run. With -m or an experiment, it starts a sweep of runs:
  {program} dataset=rgbd_folder dataset.root=DIR
  {program} -m refiner=identity,kmeans,gmm_em seed=0,1,2

Commands (COMMAND --help lists the arguments and defaults):
{commands}

Exit status:
  0        success
  1        error
  2        invalid command-line arguments
  3        run stopped early after an error; partial outputs written
  128 + N  ended by signal N (130 = Ctrl-C, 143 = SIGTERM); a run writes partial outputs

Options:
  debug=true    add the traceback to the error messages of any command
  --cfg job     list the config keys of a run
  --hydra-help  list the options of Hydra
"""

RERUN = "--experimental-rerun"  # Hydra option that reads a pickle file, which can execute code


def module_of(command: str) -> str:
    """Return the name of the module that implements a command, such as framework.commands.results.report."""
    name = {"import": "import_recording"}.get(command, command.replace("-", "_"))  # `import` is a keyword
    folder = next(folder for folder, commands in FOLDERS.items() if command in commands)
    return f"framework.commands.{folder}.{name}"


def leave_working_folder(arguments: list[str]) -> None:
    """Remove the working directory from the module search path, unless it is the checkout of the project.

    Its files may be from an untrusted source. With --config-dir, which registers plugins of the user, the directory is
    moved to the end of the search path instead. `python -P` always excludes it.
    """
    try:
        here = str(Path.cwd())
    except FileNotFoundError:
        sys.exit(
            "error: working directory: expected an existing folder, got a deleted folder; change to another folder"
        )
    if sys.flags.safe_path or Path(here) == Path(__file__).resolve().parents[1]:
        return
    if sys.path[0] in ("", here):  # added by `python -m`
        del sys.path[0]
    if any(word.startswith(("--config-d", "-cd")) for word in arguments):
        sys.path.append(here)


def open_standard_streams() -> None:
    """Open /dev/null for closed standard streams (`2>&-`).

    Otherwise, an output file could get the file descriptor of a closed stream and receive output of libraries.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            mode = "r" if number == 0 else "w"
            # opening a file uses the lowest free descriptor, which is `number`
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115  (open until the process ends)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def main() -> None:
    """Run the console script `instancemap`."""
    status = 1
    try:
        run_command()
        status = 0
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else int(error.code is not None)
        raise
    except KeyboardInterrupt as error:  # while libraries are loaded
        status = 128 + getattr(error, "number", signal.SIGINT)
        print(str(error) or "interrupted", file=sys.stderr)
        sys.exit(status)
    finally:
        from framework.runtime.signals import exit_on_signals

        exit_on_signals(status)


def run_command() -> None:
    """Run the command that the arguments of the process name."""
    open_standard_streams()
    leave_working_folder(sys.argv[1:])
    if any(word.startswith("--e") and RERUN.startswith(word.partition("=")[0]) for word in sys.argv[1:]):
        sys.exit(
            f"error: {RERUN}: expected KEY=VALUE overrides, got a pickle file (unsafe); pass the run's overrides "
            "instead"
        )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # file names may contain invalid Unicode
            stream.reconfigure(errors="backslashreplace")
    escape_streams()
    escape_log_records()
    program = "python -m framework" if Path(sys.argv[0]).name == "__main__.py" else Path(sys.argv[0]).name
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    of_run = "=" in word or word.startswith(("-", "~"))
    if word in ("--help", "-h", "help") or (of_run and {"--help", "-h"} & {*sys.argv[1:]}):
        width = max(map(len, COMMANDS))
        listed = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items())
        flush_output(HELP.format(program=program, commands=listed))
        return
    if word == "--version":
        print(f"instancemap {framework.__version__}")
        return
    if word in COMMANDS:
        sys.argv[:2] = [f"{program} {word}"]
    elif word and not of_run:
        close = get_close_matches(word, COMMANDS, n=1)
        expected = "a known command" if close else f"one of {', '.join(COMMANDS)}"
        fix = f"did you mean {close[0]}?" if close else f"omit the command to start a run: {program} KEY=VALUE ..."
        sys.exit(f"error: command: expected {expected}, got {word!r}; {fix}")
    else:
        word = "run"
    if word in PRINTING and hasattr(signal, "SIGPIPE"):  # not on Windows
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    from framework.runtime.signals import interruptible_imports, raise_on_signals

    raise_on_signals()
    try:
        with interruptible_imports():
            check_environment(word)
            module = import_module(module_of(word))
        module.main()
    finally:
        flush_output()


def check_environment(command: str) -> None:
    """Exit with an error if a command cannot run in the environment of this process.

    `doctor` reports the variables itself.
    """
    import_module("framework.commands")  # sets variables
    from framework.errors import ConfigError
    from framework.runtime.environment_checks import check_thread_limit, environment_errors

    errors = [] if command == "doctor" else environment_errors()
    try:
        check_thread_limit()
    except ConfigError as error:
        errors.append(str(error))
    if errors:
        sys.exit("\n".join(f"error: {error}" for error in errors))


def flush_output(rest: str = "") -> None:
    """Write `rest` to stdout and flush it. On failure, exit with an error.

    The error is not reported if another exception is active.
    """
    reported = sys.exc_info()[0] is not None
    try:
        sys.stdout.write(rest)
        sys.stdout.flush()
    except OSError as error:
        # discard the rest of the buffer: Python flushes it again at exit, and would report a second error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not reported:
            sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
