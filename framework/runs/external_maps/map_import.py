"""Import of the map of another system: from its files to a run directory."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from framework.data import Float64
from framework.errors import ConfigError
from framework.evaluation.compared_classes import OF_DATASET
from framework.files.folders.restartable_folder import check_startable, restartable_folder
from framework.files.manifest import MANIFEST, RUN_FILES
from framework.runs.external_maps.conversion import ConvertedMap, MapPlacement, read_transform
from framework.runs.external_maps.imported_run import ImportOption, MappedData, write_imported_run
from framework.runs.external_maps.map_formats import read_external_map
from framework.runs.external_maps.ply_instances import LabelProperties
from framework.vocabulary.label_spaces import ClassNames

COMMAND = "import-map"
OWN_FILES = re.compile("|".join(map(re.escape, (*RUN_FILES, MANIFEST))))


@dataclass(frozen=True)
class ImportSummary:
    """The result of an import, for the user."""

    source: str  # format and origin of the labels
    remarks: tuple[str, ...]  # changes and assumptions, such as the number of instances that are left out
    title: str  # the main metrics


@dataclass(frozen=True)
class MapImport:
    """The files of a map, and the options of its import."""

    mesh: Path  # PLY file, or points (V, 3) in an NPY file
    labels: Path | None = None  # file or folder with labels; None = properties of the mesh
    label_space: str | None = None  # names of class ids; None = NYU40 for ScanNet predictions, otherwise none
    class_names: ClassNames = ClassNames.AUTO
    properties: LabelProperties = field(default_factory=LabelProperties)
    scale: float = 1.0  # meters per unit of the mesh, > 0
    # T_world_map, applied after the scale: (4, 4), or a text file with four lines of four numbers; None = identity
    transform: Path | Float64 | None = None
    up: Sequence[float] | None = None  # up direction (3,) in the world frame; None = unknown

    def write(self, directory: Path, name: str | None, overrides: Sequence[str]) -> ImportSummary:
        """Write the run directory of the map.

        Args:
            directory: The new run directory.
            name: Name of the row in tables; None = name of the directory.
            overrides: Overrides of the dataset and the seed.

        Raises:
            ConfigError: The directory is not empty, or an option is invalid.
            DataError: A file is missing or invalid.
        """
        check_startable(directory, COMMAND)
        placement = MapPlacement(self.scale, self._T_world_map(), None if self.up is None else unit_vector(self.up))
        data = MappedData.of(overrides)
        external = read_external_map(self.mesh, self.labels, self.label_space, self.properties)
        class_names = self.class_names
        if class_names is ClassNames.AUTO and data.classes.label_space not in OF_DATASET:
            class_names = ClassNames.OWN  # the evaluation converts the names
        converted = ConvertedMap.of(external, placement, class_names)
        row = name or directory.resolve().name
        options = self.chosen_options()
        with restartable_folder(directory, COMMAND, OWN_FILES):
            title = write_imported_run(directory, row, converted, data, placement.up, options, external.masks)
        compared = () if data.dataset else ("no dataset: import the map again with dataset=NAME to evaluate it",)
        return ImportSummary(external.source, (*converted.remarks, *compared), title)

    def chosen_options(self) -> Mapping[str, ImportOption]:
        """Return the options that differ from their defaults, by name. The up direction is part of the metrics."""
        space = self.label_space
        chosen: dict[str, ImportOption] = {
            "labels": self.labels,
            "label_space": Path(space) if space is not None and Path(space).is_file() else space,  # files are hashed
            "class_names": None if self.class_names is ClassNames.AUTO else self.class_names.name,
            "instance_property": self.properties.instance,
            "class_property": self.properties.class_,
            "no_instance": self.properties.no_instance or None,
            "scale": None if self.scale == 1 else self.scale,
            "transform": str(self.transform.tolist()) if isinstance(self.transform, np.ndarray) else self.transform,
        }
        return {"mesh": self.mesh} | {key: value for key, value in chosen.items() if value is not None}

    def _T_world_map(self) -> Float64:
        if self.transform is None:
            return np.eye(4)
        return read_transform(self.transform) if isinstance(self.transform, Path) else self.transform


def unit_vector(up: Sequence[float]) -> Float64:
    """Return an up direction (3,) as a unit vector.

    Raises:
        ConfigError: The direction is zero or not finite.
    """
    vector = np.array(up, np.float64)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0 < length < np.inf:
        raise ConfigError(f"up: expected a nonzero direction of 3 finite numbers, got {list(up)}")
    return vector / length
