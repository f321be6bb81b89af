"""`python -m framework synthesize DIR`: a benchmark of furnished rooms in SceneNN's own format."""

from __future__ import annotations

import argparse
from pathlib import Path

from framework.commands.command_line import arguments, one_line_errors
from framework.errors import ConfigError
from framework.runtime.process_settings import available_cores
from framework.synthetic.benchmark import SCENES
from framework.synthetic.scene_writers import write_scenes
from framework.synthetic.scenenn_scene import BenchmarkSettings


def main() -> None:
    default = BenchmarkSettings()
    parser = argparse.ArgumentParser(
        description="Writes made-up rooms into DIR, in SceneNN's format: images, depth, trajectory, labelled mesh. "
        "The same parameters give the same bytes. What is there already is kept.",
    )
    parser.add_argument("directory", metavar="DIR", type=Path, help="a new folder, or one that this command began")
    parser.add_argument("--scenes", default=",".join(SCENES), help="which rooms, default: %(default)s")
    parser.add_argument("--seed", type=int, default=default.seed, help="another seed gives other rooms")
    parser.add_argument("--frames", type=int, default=default.frames, help="of each room, default: 120")
    parser.add_argument("--rate", type=float, default=default.rate, help="of the frames, Hz, default: 10")
    parser.add_argument("--width", type=int, default=default.width, help="of the images, px, default: 640")
    parser.add_argument("--haste", type=float, default=default.haste, help="of the walk, default: 2; 1 = no hurry")
    parser.add_argument("--jobs", type=int, default=available_cores(), help="processes, default: all cores")
    asked = arguments(parser)
    with one_line_errors():
        names = asked.scenes.split(",")
        unknown = [name for name in names if name not in SCENES]
        if unknown:
            raise ConfigError(f"there is no scene {unknown[0]!r}; the scenes are: {', '.join(SCENES)}")
        if asked.jobs < 1:
            raise ConfigError(f"jobs must be at least 1, found {asked.jobs}")
        recording = BenchmarkSettings(asked.seed, asked.frames, asked.rate, asked.width, asked.haste)
        write_scenes(asked.directory, {name: SCENES[name] for name in names}, recording, asked.jobs)
        root = asked.directory.resolve()
        print(f"{root} is complete: python -m framework dataset=scenenn dataset.root={root} dataset.scene={names[0]}")
