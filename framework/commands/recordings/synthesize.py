"""`instancemap synthesize DIR`: render the benchmark of synthetic scenes in SceneNN format."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.config.text_values import typed
from framework.errors import ConfigError
from framework.runtime.process_settings import available_cores
from framework.synthetic.benchmark import SCENES
from framework.synthetic.scene_writers import write_scenes
from framework.synthetic.scenenn_scene import MAX_CAMERA_SPEED, BenchmarkSettings


def main() -> None:
    """Run the command `instancemap synthesize`."""
    default = BenchmarkSettings()
    parser = argparse.ArgumentParser(
        description="Write synthetic scenes to DIR in SceneNN format: images, depth, trajectory and labeled mesh.\n"
        "Equal parameters give byte-identical files. Existing scenes are kept.\n\n"
        f"Scenes: {', '.join(SCENES)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("directory", metavar="DIR", type=Path, help="output folder: new, or incomplete from an earlier call")
    add("--scenes", metavar="NAMES", default=",".join(SCENES), help="comma-separated scene names; default: all scenes")
    add("--seed", metavar="N", type=int, default=default.seed, help="random seed of the scenes; default: 0")
    add("--frames", metavar="N", type=int, default=default.frames, help="number of frames per scene; default: 120")
    add("--rate", metavar="HZ", type=float, default=default.rate, help="frame rate, Hz, in (0, 30]; default: 10")
    add("--width", metavar="PX", type=int, default=default.width, help="image width, px, multiple of 4; default: 640")
    speed = f"camera speed relative to the recommended recording speed, in (0, {MAX_CAMERA_SPEED:g}]; default: 2"
    add("--camera-speed", metavar="FACTOR", type=float, default=default.camera_speed, help=speed)
    add("--jobs", metavar="N", type=int, default=available_cores(), help="number of processes; default: all cores")
    parsed = arguments(parser)
    with one_line_errors():
        names = parsed.scenes.split(",")
        unknown = [name for name in names if name not in SCENES]
        if unknown:
            raise ConfigError(f"--scenes: expected one or more of {', '.join(SCENES)}, got {unknown[0]!r}")
        if parsed.jobs < 1:
            raise ConfigError(f"--jobs: expected at least 1, got {parsed.jobs}")
        recording = BenchmarkSettings(parsed.seed, parsed.frames, parsed.rate, parsed.width, parsed.camera_speed)
        write_scenes(parsed.directory, {name: SCENES[name] for name in names}, recording, parsed.jobs)
        root = parsed.directory.resolve()
        command = f"instancemap dataset=scenenn {typed('dataset.root', root)} dataset.scene={names[0]}"
        print(f"{root} is complete; map it: {command}")
