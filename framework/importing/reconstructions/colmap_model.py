"""Import of RGB-D images with the poses of a COLMAP model (https://colmap.github.io/format.html).

    sparse/0/               cameras, images and points3D as .bin or .txt, and in newer versions rigs and frames; also
                            in sparse/, colmap/sparse/0/, colmap/ or the folder itself
    images/NAME.jpg         8-bit color with the names in the model; also in color/ or rgb/
    depth/NAME.png          uint16 along z, registered to color; `depth_scale` of camera.json, else 1000 units per meter
    camera.json             optional, as in RGB-D folders; only depth_scale is used

pycolmap reads the model. It stores T_camera_world with OpenCV's camera axes, and pixel centers are at half integers.
The unit of a model from images is arbitrary. The length of the unit is the median ratio of measured depth to depth in
the model. A model is not scaled if its unit differs from 1 m by at most METRIC_WITHIN.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import Camera, Float64
from framework.datasets.calibration.camera_json import pinhole, read_camera
from framework.datasets.calibration.undistortion import Distortion
from framework.datasets.frames.numbered_images import natural_order
from framework.datasets.frames.sequence_reader import FRAME_RATE
from framework.errors import DataError, FrameError, errors_of, in_one_line
from framework.files.atomic_write import read_bytes
from framework.files.image_files import read_color, read_uint16
from framework.geometry import inverse, nearest_rigid
from framework.importing.source import DeviceFrame, Format, Source, meters

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap", ".")
COLOR_FOLDERS, DEPTH_FOLDERS = ("images", "color", "rgb"), ("depth", "depths")
CAMERA_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
UNITS_PER_METER = 1000.0  # default of depth
PIXEL_CENTER = 0.5  # px, coordinate of the center of the first pixel
LARGEST_FILE = 2**32  # bytes, of a binary file
METRIC_WITHIN = 0.02  # maximum difference of a metric unit from 1 m; depth sensors have such errors
MIN_RATIOS = 50  # minimum number of depth ratios that determine the unit
MAX_SPREAD = 0.2  # maximum median deviation of the ratios from their median, relative to it
UNIT_IMAGES = 30  # maximum number of images that determine the unit

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RegisteredImage:
    """An image of the model."""

    name: str  # relative to the color folder
    T_camera_world: Float64  # (3, 4), translation in units of the model
    camera: Camera
    lens: Distortion
    pixels: Float64  # (P, 2) px, pixel centers at integers, of the 3D points
    points_world: Float64  # (P, 3) in units of the model


@dataclass(frozen=True)
class ImageFolders:
    """Folders of a recording."""

    model: Path
    color: Path
    depth: Path
    units_per_meter: float  # of depth

    def depth_of(self, image: RegisteredImage) -> Path:
        return (self.depth / image.name).with_suffix(".png")


def recognized(path: Path) -> bool:
    """Return True if the path has a COLMAP model next to color and depth images."""
    return all((_first(path, COLOR_FOLDERS), _first(path, DEPTH_FOLDERS), _model(path)))


def open_source(path: Path) -> Source:
    """Open a model with its images.

    Raises:
        DataError: The model is invalid or has an unsupported camera, or its unit cannot be determined.
    """
    model, color, depth = _model(path), _first(path, COLOR_FOLDERS), _first(path, DEPTH_FOLDERS)
    assert model is not None
    assert color is not None
    assert depth is not None
    camera_json = path / "camera.json"
    units = read_camera(camera_json).depth_scale if camera_json.is_file() else UNITS_PER_METER
    folders = ImageFolders(model, color, depth, units)
    images = _read_model(model)
    _log_unregistered(folders, images)
    lenses = {image.lens for image in images}
    if len(lenses) > 1:
        raise DataError(
            f"{model}: expected one lens distortion for all images, got {len(lenses)}; undistort the images"
        )
    [lens] = lenses
    unit = _unit(folders, images)
    frames = [partial(_read, folders, image, k / FRAME_RATE, unit) for k, image in enumerate(images)]
    return Source("COLMAP", frames, len(frames), posed=True, distortion=None if lens == Distortion() else lens)


def _log_unregistered(folders: ImageFolders, images: Sequence[RegisteredImage]) -> None:
    """Log the number of color images that are not in the model and are therefore skipped."""
    registered = {image.name for image in images}
    stored = [path for path in folders.color.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png")]
    missing = sum(path.relative_to(folders.color).as_posix() not in registered for path in stored)
    if missing:
        log.warning("%s: %d of %d color images have no pose and are skipped", folders.model, missing, len(stored))


def _read(folders: ImageFolders, image: RegisteredImage, timestamp: float, unit: float) -> DeviceFrame:
    depth = folders.depth_of(image)
    T_camera_world = np.vstack([image.T_camera_world, [0.0, 0.0, 0.0, 1.0]])
    T_camera_world[:3, 3] *= unit
    with errors_of(f"{folders.model}: {image.name}"):
        T_world_camera = inverse(nearest_rigid(T_camera_world))
    return DeviceFrame(
        name=depth,
        timestamp=timestamp,
        camera=image.camera,
        color=read_color(folders.color / image.name),
        depth=meters(read_uint16(depth), folders.units_per_meter),
        T_world_camera=T_world_camera,
    )


def _unit(folders: ImageFolders, images: Sequence[RegisteredImage]) -> float:
    """Return the length of the unit of the model, m."""
    chosen = np.unique(np.linspace(0, len(images) - 1, UNIT_IMAGES).astype(int))
    ratios = np.concatenate([_depth_ratios(folders, images[k]) for k in chosen])
    if len(ratios) < MIN_RATIOS:
        log.warning(
            "%s: expected at least %d 3D points with depth to determine the unit of the poses, got %d; using 1 m",
            *(folders.model, MIN_RATIOS, len(ratios)),
        )
        return 1.0
    unit = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios - unit))) / unit
    if spread > MAX_SPREAD:
        raise DataError(
            f"{folders.depth}: expected depth along z that is proportional to the depth in {folders.model}, got a "
            f"median deviation of {spread:.0%}; register depth to color"
        )
    if abs(unit - 1) <= METRIC_WITHIN:
        return 1.0
    log.warning("%s: the unit of the poses is %.4g m, determined from %d 3D points", folders.model, unit, len(ratios))
    return unit


def _depth_ratios(folders: ImageFolders, image: RegisteredImage) -> Float64:
    """Return the ratio (R,) of measured depth, m, to depth in the model at each 3D point with a reading."""
    try:
        depth = meters(read_uint16(folders.depth_of(image)), folders.units_per_meter)
    except FrameError:
        return np.zeros(0)
    expected = image.points_world @ image.T_camera_world[2, :3] + image.T_camera_world[2, 3]
    scale = np.array(depth.shape[::-1]) / (image.camera.width, image.camera.height)
    u, v = np.floor((image.pixels + 0.5) * scale).astype(int).T
    inside = (u >= 0) & (u < depth.shape[1]) & (v >= 0) & (v < depth.shape[0]) & (expected > 0)
    measured = depth[v[inside], u[inside]].astype(np.float64)
    return np.asarray((measured / expected[inside])[measured > 0])


def _read_model(path: Path) -> list[RegisteredImage]:
    """Return the registered images in the order of their names."""
    _check_files(path)
    import pycolmap  # takes 0.3 s

    try:
        model = pycolmap.Reconstruction(path)
        if (cameras := path / "cameras.bin").is_file():
            size = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
            _require_length(cameras, cameras.stat().st_size, size)
        images = [_image(path, model, image) for image in model.images.values() if image.has_pose]
    except DataError:
        raise
    except Exception as error:  # pycolmap raises built-in exceptions of several kinds
        raise DataError(f"{path}: expected a valid COLMAP model, got an error ({in_one_line(error)[:200]})") from error
    if not images:
        raise DataError(f"{path}: expected registered images, got none")
    return sorted(images, key=lambda image: natural_order(image.name))


def _image(path: Path, model: Any, image: Any) -> RegisteredImage:
    camera = image.camera
    where = f"{path}: camera {camera.camera_id}"
    if camera.model_name not in CAMERA_MODELS:
        expected = f"expected one of {', '.join(CAMERA_MODELS)}"
        raise DataError(f"{where}: {expected}, got {camera.model_name}; undistort the images")
    extra = [float(camera.params[k]) for k in camera.extra_params_idxs()]
    if any(extra[5:]):
        raise DataError(f"{where}: expected k4, k5, k6 = 0, got {extra[5:]}; undistort the images")
    focal = camera.focal_length_x, camera.focal_length_y
    center = camera.principal_point_x - PIXEL_CENTER, camera.principal_point_y - PIXEL_CENTER
    observed = [point for point in image.points2D if point.has_point3D()]
    with errors_of(where):
        lens = Distortion(*extra[:5])
    return RegisteredImage(
        image.name,
        np.asarray(image.cam_from_world().matrix(), np.float64),
        pinhole(where, camera.width, camera.height, *focal, *center),
        lens,
        np.array([point.xy for point in observed], np.float64).reshape(-1, 2) - PIXEL_CENTER,
        np.array([model.points3D[point.point3D_id].xyz for point in observed], np.float64).reshape(-1, 3),
    )


@dataclass(frozen=True)
class Records:
    """Layout of the records of a binary file: fixed bytes, a name in some files, and a counted list."""

    fixed: int  # bytes
    counter: str  # struct format of the length of the list
    item: int  # bytes of an entry of the list
    named: bool = False  # True if a name that ends with a zero byte precedes the list


RECORDS: Mapping[str, Records] = {
    "cameras.bin": Records(48, "", 0),  # minimum size; the number of parameters depends on the model
    "images.bin": Records(64, "<Q", 24, named=True),
    "points3D.bin": Records(43, "<Q", 8),
    "rigs.bin": Records(4, "<I", 8),  # of rigs with one camera
    "frames.bin": Records(64, "<I", 16),
}


def _check_files(folder: Path) -> None:
    """Raise DataError if a binary file is shorter than its records, for which pycolmap does not return."""
    for name, records in RECORDS.items():
        if (path := folder / name).is_file():
            _check_length(path, records)


def _check_length(path: Path, records: Records) -> None:
    data = read_bytes(path, LARGEST_FILE)
    try:
        [count] = struct.unpack_from("<Q", data)
        end = 8
        if not records.counter:
            end += count * records.fixed
            count = 0
        for _ in range(count):
            end += records.fixed
            if records.named:
                end = data.index(0, end) + 1
            [items] = struct.unpack_from(records.counter, data, end)
            if path.name == "rigs.bin" and items != 1:
                raise DataError(f"{path}: expected one camera per rig, got {items}; export a model without rigs")
            end += struct.calcsize(records.counter) + items * records.item
    except (struct.error, ValueError, OverflowError):  # beyond the end
        end = len(data) + 1
    _require_length(path, len(data), end)


def _require_length(path: Path, found: int, expected: int) -> None:
    if found < expected:
        raise DataError(f"{path}: expected complete records, got a file that ends after {found} bytes")


def _first(path: Path, names: Sequence[str]) -> Path | None:
    """Return the first existing folder, or None."""
    return next((path / name for name in names if (path / name).is_dir()), None)


def _model(path: Path) -> Path | None:
    """Return the folder of the model, or None."""
    folders = [path / name for name in MODELS]
    return next((one for one in folders if any((one / f"cameras.{end}").is_file() for end in ("bin", "txt"))), None)


NEEDS = "a folder with a COLMAP model (sparse/0/), color (images/) and depth images (depth/)"
FORMAT = Format("colmap", NEEDS, recognized, open_source)
