"""`instancemap import-map MESH DIR`: convert the map of another system to a run directory."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from framework.commands.command_line import arguments, one_line_errors
from framework.data import Float64
from framework.errors import ConfigError

IMPORT_OPTIONS = ("labels", "label_space", "instance_property", "class_property", "no_instance", "scale", "transform")


def main() -> None:
    """Run the command `instancemap import-map`."""
    parser = argparse.ArgumentParser(
        description="Convert the map of another system to a run directory for evaluate, tables, report, diff and "
        "export. The map must be in the world frame of the ground truth of the dataset. Run times, a trajectory and "
        "map.npz are not created."
    )
    add = parser.add_argument
    add("mesh", metavar="MESH", type=Path, help="mesh or point cloud: a PLY file, or points (V, 3) in an NPY file")
    add("directory", metavar="DIR", type=Path, help="output run directory; must be new or empty")
    data = "dataset to compare with: dataset=NAME, dataset.KEY=VALUE, seed=N; default: no dataset"
    add("overrides", metavar="KEY=VALUE", nargs="*", help=data)
    add("--name", metavar="NAME", help="name of the row in tables; default: name of DIR")
    labels = (
        "labels: JSON or CSV file with the class and confidence of each instance id of MESH, ScanNet predictions "
        "(text file or its folder), or mask folder; default: properties of MESH"
    )
    add("--labels", metavar="PATH", type=Path, help=labels)
    space = (
        "names of class ids: a label space such as nyu40, a text file with one name per line (from id 0), or a JSON "
        "file with the name of each id; default: nyu40 for ScanNet predictions, otherwise none"
    )
    add("--label-space", metavar="SPACE", help=space)
    add = parser.add_argument_group("properties of a PLY file").add_argument
    add("--instance-property", metavar="NAME", help="property with instance ids; default: detected by name")
    kinds = "property with class ids; '' = no classes; default: detected by name"
    add("--class-property", metavar="NAME", help=kinds)
    add("--no-instance", metavar="ID", type=int, default=0, help="id of points without an instance; default: 0")
    add = parser.add_argument_group("world frame").add_argument
    add("--scale", metavar="S", type=float, default=1.0, help="meters per unit of MESH, > 0; default: 1")
    transform = "T_world_map, applied after --scale: text file with 4 lines of 4 numbers; default: identity"
    add("--transform", metavar="FILE", type=Path, help=transform)
    up = "up direction in the world frame; default: unknown (views use the z axis)"
    add("--up", metavar=("X", "Y", "Z"), nargs=3, type=float, help=up)
    parsed = arguments(parser)
    with one_line_errors():
        for line in import_map(parsed):
            print(line)


def import_map(parsed: argparse.Namespace) -> list[str]:
    """Convert a map and write its run directory.

    Args:
        parsed: The arguments of the command.

    Returns:
        The lines of the output.

    Raises:
        InstanceMapError: A file or option is invalid.
    """
    from framework.importing.folder_writer import check_new  # slow imports: after the arguments are checked
    from framework.runs.external_maps.conversion import ConvertedMap, MapPlacement, read_transform
    from framework.runs.external_maps.imported_run import MappedData, write_imported_run
    from framework.runs.external_maps.map_formats import read_external_map
    from framework.runs.external_maps.ply_instances import LabelProperties

    check_new(parsed.directory)
    T_world_map = np.eye(4) if parsed.transform is None else read_transform(parsed.transform)
    placement = MapPlacement(parsed.scale, T_world_map, None if parsed.up is None else unit_vector("--up", parsed.up))
    data = MappedData.of(parsed.overrides)
    properties = LabelProperties(parsed.instance_property, parsed.class_property, parsed.no_instance)
    external = read_external_map(parsed.mesh, parsed.labels, parsed.label_space, properties)
    converted = ConvertedMap.of(external, placement)
    name = parsed.name or parsed.directory.resolve().name
    title = write_imported_run(parsed.directory, name, converted, data, placement.up, chosen_options(parsed))
    compared = [] if data.dataset else ["no dataset: import the map again with dataset=NAME to evaluate it"]
    return [external.source, *converted.remarks, *compared, title, str(parsed.directory)]


def chosen_options(parsed: argparse.Namespace) -> Mapping[str, Path | str | float | None]:
    """Return the import options that differ from their defaults, by name."""
    chosen = {name: getattr(parsed, name) for name in IMPORT_OPTIONS}
    if parsed.label_space is not None and Path(parsed.label_space).is_file():  # files are hashed
        chosen["label_space"] = Path(parsed.label_space)
    defaults = {"no_instance": 0, "scale": 1.0}
    return {"mesh": parsed.mesh} | {key: value for key, value in chosen.items() if value != defaults.get(key)}


def unit_vector(option: str, values: list[float]) -> Float64:
    """Return a direction (3,) as a unit vector.

    Raises:
        ConfigError: The direction is zero or not finite.
    """
    vector = np.array(values, np.float64)
    length = float(np.linalg.norm(vector))
    if not 0 < length < np.inf:
        raise ConfigError(f"{option}: expected a nonzero direction of finite numbers, got {values}")
    return vector / length
