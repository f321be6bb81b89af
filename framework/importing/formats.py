"""The formats that can be imported, and which one a source is of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from framework.errors import DataError
from framework.importing import polycam, record3d, scanner_app, stray_scanner
from framework.importing.source import Source


@dataclass(frozen=True)
class Format:
    """How a source is recognised and opened."""

    name: str  # for the command line
    needs: str  # what is there where it is recognised, for the person
    recognised: Callable[[Path], bool]
    open: Callable[[Path], Source]


FORMATS = (
    Format(
        "stray_scanner",
        "a folder with odometry.csv, camera_matrix.csv, rgb.mp4 and depth/",
        stray_scanner.recognised,
        stray_scanner.open_source,
    ),
    Format(
        "record3d",
        "an .r3d file of Record3D",
        record3d.file_recognised,
        record3d.open_file,
    ),
    Format(
        "record3d_exr",
        "a folder with metadata.json, rgb/ and depth/, Record3D's EXR + RGB export",
        record3d.folder_recognised,
        record3d.open_folder,
    ),
    Format(
        "polycam",
        "a folder with keyframes/, Polycam's raw data",
        polycam.recognised,
        polycam.open_source,
    ),
    Format(
        "scanner_app",
        'a folder with frame_00000.json, "All Data" of 3D Scanner App',
        scanner_app.recognised,
        scanner_app.open_source,
    ),
)


def open_source(path: Path) -> Source:
    """The recording at `path`, of whatever format it is. Raises DataError when it is of none, or cannot be read."""
    if not path.exists():
        raise DataError(f"{path} does not exist")
    for kind in FORMATS:
        if kind.recognised(path):
            return kind.open(path)
    known = "; ".join(f"{kind.name}: {kind.needs}" for kind in FORMATS)
    raise DataError(f"{path} is of no format that can be imported. These are: {known}")
