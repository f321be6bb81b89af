"""List of the kernels that the pipelines call, framework/compilation/kernels.txt.

To write the list, which takes about a minute, run

    python -m tests.support.kernel_calls

All registered refiners, fusers and trackers are run on the demo, and one pipeline is run on a synthetic room. The list
contains each kernel that Python calls, with each combination of argument types. A test compares the list with the same
runs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event
from numba.core.dispatcher import Dispatcher
from numba.core.typing.typeof import Purpose, typeof

from framework.commands.running.run import run
from framework.compilation.catalog import DEFAULT, LIST, OTHERS, line_of
from framework.config.composition import composed
from framework.data import Detections, Frame, Pose
from framework.geometry import exp_se3
from framework.interfaces import ClusterRefiner, Detector, MapFuser, PoseTracker, RGBDSequence, SubmapChange
from framework.pipeline import Pipeline
from framework.pose_graph.depth_calibration import CalibrationView, estimated
from framework.refinement.lifting import lift
from framework.registry import build
from framework.runtime.process_settings import Settings

CHECKOUT = Path(__file__).resolve().parents[2]
FEW = ("dataset=desk", "dataset.stride=3", "dataset.stop=12")


class Compiled(event.Listener):
    """Listener that collects the names of the compiled kernels."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        self.names.append(f"{function.__module__}.{function.__qualname__}")

    def on_end(self, event: Any) -> None:
        pass


class Remembered(Detector):
    """Detector that stores the detections of another detector for each frame."""

    def __init__(self, detector: Detector) -> None:
        self.detector = detector
        self.found: dict[int, Detections] = {}
        self.classes = detector.classes

    def detect(self, frame: Frame) -> Detections:
        if frame.index not in self.found:
            self.found[frame.index] = self.detector.detect(frame)
        return self.found[frame.index]


def calls() -> list[str]:
    """Return a list to which a kernel is appended whenever it is first called with new argument types."""
    noted: list[str] = []
    compile_for = Dispatcher._compile_for_args

    def note(self: Any, *arguments: Any, **named: Any) -> Any:
        if self.py_func.__module__.startswith(("framework.", "plugins.")):
            noted.append(line_of(self, [typeof(argument, Purpose.argument) for argument in arguments]))
        return compile_for(self, *arguments, **named)

    Dispatcher._compile_for_args = note
    return noted


def run_default(directory: Path, *overrides: str) -> None:
    run(composed("dataset=desk", *overrides), directory, {})


def run_others() -> None:
    """Run the pipeline with each registered refiner, fuser and tracker. Detectors have no kernels."""
    config = composed(*FEW)
    Settings.of(config).apply()
    detector = Remembered(build(Detector, config.detector))
    video = build(RGBDSequence, config.dataset)
    for stage in ("refiner", "fuser", "tracker"):
        for option in sorted((CHECKOUT / "conf" / stage).glob("*.yaml")):
            # without kernels: one requires a file, and the other one true instances
            if (stage, option.stem) in (("tracker", "trajectory_file"), ("refiner", "ground_truth")):
                continue
            own = composed(*FEW, f"{stage}={option.stem}")
            pipeline = Pipeline(
                detector,
                build(PoseTracker, own.tracker),
                build(ClusterRefiner, own.refiner),
                build(MapFuser, own.fuser),
                prefetch=0,
            )
            pipeline.run(video)
            pipeline.fuser.scene.mesh()
            pipeline.fuser.scene.instances()
            if pipeline.fuser.has_submaps and stage == "fuser":
                change_submaps(pipeline.fuser, video[0])
    estimated([CalibrationView.of(video[k], np.eye(4)) for k in range(2)])


def change_submaps(fuser: MapFuser, frame: Frame) -> None:
    """Move, hide, render and show the submaps of a map."""
    motion = exp_se3(np.full(6, 0.01))
    fuser.correct(SubmapChange({0: motion}, hidden=frozenset({0}), submap=1))
    fuser.scene.hidden_surfaces().render(frame.camera, np.eye(4), {0}, frame.depth)
    fuser.scene.hidden_surfaces().render(frame.camera, np.eye(4), {0})
    fuser.scene.mesh()
    nothing = Detections.none(frame.depth.shape, fuser.scene.classes)
    fuser.fuse(frame, Pose(np.eye(4)), lift(nothing, frame, Pose(np.eye(4))))
    fuser.correct(SubmapChange({0: motion}, shown=frozenset({0}), submap=1))


def run_rendered(directory: Path) -> None:
    """Run a synthetic room, including rendering and the comparison of the map with the true surface."""
    config = composed(
        "dataset=synthetic", "detector=simulated", "dataset.frames=8", "dataset.width=160", "dataset.height=120"
    )
    run(config, directory, {})


def sections(whole: bool) -> dict[str, set[str]]:
    """Return the lines of the list by section. Unless `whole`, use a shorter default run with the same calls."""
    noted = calls()
    with tempfile.TemporaryDirectory() as directory:
        run_default(Path(directory), *(() if whole else ("dataset.stride=2", "dataset.stop=24")))
    default = set(noted)
    run_others()
    with tempfile.TemporaryDirectory() as directory:
        run_rendered(Path(directory))
    return {DEFAULT: default, OTHERS: set(noted) - default}


def record() -> None:
    """Write the list. Meanwhile, other processes compile those kernels of the previous list that still exist."""
    found = sections(whole=True)
    text = "\n\n".join("\n".join([section, *sorted(lines)]) for section, lines in found.items())
    LIST.write_text(f"{text}\n", encoding="utf-8")


def check() -> None:
    """Print the called kernels that are missing in the list, and the kernels that are compiled."""
    compiled = Compiled()
    event.register("numba:compile", compiled)
    found = sections(whole=False)
    known = set(LIST.read_text(encoding="utf-8").splitlines())
    for line in sorted(set().union(*found.values()) - known):
        print(f"not listed: {line}")
    for name in compiled.names:
        print(f"compiled: {name}")


def main() -> None:
    os.chdir(CHECKOUT)
    if sys.argv[1:]:
        {"--check": check, "--record": record}[sys.argv[1]]()
        return
    LIST.write_text("", encoding="utf-8")
    # kernels that are called by a compiled kernel are not listed; the second run compiles no kernels
    for _ in range(2):
        subprocess.run([sys.executable, "-m", "tests.support.kernel_calls", "--record"], check=True)


if __name__ == "__main__":
    main()
