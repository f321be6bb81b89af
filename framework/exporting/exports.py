"""Export of a run to standard 3D and map formats."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh

from framework.config.validation import require
from framework.data import LIKELY, InstanceMesh
from framework.datasets.frames.world_offset import origin_comments
from framework.errors import ConfigError, DataError
from framework.exporting.benchmark_predictions import BenchmarkPredictions
from framework.exporting.decimation import joined
from framework.exporting.floor_plan import write_floor_plan, write_geojson
from framework.exporting.glb import glb
from framework.exporting.object_meshes import Coloring, Part, object_parts, part_colors, parts
from framework.exporting.occupancy import plan, write_ros_map
from framework.exporting.scene_graph import write_scene_graph
from framework.exporting.upright_room import UprightRoom, read_room
from framework.exporting.usd import Collision, check_usd, write_usd
from framework.files.atomic_write import atomic_write
from framework.geometry import transform
from framework.runs.mesh_file import write_mesh

log = logging.getLogger(__name__)

OBJ_DIGITS = 5  # decimal places of coordinates in OBJ files (0.01 mm)


class ExportFormat(Enum):
    """File formats of exports."""

    GLB = "glb"
    PLY = "ply"
    USD = "usd"
    OBJ = "obj"
    FLOORPLAN = "floorplan"
    GRAPH = "graph"
    SCANNET = "scannet"
    NPZ = "npz"


MESHES = {ExportFormat.GLB: ".glb", ExportFormat.PLY: ".ply", ExportFormat.USD: ".usdc", ExportFormat.OBJ: ".obj"}
"""File extensions of the formats that contain surfaces."""

PREDICTIONS = (ExportFormat.SCANNET, ExportFormat.NPZ)  # predictions for benchmarks, of all instances


@dataclass(frozen=True)
class Chosen:
    """Options of an export."""

    objects: Sequence[str] = ()  # ids or classes; () = the whole room
    min_probability: float = LIKELY  # minimum probability that an object exists, in [0, 1]
    triangles: int | None = None  # approximate triangle count of the scene, maximum of each object; None = no limit
    coloring: Coloring = Coloring.APPEARANCE  # vertex colors
    collision: Collision = Collision.HULL  # collision shape of objects in USD files
    resolution: float = 0.05  # cell size of a floor plan, m, in [0.01, 1]
    robot_height: float = 1.0  # minimum height of observed empty space above a free cell, m, in [0.1, 3]
    # of predictions: nyu40, scannet20, scannet200, agnostic or a JSON file; None = as evaluated
    label_space: str | None = None
    points: Path | str | None = None  # PLY or NPY file with the points of predictions; None = ground-truth points

    def __post_init__(self) -> None:
        for name, low, high in (("min_probability", 0.0, 1.0), ("resolution", 0.01, 1.0), ("robot_height", 0.1, 3.0)):
            value = getattr(self, name)
            require(low <= value <= high, name, value, f"a value in [{low:g}, {high:g}]")
        if self.triangles is not None:
            require(self.triangles >= 4, "triangles", self.triangles, "at least 4")

    @classmethod
    def named(cls, objects: Sequence[str | int] = (), **choices: Any) -> Chosen:
        """Return the options, with enumeration members given by value, such as `coloring="class"`.

        Raises:
            ConfigError: An option or its value is unknown.
        """
        for name, kind in (("coloring", Coloring), ("collision", Collision)):
            if name in choices:
                choices[name] = one_of(kind, name, choices[name])
        if unknown := choices.keys() - {field.name for field in fields(cls)}:
            known = ", ".join(f.name for f in fields(cls))
            raise ConfigError(f"export: expected options among {known}, got {min(unknown)!r}")
        return cls(tuple(map(str, objects)), **choices)


Option = TypeVar("Option", bound=Enum)


def one_of(kind: type[Option], name: str, value: object) -> Option:
    """Return the enumeration member with the given value.

    Raises:
        ConfigError: The enumeration has no such value.
    """
    found = next((option for option in kind if option.value == value), None)
    if found is None:
        known = ", ".join(option.value for option in kind)
        raise ConfigError(f"{name}: expected one of {known}, got {value!r:.60}")
    return found


def export(
    run: Path,
    formats: Iterable[ExportFormat],
    out: Path | None = None,
    chosen: Chosen | None = None,
    up: Sequence[float] | None = None,
    floor: float | None = None,
) -> list[Path]:
    """Export a run to standard 3D and map formats.

    The files are deterministic and written atomically.

    Args:
        run: Run directory.
        formats: File formats.
        out: Output folder; None = `export` in the run directory.
        chosen: Options; None = defaults.
        up: Up direction (3,) in the world frame; None = stored direction.
        floor: Floor height along the up direction, m; None = stored height, or unknown if `up` is given.

    Returns:
        The paths of the files.

    Raises:
        ConfigError: An option is invalid.
        DataError: The run is invalid, or a format requires an unknown up direction or floor height.
    """
    formats, chosen = list(dict.fromkeys(formats)), chosen or Chosen()
    if ExportFormat.USD in formats:
        check_usd()
    directory = run / "export" if out is None else out
    predictions = [one for one in formats if one in PREDICTIONS]
    if predictions and chosen.objects:
        raise ConfigError(
            f"objects: expected no selection for {predictions[0].value}, which contains all instances, got "
            f"{', '.join(chosen.objects)}; export it separately"
        )
    written = _write_predictions(run, predictions, directory, chosen) if predictions else []
    formats = [one for one in formats if one not in PREDICTIONS]
    if not formats:
        return written
    room = read_room(run, up, floor)
    _check_known(run, room, formats)
    room = room.chosen(chosen.objects, chosen.min_probability)
    directory.mkdir(parents=True, exist_ok=True)
    for comment in origin_comments(room.origin):
        log.info("%s", comment)
    if surfaces := [one for one in formats if one in MESHES]:
        written += _write_surfaces(room, surfaces, directory, chosen)
    others = [one for one in formats if one not in MESHES]
    found = plan(room, chosen.resolution, chosen.robot_height) if others and room.floor_known else None
    if ExportFormat.FLOORPLAN in others and found is not None:
        write_floor_plan(directory / "floor_plan.png", room, found, chosen.robot_height)
        write_geojson(directory / "floor_plan.geojson", room)
        written += [
            directory / "floor_plan.png",
            directory / "floor_plan.geojson",
            *write_ros_map(directory, found, room),
        ]
    if ExportFormat.GRAPH in others:
        write_scene_graph(directory / "scene_graph.json", room, found)
        written.append(directory / "scene_graph.json")
    return written


def _write_predictions(run: Path, formats: Sequence[ExportFormat], directory: Path, chosen: Chosen) -> list[Path]:
    points = None if chosen.points is None else Path(chosen.points)
    found = BenchmarkPredictions.of(run, chosen.label_space, points)
    write = {ExportFormat.SCANNET: found.write_scannet, ExportFormat.NPZ: found.write_npz}
    return [path for one in formats for path in write[one](directory)]


def _check_known(run: Path, room: UprightRoom, formats: Sequence[ExportFormat]) -> None:
    """Check that the up direction and floor height are known if a format requires them."""
    flat = [one.value for one in formats if one not in MESHES]
    if not room.up_known and flat:
        raise DataError(f"{run}: expected an up direction for {flat[0]}, got none; set --up X Y Z --floor M")
    if not room.up_known:
        log.warning("%s: expected an up direction, got none; using the world's z axis; set --up X Y Z", run)
    elif not room.floor_known and ExportFormat.FLOORPLAN in formats:
        raise DataError(f"{run}: expected a floor height for floorplan, got none; set --floor M")
    elif not room.floor_known and ExportFormat.GRAPH in formats:
        log.warning("%s: expected a floor height, got none; omitting floor, walls and rooms; set --floor M", run)


def _write_surfaces(room: UprightRoom, formats: Sequence[ExportFormat], directory: Path, chosen: Chosen) -> list[Path]:
    """Write one file per object and format, and the whole scene if no objects are selected."""
    files: dict[str, list[Part]] = {}
    if not chosen.objects:
        if not len(room.mesh.triangles):
            raise DataError("map: expected a surface to export, got an empty map")
        files["scene"] = parts(room, chosen.triangles)
    files |= {f"objects/{part.name}": [part.alone] for part in object_parts(room, chosen.triangles)}
    written = []
    for kind in formats:
        for name, shown in files.items():
            path = directory / f"{name}{MESHES[kind]}"
            path.parent.mkdir(exist_ok=True)
            _write_parts(path, kind, shown, chosen, origin_comments(room.origin))
            written.append(path)
    return written


def _write_parts(
    path: Path, kind: ExportFormat, shown: Sequence[Part], chosen: Chosen, comments: Sequence[str]
) -> None:
    if kind is ExportFormat.USD:
        write_usd(path, shown, chosen.coloring, chosen.collision, comments)
    elif kind is ExportFormat.GLB:
        with atomic_write(path) as temporary:
            temporary.write_bytes(glb(shown, chosen.coloring, comments))
    elif kind is ExportFormat.OBJ:
        with atomic_write(path) as temporary:
            header = "".join(f"# {comment}\n" for comment in comments)
            temporary.write_text(header + _obj(_placed(shown, chosen.coloring)))
    else:
        write_mesh(path, joined(list(_placed(shown, chosen.coloring).values())), comments)


def _placed(shown: Sequence[Part], coloring: Coloring) -> dict[str, InstanceMesh]:
    """Return the colored meshes of the parts by name, in the room frame."""
    meshes = {}
    for part, colors in zip(shown, part_colors(shown, coloring), strict=True):
        vertices = transform(part.T_room_part, part.mesh.vertices.astype(np.float64)).astype(np.float32)
        meshes[part.name] = replace(part.mesh, vertices=vertices, colors=colors)
    return meshes


def _obj(meshes: Mapping[str, InstanceMesh]) -> str:
    """Return the content of an OBJ file with named meshes and vertex colors."""
    scene = trimesh.Scene()
    for name, mesh in meshes.items():
        if len(mesh.triangles):
            shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, vertex_colors=mesh.colors, process=False)
            scene.add_geometry(shape, name, name)
    export_obj: Callable[..., str] = trimesh.exchange.obj.export_obj
    text = export_obj(scene, include_normals=False, digits=OBJ_DIGITS, header=None)
    return f"# InstanceMap; meters, z up; vertices with colors: x y z r g b\n{text}\n"
