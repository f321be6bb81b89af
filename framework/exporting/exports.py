"""A run's exports: which files there are, and what is in each."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from framework.config.validation import require
from framework.errors import ConfigError, DataError
from framework.exporting.floor_plan import write_floor_plan
from framework.exporting.geojson import write_geojson
from framework.exporting.glb import glb
from framework.exporting.mesh_files import write_parts_obj, write_parts_ply
from framework.exporting.object_meshes import Coloring, Part, object_parts, parts
from framework.exporting.occupancy import plan, write_ros_map
from framework.exporting.scene_graph import write_scene_graph
from framework.exporting.upright_room import UprightRoom, read_room
from framework.exporting.usd import Collision, check_usd, write_usd
from framework.files.atomic_write import written_whole
from framework.runs.run_directory import LIKELY

log = logging.getLogger(__name__)


class ExportFormat(Enum):
    """What a run is exported to."""

    GLB = "glb"
    PLY = "ply"
    USD = "usd"
    OBJ = "obj"
    FLOORPLAN = "floorplan"
    GRAPH = "graph"


MESHES = {ExportFormat.GLB: ".glb", ExportFormat.PLY: ".ply", ExportFormat.USD: ".usdc", ExportFormat.OBJ: ".obj"}
"""Formats of surfaces, and how the names of their files end."""


@dataclass(frozen=True)
class Chosen:
    """What of a room is exported, and how."""

    objects: Sequence[str] = ()  # ids or classes; () = the whole room
    min_confidence: float = LIKELY  # in [0, 1]; LIKELY = what pictures show
    triangles: int | None = None  # >= 4, of the scene and of each object's own file; None = as many as there are
    coloring: Coloring = Coloring.APPEARANCE
    collision: Collision = Collision.HULL
    resolution: float = 0.05  # m, in [0.01, 1], of a plan's cells
    robot_height: float = 1.0  # m, in [0.1, 3], of the robot that a place is free for

    def __post_init__(self) -> None:
        for name, low, high in (("min_confidence", 0.0, 1.0), ("resolution", 0.01, 1.0), ("robot_height", 0.1, 3.0)):
            value = getattr(self, name)
            require(low <= value <= high, name, value, f"in [{low:g}, {high:g}]")
        if self.triangles is not None and self.triangles < 4:
            raise DataError(f"triangles must be at least 4, found {self.triangles}")

    @classmethod
    def named(cls, objects: Sequence[str | int] = (), **choices: Any) -> Chosen:
        """The same with words for what is one of several: `coloring="class"`. Raises ConfigError for others."""
        for name, kind in (("coloring", Coloring), ("collision", Collision)):
            if name in choices:
                choices[name] = one_of(kind, name, choices[name])
        if unknown := choices.keys() - {field.name for field in fields(cls)}:
            raise ConfigError(f"export has no choice {min(unknown)!r}; it has {', '.join(f.name for f in fields(cls))}")
        return cls(tuple(map(str, objects)), **choices)


Option = TypeVar("Option", bound=Enum)


def one_of(kind: type[Option], name: str, value: object) -> Option:
    """The member with this value. Raises ConfigError, which lists them, where there is none."""
    found = next((option for option in kind if option.value == value), None)
    if found is None:
        raise ConfigError(f"{name} must be one of {', '.join(option.value for option in kind)}, found {value!r:.60}")
    return found


def export(
    run: Path,
    formats: Iterable[ExportFormat],
    out: Path | None = None,
    chosen: Chosen | None = None,
    up: Sequence[float] | None = None,
    floor: float | None = None,
) -> list[Path]:
    """Writes what a run found in other programs' formats, into `out`, None = `export` in the run's directory.

    Returns the files, each written whole or not at all; the same run gives the same bytes. `up` (3,) and `floor`, m
    along up, say what the run's record does not tell. Raises DataError where there is no run, or not what is asked for.
    """
    formats, chosen = list(dict.fromkeys(formats)), chosen or Chosen()
    if ExportFormat.USD in formats:
        check_usd()
    room = read_room(run, up, floor)
    _check_known(run, room, formats)
    room = room.chosen(chosen.objects, chosen.min_confidence)
    directory = run / "export" if out is None else out
    directory.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    surfaces = [one for one in formats if one in MESHES]
    if surfaces:
        written += _write_surfaces(room, surfaces, directory, chosen)
    asked = [one for one in formats if one not in MESHES]
    found = plan(room, chosen.resolution, chosen.robot_height) if asked and room.floor_known else None
    if ExportFormat.FLOORPLAN in asked and found is not None:
        write_floor_plan(directory / "floor_plan.png", room, found, chosen.robot_height)
        write_geojson(directory / "floor_plan.geojson", room)
        written += [directory / "floor_plan.png", directory / "floor_plan.geojson", *write_ros_map(directory, found)]
    if ExportFormat.GRAPH in asked:
        write_scene_graph(directory / "scene_graph.json", room, found)
        written.append(directory / "scene_graph.json")
    return written


def _check_known(run: Path, room: UprightRoom, formats: Sequence[ExportFormat]) -> None:
    """Raises DataError where a run does not tell what a format needs; surfaces do without."""
    flat = [one.value for one in formats if one not in MESHES]
    if not room.up_known and flat:
        raise DataError(f"{run} does not tell which way is up, which {flat[0]} needs: --up X Y Z --floor M say it")
    if not room.up_known:
        log.warning("%s does not tell which way is up: the world's z is taken for it; --up X Y Z says another", run)
    elif not room.floor_known and ExportFormat.FLOORPLAN in formats:
        raise DataError(f"{run} does not tell how high the floor is, which floorplan needs: --floor M says it")
    elif not room.floor_known and ExportFormat.GRAPH in formats:
        log.warning("%s does not tell how high the floor is: the graph is without floor, walls and rooms", run)


def _write_surfaces(room: UprightRoom, formats: Sequence[ExportFormat], directory: Path, chosen: Chosen) -> list[Path]:
    """The scene, unless some objects only are asked for, and each object by itself."""
    files: list[tuple[str, list[Part]]] = []
    if not chosen.objects:
        if not len(room.mesh.triangles):
            raise DataError("nothing was mapped: there is no surface to export")
        files.append(("scene", parts(room, chosen.triangles)))
    files += [(f"objects/{part.name}", [part.alone]) for part in object_parts(room, chosen.triangles)]
    written = []
    for kind in formats:
        write = _writer(kind, chosen)
        for name, shown in files:
            path = directory / f"{name}{MESHES[kind]}"
            path.parent.mkdir(exist_ok=True)
            write(path, shown)
            written.append(path)
    return written


def _writer(kind: ExportFormat, chosen: Chosen) -> Callable[[Path, Sequence[Part]], None]:
    if kind is ExportFormat.PLY:
        return lambda path, shown: write_parts_ply(path, shown, chosen.coloring)
    if kind is ExportFormat.OBJ:
        return lambda path, shown: write_parts_obj(path, shown, chosen.coloring)
    if kind is ExportFormat.USD:
        return lambda path, shown: write_usd(path, shown, chosen.coloring, chosen.collision)
    return lambda path, shown: _write_glb(path, shown, chosen.coloring)


def _write_glb(path: Path, shown: Sequence[Part], coloring: Coloring) -> None:
    with written_whole(path) as temporary:
        temporary.write_bytes(glb(shown, coloring))
