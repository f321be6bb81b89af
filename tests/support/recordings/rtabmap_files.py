"""Writer of RTAB-Map databases.

Sources in introlab/rtabmap: corelib/src/resources/backward_compatibility/DatabaseSchema_0_22_0.sql (the columns that
are written here), CameraModel::serialize, compressData and compressImage.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.support.recordings.phone_exports import PhoneFrame

SCHEMA = """
CREATE TABLE Node (id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT, pose BLOB,
    ground_truth_pose BLOB, velocity BLOB, label TEXT, gps BLOB, env_sensors BLOB, time_enter DATE, PRIMARY KEY (id));
CREATE TABLE Data (id INTEGER NOT NULL, image BLOB, depth BLOB, depth_confidence BLOB, calibration BLOB, scan BLOB,
    scan_info BLOB, user_data BLOB, time_enter DATE, PRIMARY KEY (id));
CREATE TABLE Admin (version TEXT, preview_image BLOB, opt_cloud BLOB, opt_ids BLOB, opt_poses BLOB, time_enter DATE);
"""
# camera_link to the optical frame: x right, y down, z forward; the camera is 0.3 m above and 0.1 m in front of the base
T_BASE_CAMERA = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0.0], [0, -1, 0, 0.3], [0, 0, 0, 1]])
T_MAP_ODOM = np.array([[0, -1, 0, 1.0], [1, 0, 0, 2.0], [0, 0, 1, -0.5], [0, 0, 0, 1]])  # correction by the graph
CV_32SC1, CV_32FC1 = 4, 5


def write_rtabmap(path: Path, frames: Sequence[PhoneFrame], optimized: bool = True, float_depth: bool = False) -> None:
    """Write a database; without `optimized`, the frames' poses are those of odometry."""
    database = sqlite3.connect(path)
    database.executescript(SCHEMA)
    ids, poses = [], []
    for number, frame in enumerate(frames, start=1):
        T_map_base = frame.T_world_camera @ np.linalg.inv(T_BASE_CAMERA)
        T_odom_base = np.linalg.inv(T_MAP_ODOM) @ T_map_base if optimized else T_map_base
        ids.append(number)
        poses.append(T_map_base[:3].ravel())
        row = (number, 0, 0, frame.timestamp, transform(T_odom_base))
        database.execute("INSERT INTO Node (id, map_id, weight, stamp, pose) VALUES (?, ?, ?, ?, ?)", row)
        _, image = cv2.imencode(".jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        depth = frame.depth_mm
        if float_depth:  # the bytes of float32 as BGRA
            data = (frame.depth_mm / np.float32(1000)).astype("<f4").tobytes()
            depth = np.frombuffer(data, np.uint8).reshape(*frame.depth_mm.shape, 4)
        _, png = cv2.imencode(".png", depth)
        row = (number, image.tobytes(), png.tobytes(), calibration(frame))
        database.execute("INSERT INTO Data (id, image, depth, calibration) VALUES (?, ?, ?, ?)", row)
    database.execute("INSERT INTO Node (id, map_id, weight, stamp) VALUES (99, 0, -9, 1.0)")  # a node without images
    database.execute("INSERT INTO Data (id) VALUES (99)")
    stored = compressed(np.array([ids], "<i4"), CV_32SC1), compressed(np.array([np.ravel(poses)], "<f4"), CV_32FC1)
    row = ("0.22.0", *(stored if optimized else (None, None)))
    database.execute("INSERT INTO Admin (version, opt_ids, opt_poses) VALUES (?, ?, ?)", row)
    database.commit()
    database.close()


def calibration(frame: PhoneFrame) -> bytes:
    c = frame.camera
    K = struct.pack("<9d", c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1)
    D = struct.pack("<5d", 0.1, -0.2, 0.001, 0.002, 0.0)  # of the raw images; stored images are rectified
    R = struct.pack("<9d", *np.eye(3).ravel())
    P = struct.pack("<12d", c.fx, 0, c.cx, 0, 0, c.fy, c.cy, 0, 0, 0, 1, 0)
    return (
        struct.pack("<11i", 0, 22, 0, 0, c.width, c.height, 9, 5, 9, 12, 12) + K + D + R + P + transform(T_BASE_CAMERA)
    )


def transform(T: np.ndarray) -> bytes:
    return struct.pack("<12f", *T[:3].ravel())


def compressed(array: np.ndarray, kind: int) -> bytes:
    return zlib.compress(array.tobytes()) + struct.pack("<3i", *array.shape, kind)
