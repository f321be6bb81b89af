"""`instancemap import-map MESH DIR`: convert the map of another system to a run directory."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from framework.commands.command_line import arguments, one_line_errors
from framework.vocabulary.label_spaces import ClassNames

if TYPE_CHECKING:
    from framework.runs.external_maps.map_import import MapImport


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
    data = "overrides: dataset=NAME, dataset.KEY=VALUE, evaluation.KEY=VALUE, seed=N; default: no dataset"
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
    names = (
        "class names of the map: COCO (other classes are left out), OWN (the given names), or AUTO (OWN if a name is "
        "in no known label space, if none has a COCO class, or if evaluation.label_space is not COCO; otherwise COCO); "
        "default: AUTO"
    )
    add("--class-names", choices=[*ClassNames.__members__], default=ClassNames.AUTO.name, help=names)
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
        found = map_import(parsed).write(parsed.directory, parsed.name, parsed.overrides)
        print("\n".join([found.source, *found.remarks, found.title, str(parsed.directory)]))


def map_import(parsed: argparse.Namespace) -> MapImport:
    """Return the import with the arguments of the command."""
    from framework.runs.external_maps.map_import import MapImport  # slow import: after the arguments are checked
    from framework.runs.external_maps.ply_instances import LabelProperties

    return MapImport(
        mesh=parsed.mesh,
        labels=parsed.labels,
        label_space=parsed.label_space,
        class_names=ClassNames[parsed.class_names],
        properties=LabelProperties(parsed.instance_property, parsed.class_property, parsed.no_instance),
        scale=parsed.scale,
        transform=parsed.transform,
        up=parsed.up,
    )
