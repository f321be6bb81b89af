"""Whether two folders of run records hold the same results, byte for byte, for changes that must not change any.

    python tests/same_results.py BEFORE AFTER

Compares the runs below both, by their place: the files of the map, of map.npz the arrays, and metrics.json but for what
measures the machine or names the code. Prints what differs; the exit status is 1 where anything does.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

FILES = ("mesh.ply", "trajectory.txt", "instances.json")
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
    """What a run found, by name of the file or key of metrics.json."""
    found: dict[str, object] = {name: (directory / name).read_bytes() for name in FILES if (directory / name).exists()}
    with np.load(directory / "map.npz") as arrays:
        found |= {f"map.npz: {name}": arrays[name].tobytes() for name in arrays.files}
    metrics = json.loads((directory / "metrics.json").read_text())
    return found | {key: value for key, value in metrics.items() if not key.startswith(NOT_RESULTS)}


def main() -> None:
    before, after = map(Path, sys.argv[1:3])
    runs = sorted(path.parent.relative_to(before) for path in before.rglob("metrics.json"))
    differing = 0
    for run in runs:
        if not (after / run / "metrics.json").exists():
            print(f"{run}: not there after")
            differing += 1
            continue
        old, new = results(before / run), results(after / run)
        changed = [key for key in sorted(old.keys() | new.keys()) if old.get(key) != new.get(key)]
        for key in changed:
            values = [found.get(key) for found in (old, new)]
            shown = ["bytes" if isinstance(value, bytes) else repr(value) for value in values]
            print(f"{run}: {key}: {shown[0]} -> {shown[1]}")
        differing += bool(changed)
    print(f"{len(runs) - differing} of {len(runs)} runs are the same")
    sys.exit(differing > 0 or not runs)


if __name__ == "__main__":
    main()
