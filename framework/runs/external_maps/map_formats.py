"""Detection of the format of a map from another system."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from framework.runs.external_maps.class_labels import ClassIdNames, read_labels_by_id
from framework.runs.external_maps.external_map import ExternalMap, read_surface
from framework.runs.external_maps.mask_predictions import read_mask_predictions
from framework.runs.external_maps.ply_instances import LabelProperties, read_ply_instances
from framework.runs.mesh_file import listed_classes


def read_external_map(
    mesh: Path, labels: Path | None, label_space: str | None, properties: LabelProperties
) -> ExternalMap:
    """Read the map of another system. The format of the labels is detected.

    Args:
        mesh: The mesh or point cloud.
        labels: The file or folder with the labels; None = properties of the mesh.
        label_space: The label space of class ids, or its file; None = NYU40 for ScanNet predictions, and the classes in
            the header of a mesh.ply of InstanceMap.
        properties: The names of the properties of the mesh.

    Raises:
        ConfigError: The label space does not exist.
        DataError: A file is missing or invalid, or the files do not match.
    """
    surface = read_surface(mesh)
    names = None if label_space is None else ClassIdNames.of(label_space)
    if labels is not None and (labels.is_dir() or labels.suffix.lower() == ".txt"):
        return read_mask_predictions(mesh, surface, labels, names)
    in_header = listed_classes(surface.comments)  # None = not a mesh.ply of InstanceMap
    if in_header:
        names = names or ClassIdNames(dict(enumerate(in_header)), str(mesh))
    elif in_header == () and properties.class_ is None:
        properties = replace(properties, class_="")
    by_id = None if labels is None else read_labels_by_id(labels, names)
    return read_ply_instances(mesh, surface, properties, names, by_id)
