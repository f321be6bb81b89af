"""`instancemap import-map MESH DIR`: convert the map of another system to a run directory."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from framework.commands.command_line import arguments, one_line_errors
from framework.data import Float64
from framework.errors import ConfigError

if TYPE_CHECKING:
    from framework.importing.maps.external_map import ExternalMap

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
    from framework.importing.maps.conversion import ConvertedMap, Placement, read_transform
    from framework.runs.imported_run import MappedData, write_imported_run

    check_new(parsed.directory)
    T_world_map = np.eye(4) if parsed.transform is None else read_transform(parsed.transform)
    placement = Placement(parsed.scale, T_world_map, None if parsed.up is None else unit_vector("--up", parsed.up))
    data = MappedData.of(parsed.overrides)
    external = read_external_map(parsed)
    converted = ConvertedMap.of(external, placement)
    name = parsed.name or parsed.directory.resolve().name
    title = write_imported_run(parsed.directory, name, converted, data, placement.up, chosen_options(parsed))
    compared = [] if data.config else ["no dataset: import the map again with dataset=NAME to evaluate it"]
    return [external.source, *converted.remarks, *compared, title, str(parsed.directory)]


def read_external_map(parsed: argparse.Namespace) -> ExternalMap:
    """Read the map of another system. The format of --labels is detected.

    Raises:
        InstanceMapError: A file or option is invalid.
    """
    from framework.importing.maps.class_labels import ClassNames, read_labels_by_id
    from framework.importing.maps.external_map import read_surface
    from framework.importing.maps.mask_predictions import read_mask_predictions
    from framework.importing.maps.ply_instances import LabelProperties, read_ply_instances
    from framework.runs.mesh_file import listed_classes

    surface = read_surface(parsed.mesh)
    names = None if parsed.label_space is None else ClassNames.of(parsed.label_space)
    labels: Path | None = parsed.labels
    if labels is not None and (labels.is_dir() or labels.suffix.lower() == ".txt"):
        return read_mask_predictions(parsed.mesh, surface, labels, names)
    if names is None and (in_header := listed_classes(surface.comments)):  # a mesh.ply of InstanceMap
        names = ClassNames(dict(enumerate(in_header[0])), str(parsed.mesh))
    properties = LabelProperties(parsed.instance_property, parsed.class_property, parsed.no_instance)
    by_id = None if labels is None else read_labels_by_id(labels, names)
    return read_ply_instances(parsed.mesh, surface, properties, names, by_id)


def chosen_options(parsed: argparse.Namespace) -> Mapping[str, Path | str | float | None]:
    """Return the import options that differ from their defaults, by name."""
    chosen = {name: getattr(parsed, name) for name in IMPORT_OPTIONS}
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
