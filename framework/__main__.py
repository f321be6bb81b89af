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
    "tables": "run records below a folder become tables: Markdown, LaTeX, CSV",
    "figures": "run records below a folder become the paper's figures",
    "report": "shows a run, or several side by side, as a page for the browser",
    "import": "turns a recording of a phone or a sensor into a folder that can be mapped",
    "check": "looks whether a recording will map, and says what to set where it will not",
    "diff": "lists what appeared, vanished or moved between two visits of a place",
    "export": "writes a run as GLB, USD, PLY, OBJ, floor plan, ROS map or scene graph",
    "query": "ranks a stored run's objects by words: a red chair",
    "evaluate": "evaluates stored runs anew, without running them again",
    "detect": "writes a video's detections as a COCO result file",
    "show-refinement": "draws one frame's masks before and after refinement",
    "compile": "compiles the map's kernels, once for a machine: the first run then begins at once",
    "doctor": "says what is there of what can be used, and what gets the rest: first of all in an issue",
    "plugins": "lists what is registered for each stage, with its parameters",
    "new-plugin": "writes a repository with a plugin of your own: package, option, tests, CI",
    "synthesize": "writes a benchmark of furnished rooms in SceneNN's own format",
    "train-detector": "trains Mask R-CNN on rendered rooms",
    "convert-weights": "converts a Mask R-CNN of torchvision or detectron2",
    "convert-oni": "converts SceneNN's raw video to the images that dataset=scenenn reads",
}
"""What each does."""

FOLDERS = {
    "running": ("run", "detect", "show-refinement"),
    "results": ("tables", "figures", "report", "diff", "export", "query", "evaluate"),
    "recordings": ("import", "check", "synthesize", "convert-oni"),
    "installation": ("compile", "doctor", "plugins", "new-plugin", "train-detector", "convert-weights"),
}
"""The folder of framework.commands that contains the module of each command."""

PRINTING = (
    "tables",
    "figures",
    "report",
    "diff",
    "export",
    "query",
    "evaluate",
    "plugins",
    "doctor",
)  # what others may be reading: `| head` ends them without a word

HELP = """\
{program} [COMMAND] ...    instance-oriented semantic 3D mapping from RGB-D video

Without a command, KEY=VALUE ... make one run; with -m, or with an experiment, a sweep of runs:
  {program} dataset=rgbd_folder dataset.root=DIR
  {program} -m refiner=identity,kmeans,gmm_em seed=0,1,2

Commands; each explains itself with --help:
{commands}

Exit status: 0 = done; 1 = a fault; 3 = a fault ended a run early, and what it had mapped is written; 128 + N = ended by
signal N (130 = Ctrl-C, 143 = SIGTERM), and what a run had mapped is written.

debug=true, for any of them, shows where an error comes from. The keys of a run: --cfg job; Hydra's own options:
--hydra-help.
"""


RERUN = "--experimental-rerun"  # Hydra's: it reads a pickle, which may bring code


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
        sys.exit("error: the working folder has been removed; change to another one")
    if sys.flags.safe_path or Path(here) == Path(__file__).resolve().parents[1]:
        return
    if sys.path[0] in ("", here):  # of `python -m`
        del sys.path[0]
    if any(word.startswith(("--config-d", "-cd")) for word in arguments):
        sys.path.append(here)


def open_standard_streams() -> None:
    """Opens /dev/null for those that were closed (`2>&-`).

    Else a file of the record gets the number of one, and what a library prints goes into that file.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            mode = "r" if number == 0 else "w"
            # the lowest free number is the one that was closed, as they are gone through in order
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115  (open until the process ends)
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)


def main() -> None:
    """The console script `instancemap`."""
    open_standard_streams()
    leave_working_folder(sys.argv[1:])
    if any(word.startswith("--e") and RERUN.startswith(word.partition("=")[0]) for word in sys.argv[1:]):
        sys.exit(f"error: {RERUN} reads a pickle, which may bring code that runs; give the run's overrides instead")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # names of files may be no text
            stream.reconfigure(errors="backslashreplace")
    program = "python -m framework" if Path(sys.argv[0]).name == "__main__.py" else Path(sys.argv[0]).name
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    if word in ("--help", "-h", "help"):
        width = max(map(len, COMMANDS))
        listed = "\n".join(f"  {name:<{width}}  {says}" for name, says in COMMANDS.items())
        try:
            print(HELP.format(program=program, commands=listed), end="", flush=True)
        except OSError as error:
            drop_output()
            sys.exit(f"error: the help could not be written: {error.strerror}")
        return
    if word == "--version":
        print(f"instancemap {framework.__version__}")
        return
    if word in COMMANDS:
        sys.argv[:2] = [f"{program} {word}"]
    elif word and "=" not in word and not word.startswith(("-", "~")):
        close = get_close_matches(word, COMMANDS, n=1)
        suggestion = f"did you mean {close[0]}?" if close else f"the commands are {', '.join(COMMANDS)}"
        sys.exit(f"error: there is no command {word!r}; {suggestion}")
    else:
        word = "run"
    if word in PRINTING and hasattr(signal, "SIGPIPE"):  # Windows has none
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        import_module(module_of(word)).main()
    finally:
        end_output()


def end_output() -> None:
    """Writes what is still to be written to stdout; where it cannot, and nothing else is told, that is told."""
    told = sys.exc_info()[0] is not None
    try:
        sys.stdout.flush()
    except OSError as error:
        drop_output()
        if not told:
            sys.exit(f"error: {error}")


def drop_output() -> None:
    """Writes what stdout still holds to nowhere: Python would try once more when it ends, and tell of that."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
