"""Import of RGB-D images with a transforms.json, as written by nerfstudio and by the scripts of NeRFCapture.

    transforms.json         fl_x, fl_y, cx, cy, w, h, k1, k2, k3, p1, p2, camera_model: intrinsics for all frames, or in
                            each frame; frames: a list of
      file_path             8-bit color; the suffix .png may be missing
      depth_file_path       depth along z (depth_path in NeRFCapture and Instant NGP): uint16 PNG, or floats in m as
                            .npy, .tiff or .exr
      transform_matrix      T_world_camera, 4 x 4, with OpenGL's camera axes (y up, z backward)
      timestamp             s, optional
    integer_depth_scale     meters per depth unit, as is depth_unit_scale_factor (a parameter of nerfstudio, which some
                            programs write to the file); without them, uint16 depth is in mm
    is_fisheye              true = another lens model (Instant NGP), which is not supported
    applied_scale           length of one meter in the stored poses; 1 if missing

Sources: docs/quickstart/data_conventions.md and nerfstudio_dataparser.py in nerfstudio-project/nerfstudio, and
scripts/nerfcapture_dataset.py in jc211/NeRFCapture. The ray generator of nerfstudio puts pixel centers at half
integers. The frames are read in the order of their timestamps, otherwise in the order of the color names, as in
nerfstudio.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float32
from framework.datasets.calibration.camera_json import number_list, numbers_of, pinhole, read_json_object
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.numbered_images import natural_order
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.errors import DataError, FrameError
from framework.files.depth_files import FARTHEST, read_depth
from framework.files.image_files import read_color
from framework.importing.source import DeviceFrame, Format, Source, arkit_pose, meters, readings

NAME = "transforms.json"
DEPTH_KEYS = ("depth_file_path", "depth_path")
INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
MODELS = ("OPENCV", "PINHOLE", "RADIAL", "SIMPLE_PINHOLE", "SIMPLE_RADIAL")  # with the coefficients above
DEPTH_UNITS = ("integer_depth_scale", "depth_unit_scale_factor")
UNITS_PER_METER = 1000.0  # default of depth
APP_SCALE = "depth_integer_scale"  # written by the app NeRFCapture, which stores no metric depth
PIXEL_CENTER = 0.5  # px, coordinate of the center of the first pixel

log = logging.getLogger(__name__)


def recognized(path: Path) -> bool:
    """Return True if the path is a folder with a transforms.json, or such a file."""
    return _file(path).is_file()


def open_source(path: Path) -> Source:
    """Open a transforms.json, or the folder that contains it.

    Raises:
        DataError: The file is invalid, no frame has depth, or the lens model is unsupported.
    """
    file = _file(path)
    content = read_json_object(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise DataError(f"{file}: frames: expected a list of frames, got {frames!r:.60}")
    with_depth = [content | frame | {"frames": None} for frame in frames if _depth_key(frame)]
    if not with_depth:
        found = f"got none in {len(frames)} frames; export depth, too"
        raise DataError(f"{file}: expected frames with {' or '.join(DEPTH_KEYS)}, {found}")
    if len(with_depth) < len(frames):
        log.warning(
            "%s: %d of %d frames have no depth and are skipped", file, len(frames) - len(with_depth), len(frames)
        )
    units_per_meter = _depth_scale(file, content)
    lens = _lens(file, with_depth)
    length = numbers_of(file, content, "applied_scale")[0] if "applied_scale" in content else 1.0
    if not length > 0:
        raise DataError(f"{file}: applied_scale: expected a value > 0, got {length:g}")
    ordered = _in_order(file, with_depth)
    reads = [partial(_read, file, frame, k, units_per_meter, length) for k, frame in enumerate(ordered)]
    return Source(NAME, reads, len(reads), posed=True, distortion=lens)


def _file(path: Path) -> Path:
    return path if path.name == NAME else path / NAME


def _read(
    file: Path, frame: Mapping[str, Any], number: int, units_per_meter: float | None, length: float
) -> DeviceFrame:
    color, depth = (_image(file, frame, key) for key in ("file_path", _depth_key(frame)))
    where = f"{file}: {frame['file_path']}"
    matrix = frame.get("transform_matrix")
    if not isinstance(matrix, list) or len(matrix) not in (3, 4):
        raise DataError(f"{where}: transform_matrix: expected 4 lists of 4 numbers, got {matrix!r:.60}")
    T_world_opengl = np.vstack(
        [*(number_list(f"{where}: transform_matrix", row, 4) for row in matrix[:3]), [0, 0, 0, 1]]
    )
    T_world_opengl[:3, 3] /= length
    image = read_color(color)
    return DeviceFrame(
        name=depth,
        timestamp=_timestamp(where, frame, number),
        camera=_camera(where, {"h": image.shape[0], "w": image.shape[1], **frame}),
        color=image,
        depth=_metric_depth(depth, units_per_meter),
        T_world_camera=arkit_pose(where, T_world_opengl),
    )


def _metric_depth(path: Path, units_per_meter: float | None) -> Float32:
    """Return the depth (h, w), m, in an image. None = uint16 in mm or floats in m."""
    depth = read_depth(path)
    if depth.dtype == np.uint16:
        return meters(np.asarray(depth, np.uint16), units_per_meter or UNITS_PER_METER)
    metric = readings(np.asarray(depth, np.float32)) / np.float32(units_per_meter or 1.0)
    if metric.any() and (median := float(np.median(metric[metric > 0]))) > FARTHEST:
        fix = f"write {DEPTH_UNITS[0]} (meters per unit), such as 0.001"
        raise FrameError(f"{path}: expected float depth in meters, got a median of {median:.6g}; {fix}")
    return metric


def _depth_key(frame: Mapping[str, Any]) -> str:
    """Return the key of the depth image, or "" without depth."""
    return next((key for key in DEPTH_KEYS if frame.get(key) is not None), "")


def _image(file: Path, frame: Mapping[str, Any], key: str) -> Path:
    name = frame.get(key)
    if not isinstance(name, str) or not name or "\0" in name:
        raise DataError(f"{file}: {key}: expected a file name, got {name!r:.60}")
    path = file.parent / name
    return path if path.suffix else path.with_name(f"{path.name}.png")  # as in Instant NGP


def _timestamp(where: str, frame: Mapping[str, Any], number: int) -> float:
    return numbers_of(where, frame, "timestamp")[0] if "timestamp" in frame else number / FRAME_RATE


def _camera(where: str, frame: Mapping[str, Any]) -> Camera:
    width, height, fx, fy, cx, cy = numbers_of(where, frame, *INTRINSICS)
    return pinhole(where, width, height, fx, fy, cx - PIXEL_CENTER, cy - PIXEL_CENTER)


def _lens(file: Path, frames: Sequence[Mapping[str, Any]]) -> Distortion | None:
    """Return the lens distortion of all frames; None = pinhole camera."""
    for frame in frames:
        if (model := frame.get("camera_model", MODELS[0])) not in MODELS:
            raise DataError(
                f"{file}: camera_model: expected {' or '.join(MODELS)}, got {model!r:.60}; undistort the images"
            )
        if frame.get("is_fisheye"):
            raise DataError(
                f"{file}: is_fisheye: expected false, got {frame['is_fisheye']!r:.60}; undistort the images"
            )
        if frame.get("k4"):
            raise DataError(f"{file}: k4: expected 0 or no such key, got {frame['k4']!r:.60}; undistort the images")
    found = {tuple(numbers_of(file, dict.fromkeys(COEFFICIENTS, 0) | dict(frame), *COEFFICIENTS)) for frame in frames}
    if len(found) > 1:
        raise DataError(f"{file}: expected one lens distortion for all frames, got {len(found)}; undistort the images")
    [coefficients] = found
    return Distortion(*coefficients) if any(coefficients) else None


def _depth_scale(file: Path, content: Mapping[str, Any]) -> float | None:
    """Return the number of depth units per meter, or None if the file has none."""
    for key in DEPTH_UNITS:
        if key in content:
            [unit] = numbers_of(file, content, key)
            if not 0 < unit <= 1:
                raise DataError(f"{file}: {key}: expected meters per unit in (0, 1], got {unit:g}")
            return 1 / unit
    if APP_SCALE in content:
        raise DataError(
            f"{file}: expected {DEPTH_UNITS[0]} (meters per depth unit), got {APP_SCALE} of the app's own export; "
            f"record with nerfcapture_dataset.py, or add {DEPTH_UNITS[0]} (0.001 for millimeters)"
        )
    return None


def _in_order(file: Path, frames: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the frames in the order of their timestamps, or of their color names if a timestamp is missing."""
    if all("timestamp" in frame for frame in frames):
        return sorted(frames, key=lambda frame: numbers_of(file, frame, "timestamp")[0])
    untimed = [{key: value for key, value in frame.items() if key != "timestamp"} for frame in frames]
    return sorted(untimed, key=lambda frame: natural_order(str(frame.get("file_path"))))


NEEDS = "a folder with transforms.json and its color and depth images, from nerfstudio or NeRFCapture"
FORMAT = Format("transforms_json", NEEDS, recognized, open_source)
