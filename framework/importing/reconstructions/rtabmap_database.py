"""Import of RTAB-Map databases (https://github.com/introlab/rtabmap, versions 0.11 and newer), such as rtabmap.db.

An SQLite file with the tables

    Node    id, stamp (s), pose: T_odom_base
    Data    id, image: JPEG or PNG; depth, also smaller than image: PNG of uint16 mm, PNG of float32 m as four 8-bit
            channels, "DEPTHRVL" and an RVL image of mm, or "DEPTHINV", float32 A and B, and an image of uint16
            in PNG or RVL with the depth A / (value - B); calibration: the camera and T_base_camera
    Admin   opt_ids, opt_poses: T_map_base of the optimized graph

A transform consists of 12 float32 (3 x 4, row-major), with OpenCV's axes of the camera. A calibration consists of 11
int32 (version: 3, type: 0 = one camera, width, height, and the counts of the values in K, D, R, P and T_base_camera)
and these values: float64, and float32 for T_base_camera. Images are rectified, so the camera is P, or K without P.
Before version 0.18, a calibration consists of the float32 fx, fy, cx, cy, width, height and T_base_camera; before
version 0.11.2, without width and height.
Arrays of Admin are compressed with zlib, followed by the int32 rows, columns and OpenCV type. All values are
little-endian.

Sources: corelib/src/resources/DatabaseSchema.sql.in, CameraModel::serialize, compressData and compressImage in
introlab/rtabmap; DBDriverSqlite3::loadNodeDataQuery for older calibrations. Optimized poses are preferred. Nodes
outside of the optimized graph are then not imported.
"""

from __future__ import annotations

import logging
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from framework.data import Array, Camera, Float32, Float64, UInt16
from framework.datasets.calibration.camera_json import pinhole
from framework.errors import DataError, FrameError, errors_of, in_one_line
from framework.files.image_files import LARGEST_FILE, check_image, decode_color, decode_uint16
from framework.files.rvl_images import decode_rvl
from framework.geometry import nearest_rigid
from framework.importing.bags.ros_images import inverse_depth
from framework.importing.source import DeviceFrame, Format, Source, meters, readings, warn_of_zeros

SQLITE_START = b"SQLite format 3\0"
HEADER = struct.Struct("<11i")
ONE_CAMERA, LAST_TYPE = 0, 1  # types of a calibration; 1 = stereo
NUMBERS = {"K": (9,), "R": (0, 9), "P": (0, 12), "T_base_camera": (12,)}  # possible counts of values
TRANSFORM = 12  # numbers of a transform
UNKNOWN = bytes(4 * TRANSFORM)  # transform of a node without a pose
OLD_CALIBRATIONS = {64: 4, 72: 6}  # numbers before the transform, by the size in bytes
FLOAT_CHANNELS = 4  # 8-bit channels of float32 depth
RVL_DEPTH, INVERSE_DEPTH = b"DEPTHRVL", b"DEPTHINV"  # first bytes of depth that is not a PNG
INVERSE_HEADER = struct.Struct("<8sff")  # INVERSE_DEPTH, A and B
INT32, FLOAT32 = 4, 5  # OpenCV's types of arrays with one channel
TRAILER = struct.Struct("<3i")  # rows, columns and type of a compressed array
LARGEST_ARRAY = 2**28  # bytes
OPTIMIZE = "open and close the database in RTAB-Map, or run rtabmap-reprocess"

log = logging.getLogger(__name__)


def recognized(path: Path) -> bool:
    """Return True if the path is an SQLite file with the suffix .db."""
    if path.suffix.lower() != ".db" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(SQLITE_START)) == SQLITE_START


def open_source(path: Path) -> Source:
    """Open a database.

    Raises:
        DataError: The file is not a database of RTAB-Map, is damaged, or has no RGB-D images.
    """
    with _database(path) as database:
        nodes = database.execute(
            "SELECT Node.id, stamp, pose FROM Node JOIN Data ON Node.id = Data.id "
            "WHERE length(image) > 0 AND length(depth) > 0 ORDER BY stamp, Node.id"
        ).fetchall()
        [sessions] = database.execute("SELECT count(DISTINCT map_id) FROM Node").fetchone()
        optimized = _optimized_poses(path, database)
    if not nodes:
        raise DataError(f"{path}: expected nodes with color and depth images, got none; save RGB-D images in RTAB-Map")
    if optimized is None and sessions > 1:
        raise DataError(
            f"{path}: expected optimized poses for {sessions} sessions, got only odometry with separate origins; "
            f"{OPTIMIZE}"
        )
    if optimized is None:
        log.warning("%s: expected optimized poses, got only odometry, which drifts; %s", path, OPTIMIZE)
    frames = [partial(_read, path, node, stamp, odometry, optimized) for node, stamp, odometry in nodes]
    posed = optimized is not None or any(odometry not in (None, UNKNOWN) for _, _, odometry in nodes)
    if not posed:
        warn_of_zeros(path)
    return Source("RTAB-Map", frames, len(frames), posed)


@contextmanager
def _database(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a database without changing it, and convert its errors to DataError."""
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            yield database
    except sqlite3.Error as error:
        raise DataError(f"{path}: expected an RTAB-Map database, got an error ({in_one_line(error)})") from error


def _read(path: Path, node: int, stamp: object, odometry: object, optimized: dict[int, Float64] | None) -> DeviceFrame:
    where = f"{path}: node {node}"
    if not isinstance(stamp, float | int):
        raise FrameError(f"{where}: stamp: expected a time in s, got {stamp!r:.40}")
    T_world_base = _transform(where, odometry) if optimized is None else optimized.get(node)
    with _database(path) as database:
        query = "SELECT image, depth, calibration FROM Data WHERE id = ?"
        image, depth, calibration = (
            _blob(where, *pair)
            for pair in zip(("image", "depth", "calibration"), database.execute(query, (node,)).fetchone(), strict=True)
        )
    color = decode_color(f"{where}: image", image)
    camera, T_base_camera = _calibration(where, calibration, color.shape[:2])
    with errors_of(where):
        T_world_camera = None if T_world_base is None else nearest_rigid(T_world_base) @ T_base_camera
    return DeviceFrame(
        name=where,
        timestamp=float(stamp),
        camera=camera,
        color=color,
        depth=_depth(f"{where}: depth", depth),
        T_world_camera=T_world_camera,
    )


def _blob(where: str, name: str, value: object) -> bytes:
    if not isinstance(value, bytes) or len(value) > LARGEST_FILE:
        found = f"{len(value)} bytes" if isinstance(value, bytes) else type(value).__name__
        raise FrameError(f"{where}: {name}: expected a blob of at most {LARGEST_FILE} bytes, got {found}")
    return value


def _transform(where: str, value: object) -> Float64 | None:
    """Return a stored transform (4, 4), which may be invalid; None = unknown."""
    if value is None or value == UNKNOWN:
        return None
    if not isinstance(value, bytes) or len(value) != 4 * TRANSFORM:
        raise FrameError(f"{where}: pose: expected {TRANSFORM} float32, got {value!r:.40}")
    return _matrix(np.frombuffer(value, "<f4"))


def _matrix(values: Array) -> Float64:
    return np.vstack([np.reshape(values, (3, 4)).astype(np.float64), [0.0, 0.0, 0.0, 1.0]])


def _calibration(where: str, data: bytes, shape: tuple[int, int]) -> tuple[Camera, Float64]:
    """Return the camera of the color image and T_base_camera (4, 4). `shape` is used without a stored size."""
    where = f"{where}: calibration"
    expected = "expected the calibration of one rectified camera"
    if len(data) in OLD_CALIBRATIONS:
        fx, fy, cx, cy, *size = np.frombuffer(data, "<f4", OLD_CALIBRATIONS[len(data)]).tolist()
        width, height = map(int, size or (0, 0))
        with errors_of(where):
            T_base_camera = nearest_rigid(_matrix(np.frombuffer(data, "<f4")[-TRANSFORM:]))
        return pinhole(where, width or shape[1], height or shape[0], fx, fy, cx, cy), T_base_camera
    if len(data) < HEADER.size:
        raise FrameError(f"{where}: {expected}, got {len(data)} bytes")
    *_, kind, width, height, n_K, n_D, n_R, n_P, n_T = HEADER.unpack_from(data)
    if kind != ONE_CAMERA:
        found = f"type {kind}" if 0 < kind <= LAST_TYPE else f"{len(data)} bytes"
        raise FrameError(f"{where}: {expected}, got {found}; only single RGB-D cameras are supported")
    counts = {"K": n_K, "R": n_R, "P": n_P, "T_base_camera": n_T}
    wrong = [name for name, count in counts.items() if count not in NUMBERS[name]]
    if wrong or not 0 <= n_D <= 14:
        raise FrameError(f"{where}: {expected}, got {n_K}, {n_D}, {n_R}, {n_P} and {n_T} values of K, D, R, P, T")
    size = HEADER.size + 8 * (n_K + n_D + n_R + n_P) + 4 * n_T
    if len(data) != size:
        raise FrameError(
            f"{where}: {expected} ({size} bytes), got {len(data)} bytes; several cameras are not supported"
        )
    doubles = np.frombuffer(data, "<f8", n_K + n_D + n_R + n_P, HEADER.size)
    projection = doubles[n_K + n_D + n_R :].reshape(3, 4) if n_P else doubles[:n_K].reshape(3, 3)
    (fx, _, cx), (_, fy, cy) = projection[:2, :3].tolist()
    with errors_of(where):
        T_base_camera = nearest_rigid(_matrix(np.frombuffer(data, "<f4", n_T, size - 4 * n_T)))
    return pinhole(where, width or shape[1], height or shape[0], fx, fy, cx, cy), T_base_camera


def _depth(name: str, data: bytes) -> Float32:
    """Return a stored depth image (h, w), m, 0 = no reading."""
    if data.startswith(INVERSE_DEPTH) and len(data) >= INVERSE_HEADER.size:
        _, quantization_a, quantization_b = INVERSE_HEADER.unpack_from(data)
        return inverse_depth(_integers(name, data[INVERSE_HEADER.size :]), quantization_a, quantization_b)
    if data.startswith(RVL_DEPTH):
        return meters(_integers(name, data))
    check_image(name, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is not None and image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == FLOAT_CHANNELS:
        return readings(np.ascontiguousarray(image).view("<f4")[..., 0])
    return meters(decode_uint16(name, data))


def _integers(name: str, data: bytes) -> UInt16:
    return decode_rvl(name, data[len(RVL_DEPTH) :]) if data.startswith(RVL_DEPTH) else decode_uint16(name, data)


def _optimized_poses(path: Path, database: sqlite3.Connection) -> dict[int, Float64] | None:
    """Return T_map_base (4, 4) of each node of the optimized graph; None = not stored."""
    columns = {row[1] for row in database.execute("PRAGMA table_info(Admin)")}
    if not {"opt_ids", "opt_poses"} <= columns:
        return None  # older than 0.17
    query = "SELECT opt_ids, opt_poses FROM Admin WHERE length(opt_ids) > 0 AND length(opt_poses) > 0"
    stored = database.execute(query).fetchone()
    if stored is None:
        return None
    ids = _array(f"{path}: opt_ids", stored[0], INT32, "<i4")
    values = _array(f"{path}: opt_poses", stored[1], FLOAT32, "<f4")
    if len(values) != TRANSFORM * len(ids):
        raise DataError(f"{path}: opt_poses: expected {TRANSFORM * len(ids)} numbers, got {len(values)}")
    return dict(zip(ids.tolist(), map(_matrix, values.reshape(-1, TRANSFORM)), strict=True))


def _array(where: str, data: object, kind: int, dtype: str) -> Array:
    """Return the values (N,) of a compressed array."""
    if not isinstance(data, bytes) or len(data) < TRAILER.size:
        raise DataError(f"{where}: expected a compressed array, got {data!r:.40}")
    rows, columns, found = TRAILER.unpack(data[-TRAILER.size :])
    size = rows * columns * np.dtype(dtype).itemsize
    if found != kind or not 0 < size <= LARGEST_ARRAY:
        raise DataError(f"{where}: expected an array of type {kind}, got {rows}x{columns} of type {found}")
    try:
        raw = zlib.decompressobj().decompress(data[: -TRAILER.size], size)
    except zlib.error as error:
        raise DataError(f"{where}: expected a compressed array, got an error ({in_one_line(error)})") from error
    if len(raw) != size:
        raise DataError(f"{where}: expected {size} bytes, got {len(raw)}")
    return np.frombuffer(raw, dtype)


NEEDS = "a .db file of RTAB-Map"
FORMAT = Format("rtabmap", NEEDS, recognized, open_source)
