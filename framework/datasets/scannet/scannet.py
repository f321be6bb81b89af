"""ScanNet dataset (Dai et al., CVPR 2017).

Rooms were scanned with an iPad and an attached depth sensor:

    scene0000_00/scene0000_00.sens      the video in one file (`sens_file.py`), or the export of ScanNet's SensReader:
    scene0000_00/color/0.jpg            8-bit color, numbered from 0
    scene0000_00/depth/0.png            uint16, mm along z
    scene0000_00/pose/0.txt             T_world_camera, four lines of four numbers, m
    scene0000_00/intrinsic/             4x4 matrices: intrinsic_color.txt, intrinsic_depth.txt; optional
                                        extrinsic_color.txt, extrinsic_depth.txt
    scene0000_00/00000.jpg, 00000.png, 00000.txt, intrinsic.txt     `posed_images` of MMDetection3D: color, depth, pose
                                        and intrinsics of color (data/scannet/extract_posed_images.py in
                                        open-mmlab/mmdetection3d); optional depth_intrinsic.txt
    scene0000_00/scene0000_00_vh_clean_2.ply, _vh_clean_2.0.010000.segs.json, .aggregation.json
                                        optional: mesh, segments, and objects as sets of segments
    scannetv2-labels.combined.tsv       optional, in the folder of the scenes or in its parent: the class of each
                                        annotated name; without this file, fewer objects are evaluated
    scannet-labels.combined.tsv         optional, in the same folders: for annotations of the first release

Frames have the camera of the depth images (640x480 px). Color (1296x968 px) is registered to this camera. If the
intrinsics of one image are unknown, the two images are assumed to have the same field of view.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from framework.data import Camera
from framework.datasets.calibration.color_registration import ColorRegistration, registered_images
from framework.datasets.frames.numbered_images import first_size, numbered_images, paired_images
from framework.datasets.frames.sequence_reader import FRAME_RATE, Contents, RecordedFrame, StoredImages
from framework.datasets.ground_truth.labeled_mesh import LabeledMesh
from framework.datasets.ground_truth.labeled_recording import LabeledRecording
from framework.datasets.scannet.scannet_annotation import (
    FIRST_LABEL_TABLE,
    LABEL_TABLE,
    read_label_table,
    read_labeled_mesh,
    read_scannet200_names,
)
from framework.datasets.scannet.sens_file import open_sens
from framework.errors import DataError, errors_of
from framework.files.atomic_write import path_exists
from framework.files.image_files import read_color, read_uint16
from framework.files.number_lines import PrintedMatrix, read_matrix
from framework.geometry import inverse, rotation_angle

MESH_FILES = ("_vh_clean_2.ply", "_vh_clean_2.0.010000.segs.json", ".aggregation.json")  # suffixes of the scene name
DEPTH_SCALE = 1000.0  # units per meter, of exported depth
MICROSECONDS = 1e6  # per second
ONE_INTRINSICS, DEPTH_INTRINSICS = "intrinsic.txt", "depth_intrinsic.txt"  # in posed_images
COLOR_SIZE = (1296, 968)  # px, image size of the exported intrinsics; exported color images may be smaller
NEAR = 2.0  # m, depth at which the logged parallax is computed
LARGEST_SHIFT = 0.5  # px of the depth camera, maximum shift of color without a warning

log = logging.getLogger(__name__)


@dataclass
class ScanNet(LabeledRecording):
    """A scan of ScanNet v2, read from its `.sens` file if it exists, otherwise from exported images.

    Color is assumed to be registered to depth, as in the published scans. Extrinsics between the two cameras are not
    applied. A warning is logged if they are not negligible.
    """

    def open(self) -> Contents:
        above = self.folder.resolve().parents[:2]
        tables = [parent / name for name in (FIRST_LABEL_TABLE, LABEL_TABLE) for parent in reversed(above)]
        self._label_tables = [table for table in tables if path_exists(table)]
        self.load_mesh([self.folder / f"{self.name}{end}" for end in MESH_FILES], self._read_mesh)
        if self.mesh and not self._label_tables:
            message = "%s: expected a label table with the class of each name, got none; fewer objects are evaluated"
            log.warning(message, tables[-1])
        self.annotation = f"ScanNet v2{'' if self._label_tables else ', no label table'}" if self.mesh else ""
        sens, exported = sorted(self.folder.glob("*.sens")), self.folder / "color"
        if len(sens) > 1:
            raise DataError(f"{self.folder}: expected one .sens file, got {len(sens)}: {sens[0].name} and others")
        if sens and exported.is_dir():
            log.info("%s: preferred to the exported images in %s; it contains timestamps", sens[0], exported.parent)
        if sens:
            return _sens_contents(sens[0])
        if exported.is_dir():
            return _exported_contents(self.folder)
        if (self.folder / ONE_INTRINSICS).is_file():
            return _posed_contents(self.folder)
        expected = f"expected {self.name}.sens, color/ or {ONE_INTRINSICS}, got none of them"
        raise DataError(f"{self.folder}: {expected}; set dataset.scene to a scene such as scene0000_00")

    def _read_mesh(self, mesh: Path, segments: Path, objects: Path) -> LabeledMesh:
        nyu40: dict[str, str] = {}
        scannet200: dict[str, str] = {}
        for table in self._label_tables:  # the second release and the nearer folder take precedence
            nyu40 |= read_label_table(table)
            scannet200 |= read_scannet200_names(table)
        return read_labeled_mesh(mesh, segments, objects, nyu40, scannet200)


def _sens_contents(path: Path) -> Contents:
    file = open_sens(path)
    header = file.header
    for camera, name in ((header.color_camera, "color"), (header.depth_camera, "depth")):
        if not _fits(camera):
            size = f"{camera.width}x{camera.height}"
            expected = f"expected {name} intrinsics for images of {size} px"
            raise DataError(f"{path}: {expected}, got cx, cy = {camera.cx:g}, {camera.cy:g}")
    _warn_of_parallax(path, header.color_extrinsics, header.depth_extrinsics, header.depth_camera)
    with errors_of(path):
        registration = ColorRegistration(header.color_camera, header.depth_camera)
    frames = []
    for frame in file.frames:
        images = registered_images(frame.images, registration)
        color_time, depth_time = frame.color_time / MICROSECONDS, frame.depth_time / MICROSECONDS
        recorded = RecordedFrame.posed(images, depth_time, frame.camera_to_world.pose)
        frames.append(replace(recorded, color_timestamp=color_time, depth_timestamp=depth_time))
    lost = range(len(frames), header.frames)
    if lost:
        log.warning("%s: the last %d of %d frames are missing: %s", path, len(lost), header.frames, file.cut)
    frames += [RecordedFrame(frames[-1].images, k / FRAME_RATE, error=f"{path}, {file.cut}") for k in lost]
    return Contents(header.depth_camera, path, header.depth_scale, frames)


def _exported_contents(folder: Path) -> Contents:
    colors = numbered_images(folder / "color", (".jpg", ".jpeg", ".png"))
    depths = numbered_images(folder / "depth", (".png",))
    intrinsic = folder / "intrinsic" if (folder / "intrinsic").is_dir() else folder
    depth_camera = _camera(intrinsic / "intrinsic_depth.txt", *first_size(depths.values(), read_uint16))
    color_camera = _color_camera(intrinsic / "intrinsic_color.txt", *first_size(colors.values(), read_color))
    extrinsics = [intrinsic / f"extrinsic_{name}.txt" for name in ("color", "depth")]
    if all(map(path_exists, extrinsics)):
        _warn_of_parallax(intrinsic, read_matrix(extrinsics[0]), read_matrix(extrinsics[1]), depth_camera)
    with errors_of(intrinsic):
        registration = ColorRegistration(color_camera, depth_camera)
    images = paired_images(colors, depths)
    frames = [_exported_frame(folder, k, registered_images(pair, registration)) for k, pair in images.items()]
    return Contents(depth_camera, intrinsic / "intrinsic_depth.txt", DEPTH_SCALE, frames)


def _exported_frame(folder: Path, k: int, images: StoredImages) -> RecordedFrame:
    if not (folder / "pose").is_dir():
        return RecordedFrame(images, k / FRAME_RATE)
    return _posed_frame(folder / "pose", k, images)


def _posed_frame(folder: Path, k: int, images: StoredImages) -> RecordedFrame:
    pose = folder / f"{Path(images.depth_name).stem}.txt"
    return RecordedFrame.posed(images, k / FRAME_RATE, lambda: read_matrix(pose).stored_pose())


def _posed_contents(folder: Path) -> Contents:
    colors, depths = numbered_images(folder, (".jpg", ".jpeg")), numbered_images(folder, (".png",))
    color_size, depth_size = first_size(colors.values(), read_color), first_size(depths.values(), read_uint16)
    path, depth_path = folder / ONE_INTRINSICS, folder / DEPTH_INTRINSICS
    if path_exists(depth_path):
        color_camera, depth_camera = _color_camera(path, *color_size), _camera(depth_path, *depth_size)
    elif not _fits(read_matrix(path).camera(*COLOR_SIZE)) and _fits(read_matrix(path).camera(*depth_size)):
        depth_path, depth_camera = path, _camera(path, *depth_size)
        color_camera = _resized(depth_camera, *color_size)
    else:
        depth_path, color_camera = path, _color_camera(path, *color_size)
        depth_camera = _resized(color_camera, *depth_size)
    with errors_of(path):
        registration = ColorRegistration(color_camera, depth_camera)
    images = paired_images(colors, depths)
    frames = [_posed_frame(folder, k, registered_images(pair, registration)) for k, pair in images.items()]
    return Contents(depth_camera, depth_path, DEPTH_SCALE, frames)


def _camera(path: Path, width: int, height: int) -> Camera:
    camera = read_matrix(path).camera(width, height)
    if not _fits(camera):
        expected = f"expected intrinsics for images of {width}x{height} px"
        raise DataError(f"{path}: {expected}, got cx, cy = {camera.cx:g}, {camera.cy:g}")
    return camera


def _color_camera(path: Path, width: int, height: int) -> Camera:
    """Return the camera of exported color images with the given size, px.

    The intrinsics are scaled if SensReader has resized only the images.
    """
    matrix = read_matrix(path)
    if _fits(matrix.camera(width, height)) or not _fits(camera := matrix.camera(*COLOR_SIZE)):
        return _camera(path, width, height)
    return _resized(camera, width, height)


def _resized(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera of images with the same field of view and the given size, px."""
    u, v = width / camera.width, height / camera.height
    # pixel centers are at integers
    return Camera(width, height, u * camera.fx, v * camera.fy, u * (camera.cx + 0.5) - 0.5, v * (camera.cy + 0.5) - 0.5)


def _fits(camera: Camera) -> bool:
    """Return True if the principal point is near the image center."""
    u, v = camera.cx / camera.width, camera.cy / camera.height
    return max(abs(u - 0.5), abs(v - 0.5)) <= 1 / 8


def _warn_of_parallax(source: Path, color: PrintedMatrix, depth: PrintedMatrix, camera: Camera) -> None:
    """Log a warning if the extrinsics shift color by more than LARGEST_SHIFT."""
    try:
        T_color_depth = inverse(color.pose()) @ depth.pose()
    except DataError:
        log.warning(
            "%s: expected rigid extrinsics, got a non-rigid matrix; color and depth are assumed to be registered",
            source,
        )
        return
    baseline, angle = float(np.linalg.norm(T_color_depth[:3, 3])), rotation_angle(T_color_depth[:3, :3])
    shift = camera.fx * (baseline / NEAR + angle)
    if shift > LARGEST_SHIFT:
        log.warning(
            "%s: extrinsics of %.0f mm and %.2f degrees between color and depth are not applied; color is shifted by "
            "up to %.0f px at %.0f m",
            *(source, 1000 * baseline, np.degrees(angle), shift, NEAR),
        )
