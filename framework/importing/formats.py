"""The formats that can be imported, and their detection."""

from __future__ import annotations

from pathlib import Path

from framework.errors import ConfigError, DataError
from framework.importing.bags import ros_bag
from framework.importing.bags.ros_topics import Topics
from framework.importing.phones import polycam, record3d, scanner_app, stray_scanner
from framework.importing.source import Source

FORMATS = (
    stray_scanner.FORMAT,
    record3d.FILE_FORMAT,
    record3d.FOLDER_FORMAT,
    polycam.FORMAT,
    scanner_app.FORMAT,
    ros_bag.FORMAT,
)


def open_source(path: Path, topics: Topics | None = None) -> Source:
    """Open the recording at `path`. Raises DataError if its format is not known, or it cannot be read.

    `topics` are those of a ROS bag that types and names do not identify.
    """
    if not path.exists():
        raise DataError(f"{path} does not exist")
    if path.suffix.lower() == ".zip":
        raise DataError(f"{path} must be unpacked first; then name the folder")
    folders = [entry for entry in path.iterdir() if entry.is_dir()] if path.is_dir() else []
    for place in (path, *(folders if len(folders) == 1 else [])):  # a zipped folder often has another around it
        for kind in FORMATS:
            if not kind.recognized(place):
                continue
            if kind.has_topics:
                return kind.open(place, topics or Topics())
            if topics and topics.given:
                raise ConfigError(f"{path} has no topics: {', '.join(topics.given)} are for ROS bags")
            return kind.open(place)
    known = "; ".join(f"{kind.name}: {kind.needs}" for kind in FORMATS)
    raise DataError(f"{path} is of no format that can be imported. These are: {known}")
