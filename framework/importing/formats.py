"""Supported recording formats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote

from framework.config.text_values import typed
from framework.errors import ConfigError, DataError
from framework.importing.bags import ros_bag
from framework.importing.bags.ros_topics import BagOptions, Topics
from framework.importing.phones import arkit_scenes, polycam, record3d, scanner_app, scannetpp_iphone, stray_scanner
from framework.importing.reconstructions import colmap_model, rtabmap_database, transforms_json
from framework.importing.source import Source

FORMATS = (
    stray_scanner.FORMAT,
    record3d.FILE_FORMAT,
    record3d.FOLDER_FORMAT,
    polycam.FORMAT,
    scanner_app.FORMAT,
    arkit_scenes.FORMAT,
    scannetpp_iphone.FORMAT,
    transforms_json.FORMAT,
    colmap_model.FORMAT,
    rtabmap_database.FORMAT,
    ros_bag.FORMAT,
)

DATASETS = {
    "rgbd_folder": ("an RGB-D folder", ("camera.json", "depth")),
    "tum_rgbd": ("a TUM RGB-D sequence", ("rgb.txt", "depth.txt")),
}
"""Name and files of the layouts that a dataset reads without an import, by `dataset`."""


def open_source(path: Path, topics: Topics | None = None, options: BagOptions | None = None) -> Source:
    """Open a recording in any supported format.

    Args:
        path: The file or folder of the recording.
        topics: The topics of a ROS bag; None = selected by type and name.
        options: The options of a ROS bag; None = defaults.

    Raises:
        DataError: The format is unknown, or the recording is unreadable.
        ConfigError: The topics are invalid, or they are set for another format.
    """
    if not path.exists():
        raise DataError(f"{path}: expected a recording, got no such file or folder")
    if path.suffix.lower() == ".zip":
        raise DataError(f"{path}: expected a folder or recording, got a zip archive; unpack it")
    if path.suffix.lower() == ".oni":
        scene = path.with_suffix("")
        command = f"instancemap convert-oni {quote(str(path))} {quote(str(scene))}"
        overrides = f"dataset=scenenn {typed('dataset.root', scene.parent)} {typed('dataset.scene', scene.name)}"
        raise DataError(
            f"{path}: expected a recording, got an OpenNI file; run {command}, then instancemap {overrides}"
        )
    folders = [entry for entry in path.iterdir() if entry.is_dir()] if path.is_dir() else []
    # unpacked archives often have an outer folder
    for place in (path, *(folders if len(folders) == 1 else [])):
        for kind in FORMATS:
            if not kind.recognized(place):
                continue
            if kind.has_topics:
                return replace(kind.open(place, topics or Topics(), options or BagOptions()), path=place)
            given = [*(topics.given if topics else ()), *(options.given if options else ())]
            if given:
                raise ConfigError(f"{', '.join(given)}: expected a ROS bag, got {path}; omit these options")
            return replace(kind.open(place), path=place)
    for dataset, (name, files) in DATASETS.items():
        if all((path / file).exists() for file in files):
            command = f"instancemap dataset={dataset} {typed('dataset.root', path)}"
            raise DataError(f"{path}: expected a recording, got {name}; run {command}")
    known = ", ".join(kind.name for kind in FORMATS)
    found = "got an unknown format; run instancemap import --help for the files of each format"
    raise DataError(f"{path}: expected a supported format ({known}), {found}")
