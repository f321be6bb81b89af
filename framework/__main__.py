"""`instancemap [COMMAND] ...`, the same as `python -m framework [COMMAND] ...`; without a command, a run or a sweep."""

from __future__ import annotations

import os
import signal
import sys
from difflib import get_close_matches
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path

import framework

COMMANDS = {
    "tables": "write the tables of an experiment: Markdown, LaTeX, CSV",
    "figures": "draw the figures of an experiment",
    "raycast": "draw the ray-cast view of a map: depth, normals, vertices, RGB, object indices",
    "report": "write an HTML report of a run, or a comparison of several",
    "import": "convert a recording of a phone or sensor to a folder for dataset=rgbd_folder",
    "check": "validate a recording and suggest parameter fixes",
    "diff": "list objects that appeared, vanished or moved between two runs",
    "export": "export a run as GLB, USD, PLY, OBJ, floor plan, ROS map or scene graph",
    "query": 'rank the objects of a run by a text query: "a red chair"',
    "evaluate": "re-evaluate stored runs without mapping them again",
    "detect": "write the detections of a sequence as a COCO result file",
    "show-refinement": "draw the masks of a frame before and after refinement",
    "compile": "compile the kernels in advance, once per installation",
    "doctor": "check the installation and print the fix for each problem",
    "plugins": "list the plugins of each stage and their parameters",
    "new-plugin": "create a repository with a plugin: package, option, tests, CI",
    "synthesize": "render a benchmark of synthetic rooms in SceneNN's format",
    "train-detector": "train Mask R-CNN on rendered rooms",
    "convert-weights": "convert a Mask R-CNN of torchvision or detectron2",
    "convert-oni": "convert an OpenNI recording to images for dataset=scenenn",
}
"""Summary of each command."""

FOLDERS = {
    "running": ("run", "detect", "show-refinement"),
    "results": ("tables", "figures", "raycast", "report", "diff", "export", "query", "evaluate"),
    "recordings": ("import", "check", "synthesize", "convert-oni"),
    "installation": ("compile", "doctor", "plugins", "new-plugin", "train-detector", "convert-weights"),
}
"""The folder of framework.commands that contains the module of each command."""

PRINTING = (*FOLDERS["results"], "plugins", "doctor")  # a closed pipe (`| head`) ends them silently

HELP = """\
{program} [COMMAND] ...    instance-oriented semantic 3D mapping from RGB-D video

Without a command, KEY=VALUE ... start a run; with -m, or with an experiment, a sweep of runs:
  {program} dataset=rgbd_folder dataset.root=DIR
  {program} -m refiner=identity,kmeans,gmm_em seed=0,1,2

Commands (COMMAND --help lists the arguments):
{commands}

Exit status: 0 = success; 1 = error; 3 = an error ended a run early, and its partial outputs are written;
128 + N = ended by signal N (130 = Ctrl-C, 143 = SIGTERM), and the partial outputs of a run are written.

debug=true adds the traceback to errors of any command. --cfg job lists the keys of a run, --hydra-help Hydra's options.
"""

RERUN = "--experimental-rerun"  # of Hydra: reads a pickle, which may contain code


def module_of(command: str) -> str:
    """Return the module of framework.commands that implements a command."""
    name = {"import": "import_recording"}.get(command, command.replace("-", "_"))  # `import` is a keyword
    folder = next(folder for folder, commands in FOLDERS.items() if command in commands)
    return f"framework.commands.{folder}.{name}"


def leave_working_folder(arguments: list[str]) -> None:
    """Remove the working folder from the module search path: it may be a run directory from someone else.

    With --config-dir, which registers plugins of the user's own, append it. `python -P` keeps it out in any case.
    """
    try:
        here = str(Path.cwd())
    except FileNotFoundError:
        sys.exit("error: working folder: expected an existing folder, got a removed one; change to another one")
    if sys.flags.safe_path or Path(here) == Path(__file__).resolve().parents[1]:
        return
    if sys.path[0] in ("", here):  # of `python -m`
        del sys.path[0]
    if any(word.startswith(("--config-d", "-cd")) for word in arguments):
        sys.path.append(here)


def open_standard_streams() -> None:
    """Open /dev/null for closed streams (`2>&-`).

    Otherwise an output file of the run gets the number of one, and receives the output of libraries.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            mode = "r" if number == 0 else "w"
            # opening takes the lowest free number, which is this one
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115  (open until the process ends)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def main() -> None:
    """Run the console script `instancemap`."""
    open_standard_streams()
    leave_working_folder(sys.argv[1:])
    if any(word.startswith("--e") and RERUN.startswith(word.partition("=")[0]) for word in sys.argv[1:]):
        sys.exit(
            f"error: {RERUN}: expected no option that reads a pickle, which can run code; pass the overrides "
            "of the run instead"
        )
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # file names may not be valid text
            stream.reconfigure(errors="backslashreplace")
    program = "python -m framework" if Path(sys.argv[0]).name == "__main__.py" else Path(sys.argv[0]).name
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word in ("--help", "-h", "help"):
        width = max(map(len, COMMANDS))
        listed = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in COMMANDS.items())
        flush_output(HELP.format(program=program, commands=listed))
        return
    if word == "--version":
        print(f"instancemap {framework.__version__}")
        return
    if word in COMMANDS:
        sys.argv[:2] = [f"{program} {word}"]
    elif word and "=" not in word and not word.startswith(("-", "~")):
        close = get_close_matches(word, COMMANDS, n=1)
        suggestion = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(COMMANDS)}"
        sys.exit(f"error: {word!r}: unknown command; {suggestion}")
    else:
        word = "run"
    if word in PRINTING and hasattr(signal, "SIGPIPE"):  # Windows has none
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        import_module(module_of(word)).main()
    finally:
        flush_output()


def flush_output(rest: str = "") -> None:
    """Write `rest` and flush stdout; exit with an error if that fails and no other error is being reported."""
    reported = sys.exc_info()[0] is not None
    try:
        sys.stdout.write(rest)
        sys.stdout.flush()
    except OSError as error:
        # redirect the rest of the buffer to nowhere: Python flushes it again at exit, and would report that
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not reported:
            sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
