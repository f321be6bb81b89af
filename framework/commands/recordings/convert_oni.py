"""`instancemap convert-oni FILE.oni OUT`: convert a SceneNN recording to images for `dataset=scenenn`.

OpenNI 2 decodes the recording. The command writes image/, depth/ and timestamp.txt to the scene folder OUT (DIR/NNN).
The file names are those of the converter of SceneNN.
"""

from __future__ import annotations

import argparse
import re
from contextlib import closing
from pathlib import Path

import cv2
from tqdm import tqdm

from framework.commands.command_line import arguments, one_line_errors
from framework.datasets.scenenn.oni import read_frames
from framework.datasets.scenenn.oni_records import OniContents, Stream, read_contents
from framework.datasets.scenenn.scene_files import MICROSECONDS, write_timestamps
from framework.errors import DataError
from framework.files.folders.restartable_folder import restartable_folder
from framework.files.image_files import write_image

COMMAND = "convert-oni"
IMAGE, DEPTH, TIMESTAMP = "image", "depth", "timestamp.txt"
OWN_FILES = re.compile(r"image/image\d{5,}\.png|depth/depth\d{5,}\.png|timestamp\.txt|\.[^/]+/repaired\.oni")
PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # higher compression takes longer than decoding the recording


def main() -> None:
    """Run the command `instancemap convert-oni`."""
    parser = argparse.ArgumentParser(
        description="Convert an OpenNI recording to images for dataset=scenenn. Requires OpenNI 2: apt-get install "
        "libopenni2-0."
    )
    parser.add_argument("source", metavar="FILE.oni", type=Path, help="SceneNN recording, oni/NNN.oni")
    scene = "SceneNN scene folder DIR/NNN; must not contain image/, depth/ or timestamp.txt yet"
    parser.add_argument("target", metavar="OUT", type=Path, help=scene)
    parsed = arguments(parser)
    with one_line_errors():
        convert(parsed.source, parsed.target)


def convert(source: Path, target: Path) -> None:
    """Convert a recording to images, and print a summary.

    Frames that were written before an error are kept. The files of an interrupted conversion are replaced.

    Args:
        source: Recording.
        target: Scene folder.

    Raises:
        DataError: `source` is truncated or has no frames, or `target` already contains images.
    """
    contents = read_contents(source)
    counts = {stream: images.count for stream, images in contents.streams.items()}
    with restartable_folder(target, COMMAND, OWN_FILES, check_target):
        number, error = write_frames(contents, target)
    if error is not None:
        raise error
    if not number:
        raise DataError(f"{source}: expected color and depth images with equal timestamps, got none")
    left_out = {stream: count - number for stream, count in counts.items()}
    print(
        f"{target}: {number} frames; skipped {left_out[Stream.COLOR]} color and {left_out[Stream.DEPTH]} "
        "depth images (damaged or unpaired)"
    )
    if contents.cut_off:
        raise DataError(
            f"{contents.path}: expected a complete file, got a truncated or damaged file at byte "
            f"{contents.end}; kept the frames up to image{number:05d}.png; download it again for the other frames"
        )


def check_target(target: Path) -> None:
    """Raise DataError if a scene folder already contains images."""
    for path in (target / name for name in (IMAGE, DEPTH, TIMESTAMP)):
        if path.exists() and not (path.is_dir() and not any(path.iterdir())):
            raise DataError(
                f"{path}: expected a missing path or an empty folder, got existing files; remove them or choose "
                "another OUT"
            )


def write_frames(contents: OniContents, target: Path) -> tuple[int, DataError | None]:
    """Write the images and timestamps of a recording.

    Returns:
        The number of frames, and the error that ended the recording early, if any.
    """
    (target / IMAGE).mkdir(exist_ok=True)
    (target / DEPTH).mkdir(exist_ok=True)
    color_times: dict[int, float] = {}
    depth_times: dict[int, float] = {}
    total = min(images.count for images in contents.streams.values())
    found = None
    try:
        with closing(read_frames(contents, target)) as frames:
            bar = tqdm(frames, total=total, desc=contents.path.name, unit=" frames", disable=None)
            for number, frame in enumerate(bar, start=1):
                write_image(target / DEPTH / f"depth{number:05d}.png", frame.depth_mm, *PNG)
                bgr = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
                write_image(target / IMAGE / f"image{number:05d}.png", bgr, *PNG)
                color_times[number] = frame.color_time / MICROSECONDS
                depth_times[number] = frame.depth_time / MICROSECONDS
    except DataError as error:
        found = error
    finally:
        if depth_times:
            write_timestamps(target / TIMESTAMP, depth_times, color_times)
    return len(depth_times), found
