"""Comparison of the results in two folders of run directories, for changes that must not affect results.

    python -m tests.same_results BEFORE AFTER

Runs with the same path below BEFORE and AFTER are compared byte by byte: their files, the arrays in NPZ files, the
metrics and the config. Metrics that depend on the machine or on the code version are ignored. Keys that only one of the
two configs has are listed and not compared. The exit status is 1 if a run differs.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from framework.config.renamed_keys import replace_in_config
from framework.runs.provenance import WITHOUT_EFFECT, leaves

FILES = ("mesh.ply", "trajectory.txt", "instances.json")
ARRAY_FILES = ("map.npz", "keyframes.npz")
NOT_RESULTS = (
    "fps",
    "stage_ms.",
    "peak_rss",
    "environment.",
    "git_",
    "config_hash",
    "detection_interval",
    "inputs_sha256",
    "time.",
    "code",
)


def results(directory: Path) -> dict[str, object]:
    """Return the results of a run, keyed by file, array or metric."""
    found: dict[str, object] = {name: (directory / name).read_bytes() for name in FILES if (directory / name).exists()}
    for name in ARRAY_FILES:
        if (directory / name).exists():
            with np.load(directory / name) as arrays:
                found |= {
                    f"{name}: {key}": (str(arrays[key].dtype), arrays[key].shape, arrays[key].tobytes())
                    for key in arrays.files
                }
    metrics = json.loads((directory / "metrics.json").read_text())
    return found | {key: value for key, value in metrics.items() if not key.startswith(NOT_RESULTS)}


def settings(directory: Path) -> dict[str, object]:
    """Return the values of a config, keyed by dotted key."""
    config: Any = OmegaConf.to_container(OmegaConf.load(directory / "config.yaml"))
    named = leaves(replace_in_config(config))
    return {key: value for key, value in named if key.partition(".")[0] not in WITHOUT_EFFECT}


def main() -> None:
    before, after = map(Path, sys.argv[1:3])
    runs = sorted(path.parent.relative_to(before) for path in before.rglob("metrics.json"))
    differing = 0
    for run in runs:
        if not (after / run / "metrics.json").exists():
            print(f"{run}: missing in {after}")
            differing += 1
            continue
        old, new = results(before / run), results(after / run)
        print(f"{run}: {len(old.keys() | new.keys())} files, arrays and metrics")
        old_settings, new_settings = settings(before / run), settings(after / run)
        if one_sided := sorted(old_settings.keys() ^ new_settings.keys()):
            print(f"{run}: not compared, only in one config: {', '.join(one_sided)}")
        for key in old_settings.keys() & new_settings.keys():
            old[f"config.yaml: {key}"], new[f"config.yaml: {key}"] = old_settings[key], new_settings[key]
        changed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
        for key in changed:
            values = [found.get(key) for found in (old, new)]
            shown = ["bytes" if isinstance(value, (bytes, tuple)) else repr(value) for value in values]
            print(f"{run}: {key}: {shown[0]} -> {shown[1]}")
        differing += bool(changed)
    print(f"{len(runs) - differing} of {len(runs)} runs are the same")
    sys.exit(differing > 0 or not runs)


if __name__ == "__main__":
    main()
