"""Instance maps of other systems, before their conversion to the outputs of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from framework.data import Int32
from framework.errors import DataError
from framework.files.ply import PlyMesh, read_ply
from framework.runs.external_maps.array_files import read_array

UNLABELED = "unlabeled"  # name of an instance without a class, in a map with classes
FIX = "subtract an offset from coordinates such as UTM"
MAX_COORDINATE = 1e6  # maximum absolute coordinate of a point; float32 has a resolution of 6 cm there


@dataclass(frozen=True)
class ExternalInstance:
    """An instance in the map of another system."""

    vertices: Int32  # (M,) ascending indices of its points
    label: str | None  # class name, UNLABELED without a class; None = a map without classes
    confidence: float | None  # in [0, 1]; None = unknown


@dataclass(frozen=True)
class ExternalMap:
    """The map of another system."""

    surface: PlyMesh  # in the world frame and the units of the file; a point cloud has no triangles
    instances: Mapping[int, ExternalInstance]  # by positive id; instances may overlap
    source: str  # format and origin of the labels, for messages
    label_space: tuple[str, ...] = ()  # names of all class ids; () = no class ids
    masks: tuple[Path, ...] = ()  # mask files of predictions that are given as a text file


def read_surface(path: Path) -> PlyMesh:
    """Read a mesh or point cloud from a PLY file, or the points (V, 3) from an NPY file.

    Raises:
        DataError: The file is missing, damaged, or has no points.
    """
    if path.suffix.lower() == ".npy":
        points = read_array(path)
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
            raise DataError(f"{path}: expected floating-point points (V, 3), got {points.dtype} {points.shape}")
        if not (np.abs(points) <= MAX_COORDINATE).all():  # rejects NaN
            raise DataError(
                f"{path}: expected coordinates of at most {MAX_COORDINATE:g}, got larger values or NaN; {FIX}"
            )
        surface = PlyMesh(points.astype(np.float32), np.empty((0, 3), np.int32), {}, ())
    else:
        surface = read_ply(path)
    if not len(surface.vertices):
        raise DataError(f"{path}: expected at least one point, got none")
    return surface
