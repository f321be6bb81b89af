"""A small run with ground-truth instances, for the tests of reports."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from omegaconf import OmegaConf

from framework.commands.running.run import run
from framework.config import composition
from framework.files.manifest import MANIFEST
from framework.runs.provenance import config_hash
from tests.support.small_overviews import use_small_overviews

FAKES = Path(__file__).resolve().parent / "fake_conf"
CONFIG: dict[str, Any] = {
    "seed": 0,
    "device": "cpu",
    "threads": 0,
    "prefetch": 0,
    "detection_interval": 1,
    "detection_cache": "off",
    "dataset": {"_target_": "tests.support.scenes.corner_room.CornerRoom", "frames": 6},
    "detector": {"_target_": "tests.support.scenes.corner_room.SphereDetector"},
    "masking": {"_target_": "plugins.masking.none.NoMasking"},
    "tracker": {"_target_": "tests.support.scenes.corner_room.GivenPose"},
    "refiner": {"_target_": "tests.support.scenes.corner_room.KeepAll"},
    "fuser": {"_target_": "plugins.fusers.bayesian_tsdf.BayesianTsdf", "voxel_size": 0.03, "min_observations": 2},
    "backend": {"_target_": "plugins.backends.none.NoBackEnd"},
    "viewer": {"_target_": "plugins.viewers.none.NoViewer"},
}


def write_run(directory: Path, **dataset: Any) -> Path:
    """Map the corner room with its spheres and return the run directory."""
    config = CONFIG | {"dataset": CONFIG["dataset"] | dataset}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [FAKES])
        use_small_overviews(patched)
        run(OmegaConf.create(config), directory, {})
    return directory


def unverified_copy(directory: Path, copy: Path) -> Path:
    """Copy a run directory without the manifest, so that a test can change its files."""
    return Path(shutil.copytree(directory, copy, ignore=shutil.ignore_patterns(MANIFEST)))


def store_parameter(directory: Path, key: str, value: object) -> None:
    """Change a parameter in config.yaml, and the hash of the config in metrics.json."""
    group, name = key.split(".")
    config = yaml.safe_load((directory / "config.yaml").read_text())
    config[group][name] = value
    (directory / "config.yaml").write_text(yaml.safe_dump(config))
    metrics = json.loads((directory / "metrics.json").read_text())
    (directory / "metrics.json").write_text(json.dumps(metrics | {"config_hash": config_hash(config)}))


def rename_class(directory: Path, name: str) -> None:
    """Rename the class of the first object, for example to HTML code."""
    path = directory / "instances.json"
    entries = json.loads(path.read_text())
    entries[0]["class"] = name
    entries[0]["class_probabilities"] = {name: 0.9, "sphere": 0.1}
    path.write_text(json.dumps(entries))
