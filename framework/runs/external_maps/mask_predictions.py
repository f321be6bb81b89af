"""Instance masks over the points of a map: ScanNet predictions and mask folders.

ScanNet predictions have a text file with one line for each instance: the mask file, relative to the text file, the
class id and the confidence. A mask file has one number for each vertex of the mesh, nonzero = part of the instance.

    predictions/scene0000_00.txt          predicted_masks/scene0000_00_000.txt 5 0.93
    predictions/predicted_masks/scene0000_00_000.txt

A mask folder has a JSON or CSV file with the mask, the class and the confidence of each instance:

    masks/instances.json                  [{"mask": "0.npy", "class": "chair", "confidence": 0.93}]
    masks/instances.csv                   mask,class,confidence
    masks/0.npy                           Booleans (V,) or indices (M,) of the points; text files as for ScanNet
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from framework.errors import DataError
from framework.files.atomic_write import path_exists
from framework.files.number_lines import read_lines
from framework.files.ply import PlyMesh
from framework.runs.external_maps.array_files import read_mask
from framework.runs.external_maps.class_labels import (
    NYU40,
    ClassIdNames,
    InstanceLabel,
    class_of_id,
    label_of,
    read_entries,
)
from framework.runs.external_maps.class_labels import checked_confidence as confidence_of
from framework.runs.external_maps.external_map import ExternalInstance, ExternalMap

LISTS = ("instances.json", "instances.csv")  # names of the file with the classes of a mask folder


def read_mask_predictions(mesh: Path, surface: PlyMesh, labels: Path, names: ClassIdNames | None) -> ExternalMap:
    """Return the map with the instances of ScanNet predictions or a mask folder.

    Instances have the ids 1, 2, ... in the order of the list. Empty masks are left out.

    Args:
        mesh: The mesh or point cloud. Of the ScanNet predictions of several scenes, its name selects the scene.
        surface: The content of the mesh.
        labels: The text file of a scene, the folder of such files, or a mask folder.
        names: The names of the class ids; None = NYU40 for ScanNet predictions.

    Raises:
        DataError: A file is missing or invalid, or does not match the mesh.
        ConfigError: The label space of ScanNet predictions is unavailable.
    """
    listed = next((labels / name for name in LISTS if path_exists(labels / name)), None)
    if listed is None:
        listed = _text_file(mesh, labels)
        names = names or ClassIdNames.of(NYU40)
        entries = list(_scannet_entries(listed, names))
    else:
        entries = list(_folder_entries(listed, names))
    if not entries:
        raise DataError(f"{listed}: expected at least one instance, got none")
    instances = {}
    masks = [_inside(where, listed.parent, mask) for where, mask, _ in entries]
    for key, (mask, (_, _, label)) in enumerate(zip(masks, entries, strict=True), start=1):
        vertices = read_mask(mask, len(surface.vertices))
        if len(vertices):
            instances[key] = ExternalInstance(vertices, label.name, label.confidence)
    source = f"instances: {len(entries)} masks in {listed}"
    space = () if names is None else names.all
    return ExternalMap(surface, instances, source, space, () if labels.is_dir() else tuple(masks))


def _text_file(mesh: Path, labels: Path) -> Path:
    """Return the text file with the predictions of the scene of a mesh."""
    if not labels.is_dir():
        return labels
    files = sorted(labels.glob("*.txt"))
    of_scene = [file for file in files if mesh.stem == file.stem or mesh.stem.startswith(f"{file.stem}_")]
    found = of_scene or files
    if len(found) != 1:
        names = ", ".join(file.name for file in found[:5]) or "none"
        raise DataError(
            f"{labels}: expected {LISTS[0]}, {LISTS[1]}, or the ScanNet predictions {mesh.stem}.txt, got {names}; set "
            "labels to the file of the scene"
        )
    return found[0]


def _scannet_entries(path: Path, names: ClassIdNames) -> Iterator[tuple[str, str, InstanceLabel]]:
    for number, line in enumerate(read_lines(path), start=1):
        words = line.split()
        if not words:
            continue
        where = f"{path}, line {number}"
        try:
            mask, class_id, confidence = words[0], int(words[1]), words[2]
        except (ValueError, IndexError) as error:
            raise DataError(f"{where}: expected MASK_FILE CLASS_ID CONFIDENCE, got {line!r:.60}") from error
        yield where, mask, InstanceLabel(class_of_id(where, class_id, names), confidence_of(where, confidence))


def _folder_entries(path: Path, names: ClassIdNames | None) -> Iterator[tuple[str, str, InstanceLabel]]:
    for where, entry in read_entries(path):
        mask = entry.get("mask")
        if not isinstance(mask, str) or not mask:
            raise DataError(f"{where}: mask: expected the name of a mask file, got {mask!r:.40}")
        yield where, mask, label_of(where, entry, names)


def _inside(where: str, folder: Path, name: str) -> Path:
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DataError(f"{where}: expected a mask file below {folder}, got {name!r:.60}")
    return path
