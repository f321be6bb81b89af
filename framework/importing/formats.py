"""The formats that can be imported, and which one a source is of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from framework.errors import ConfigError, DataError
from framework.importing.bags import ros_bag
from framework.importing.bags.ros_topics import Topics
from framework.importing.phones import polycam, record3d, scanner_app, stray_scanner
from framework.importing.source import Source

ZIP = ".zip"


@dataclass(frozen=True)
class Format:
    """How a source is recognised and opened."""

    name: str  # for the command line
    needs: str  # what is there where it is recognised, for the person
    recognised: Callable[[Path], bool]
    open: Callable[..., Source]  # of the path, and of the topics if it has some
    has_topics: bool = False


FORMATS = (
    Format(
        "stray_scanner",
        "a folder with odometry.csv, camera_matrix.csv, rgb.mp4 and depth/",
        stray_scanner.recognised,
        stray_scanner.open_source,
    ),
    Format("record3d", "an .r3d file of Record3D", record3d.file_recognised, record3d.open_file),
    Format(
        "record3d_exr",
        "a folder with metadata.json, rgb/ and depth/, Record3D's EXR + RGB export",
        record3d.folder_recognised,
        record3d.open_folder,
    ),
    Format("polycam", "a folder with keyframes/, Polycam's raw data", polycam.recognised, polycam.open_source),
    Format(
        "scanner_app",
        'a folder with frame_00000.json, "All Data" of 3D Scanner App',
        scanner_app.recognised,
        scanner_app.open_source,
    ),
    Format(
        "ros_bag",
        "a .bag, .mcap or .db3 file or a folder with metadata.yaml, of ROS or RealSense",
        ros_bag.recognised,
        ros_bag.open_source,
        has_topics=True,
    ),
)


def open_source(path: Path, topics: Topics | None = None) -> Source:
    """The recording at `path`, of whatever format it is. Raises DataError when it is of none, or cannot be read.

    `topics` are those of a ROS bag that are not to be found by type and name.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist")
    if path.suffix.lower() == ZIP:
        raise DataError(f"{path} must be unpacked first; then name the folder")
    for place in (path, *_only_folder(path)):  # what was zipped often has a folder around it
        for kind in FORMATS:
            if not kind.recognised(place):
                continue
            if kind.has_topics:
                return kind.open(place, topics or Topics())
            if topics and topics.given:
                raise ConfigError(f"{path} has no topics: {', '.join(topics.given)} are for ROS bags")
            return kind.open(place)
    known = "; ".join(f"{kind.name}: {kind.needs}" for kind in FORMATS)
    raise DataError(f"{path} is of no format that can be imported. These are: {known}")


def _only_folder(path: Path) -> list[Path]:
    """The folder in a folder that holds one only."""
    folders = [entry for entry in path.iterdir() if entry.is_dir()] if path.is_dir() else []
    return folders if len(folders) == 1 else []
