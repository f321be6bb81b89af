"""Writing of a run directory for the map of another system.

The directory contains the mesh, the instances, the overview image, the config of the dataset, the metrics and the
manifest. It has no trajectory, run times or map.npz.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from framework.config.composition import composed_with_choices, config_errors, resolved
from framework.config.text_values import literal
from framework.data import Float64
from framework.errors import ConfigError
from framework.evaluation.compared_classes import ComparedClasses
from framework.evaluation.instances import PredictedInstances
from framework.files.atomic_write import atomic_write
from framework.files.hashing import path_hash
from framework.files.json_file import write_json
from framework.files.manifest import RUN_FILES, Manifest, RunStatus
from framework.interfaces import RGBDVideo
from framework.mapping.gravity import floor_height
from framework.registry import STAGES, build, text_kind
from framework.rendering.overview import write_overview
from framework.runs.external_maps.conversion import ConvertedMap
from framework.runs.inputs import INPUTS, hash_of, input_hashes
from framework.runs.instances_file import NO_CLASS, write_instances
from framework.runs.mesh_file import write_mesh
from framework.runs.metrics import Metrics, class_name, evaluation_metrics
from framework.runs.provenance import code_version, config_hash, parameters_of
from framework.runs.run_directory import headline, likely_labels
from framework.runs.stored_runs import CHOICE, CONFIG, EXTERNAL, INSTANCES, MESH, METRICS
from framework.vocabulary.label_spaces import label_space_of

ImportOption = str | Path | float | None

ORIGIN = "external."  # prefix of the import options in metrics.json and manifest.json
MASKS = f"{ORIGIN}masks"  # key of the hash of listed masks in manifest.json
NO_POSES = np.zeros((0, 4, 4))


@dataclass(frozen=True)
class MappedData:
    """The dataset of the map of another system."""

    dataset: Mapping[str, Any]  # resolved config; empty = unknown dataset
    option: str | None  # chosen option of the config group `dataset`; None = unknown dataset
    seed: int  # seed of the runs that are compared in pairs with the map
    classes: ComparedClasses  # label space of the evaluation

    @classmethod
    def of(cls, overrides: Sequence[str]) -> MappedData:
        """Return the dataset of overrides such as `dataset=rgbd_folder` and `dataset.root=DIR`.

        Raises:
            ConfigError: An override is invalid, or is not an override of the dataset, evaluation or seed.
        """
        keys = [word.partition("=")[0].lstrip("+~") for word in overrides]
        for word, key in zip(overrides, keys, strict=True):
            if "=" not in word or key.partition(".")[0] not in ("dataset", "evaluation", "seed"):
                raise ConfigError(
                    f"import-map: expected dataset=NAME, dataset.KEY=VALUE, evaluation.KEY=VALUE or seed=N, got "
                    f"{word!r:.60}"
                )
        if any(key.startswith("dataset.") for key in keys) and "dataset" not in keys:
            raise ConfigError(f"import-map: expected dataset=NAME, got only {', '.join(overrides)}; add dataset=NAME")
        with config_errors():
            words = literal(overrides, text_kind)
        config, choices = composed_with_choices(*words)
        plain = resolved(config)
        classes = ComparedClasses.of(plain)
        if "dataset" not in keys:
            return cls({}, None, plain["seed"], classes)
        return cls(plain["dataset"], choices["dataset"], plain["seed"], classes)


def write_imported_run(
    directory: Path,
    name: str,
    converted: ConvertedMap,
    data: MappedData,
    up: Float64 | None,
    options: Mapping[str, ImportOption],
    masks: Sequence[Path] = (),
) -> str:
    """Write the run directory of an imported map, and evaluate it if the dataset has ground-truth instances.

    Args:
        directory: The new run directory.
        name: Name of the row in tables.
        converted: The map.
        data: The dataset of the map.
        up: Up direction (3,) in the world frame, a unit vector; None = unknown.
        options: The options of the import by name. The hashes of files are stored.
        masks: Files that the file in the option `labels` lists, which are also hashed.

    Returns:
        The main metrics as one line of text.

    Raises:
        InstanceMapError: The dataset cannot be read, or a file cannot be written.
    """
    config = {"row": name, "seed": data.seed, **({"dataset": dict(data.dataset)} if data.dataset else {})}
    video = build(RGBDVideo, OmegaConf.create(dict(data.dataset))) if data.dataset else None
    given = {f"{ORIGIN}{key}": value for key, value in options.items() if value is not None}
    files = {key: value for key, value in given.items() if isinstance(value, Path)}
    inputs = {**input_hashes(config), **{key: path_hash(path) for key, path in files.items()}}
    if masks:
        inputs[MASKS] = hash_of({str(k): path_hash(path) for k, path in enumerate(masks)})
    found: Metrics = {
        "sequence": name if video is None else video.name,
        f"{CHOICE}dataset": data.option,
        **{f"{CHOICE}{stage}": EXTERNAL for stage in STAGES if stage != "dataset"},
        "pose_source": EXTERNAL,
        **_up_metrics(converted, up),
        "label_space": label_space_of(converted.mesh.classes),
        "instances.count": len(converted.instances),
        **({} if video is None else _evaluation(video, converted, data.classes)),
        "seed": data.seed,
        "config_hash": config_hash(config),
        INPUTS: hash_of(inputs),
        **{key: value if isinstance(value, int | float) else str(value) for key, value in given.items()},
        **code_version(),
    }
    title = headline({**found, "sequence": f"{name} | {found['sequence']}"} if video else found)
    directory.mkdir(parents=True, exist_ok=True)
    with atomic_write(directory / CONFIG) as temporary:
        OmegaConf.save(OmegaConf.create(config), temporary)
    mesh, instances = converted.mesh, converted.instances
    write_mesh(directory / MESH, mesh)
    write_instances(directory / INSTANCES, mesh, instances, mesh.classes)
    write_overview(directory / "overview.png", mesh, likely_labels(instances, mesh.classes), NO_POSES, title, up)
    write_json(directory / METRICS, found)
    parameters = parameters_of(config) | {key: str(value) for key, value in given.items()}
    manifest = Manifest(RunStatus.COMPLETE, {}, inputs, parameters)
    manifest.with_files(directory, RUN_FILES).write(directory)
    return title


def _evaluation(video: RGBDVideo, converted: ConvertedMap, classes: ComparedClasses) -> Metrics:
    """Return the instance metrics of a map in the world frame of the ground truth, {} without ground truth."""
    truth = video.scene_truth()
    if truth is None:
        return {}
    instances = converted.instances
    predictions = PredictedInstances.on_mesh(
        converted.mesh,
        list(instances),
        [one.confidence for one in instances.values()],
        [class_name(one, converted.mesh.classes) or NO_CLASS for one in instances.values()],
    )
    return evaluation_metrics(predictions, truth, truth, video.annotation, classes)


def _up_metrics(converted: ConvertedMap, up: Float64 | None) -> Metrics:
    if up is None:
        return {}
    figures: Metrics = {f"map.up.{axis}": float(value) for axis, value in zip("xyz", up, strict=True)}
    floor = floor_height(converted.mesh.vertices, converted.mesh.triangles, up)
    return figures | {"up_from": "option", "map.floor_m": floor}
