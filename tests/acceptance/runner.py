"""Acceptance measurements and the page with their latest values, docs/results/acceptance.md."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
PAGE = CHECKOUT / "docs" / "results" / "acceptance.md"
COLUMNS = ("measurement", "value", "bound", "commit, date", "machine")
HEADER = """# Acceptance

Check accuracy, robustness and speed against their bounds:

```console
make acceptance
```

The command runs missing and outdated measurements. A measurement is outdated if its code has changed. All measurements
take about five hours. `make acceptance MEASUREMENT=NAME` runs one of them. Real sequences are read from
`redkitchen`, `replica_floor2`, `scannet_scene0000` and `tum_fr1_rpy_a` in `../shared/data`.

- `building_*`: worst of three buildings with five rooms each, unless stated otherwise
- *oracle*: map from the corrected poses and depth
- `calibration_*`: two Kinect recordings, two rendered scans, two networks, leave-one-scene-out
- `kitchen_*`: redkitchen, 300 frames
- `large_map_*`: 20 copies of redkitchen, 1 cm voxels
- `long_run_*`: 20,000 frames of a synthetic room, 160x120 px, 3 cm voxels
- `person_*`: rendered person, `masking=people`, detection on every frame and on every fifth frame

"""
Measured = tuple[float, bool]  # the value, and whether it is within the bound


@dataclass(frozen=True)
class Measurement:
    """One acceptance criterion."""

    name: str
    bound: str  # as shown on the page, with its unit
    paths: Sequence[str]  # paths of the code that affects the value, relative to the checkout
    measure: Callable[[], Measured]


MEASUREMENTS: dict[str, Measurement] = {}


def measurement(bound: str, *paths: str) -> Callable[[Callable[[], Measured]], Callable[[], Measured]]:
    """Return a decorator that registers a function as an acceptance measurement with the name of the function."""

    def register(measure: Callable[[], Measured]) -> Callable[[], Measured]:
        MEASUREMENTS[measure.__name__] = Measurement(measure.__name__, bound, paths, measure)
        return measure

    return register


def read_rows(page: Path = PAGE) -> dict[str, list[str]]:
    """Return the table cells of each measurement on the page, keyed by the name of the measurement."""
    if not page.exists():
        return {}
    rows = [
        [cell.strip() for cell in text.strip("|").split("|")] for text in page.read_text().splitlines() if "|" in text
    ]
    named = {row[0]: row for row in rows if len(row) == len(COLUMNS)}
    return {name: row for name, row in named.items() if name not in (COLUMNS[0], "---")}


def write_rows(rows: dict[str, list[str]], page: Path = PAGE) -> None:
    """Write the page with these rows."""
    body = "".join(f"|{'|'.join(row)}|\n" for row in (COLUMNS, *(rows[name] for name in sorted(rows))))
    head, _, table = body.partition("\n")
    page.write_text(f"{HEADER}{head}\n|{'---|' * len(COLUMNS)}\n{table}")


def is_current(row: Sequence[str], paths: Sequence[str]) -> bool:
    """Return True if the code at `paths` has not changed since the commit in the row."""
    commit = row[COLUMNS.index("commit, date")].partition(",")[0]
    if commit.endswith("+"):  # measured with uncommitted changes
        return False
    return not _git("diff", "--name-only", commit, "--", *paths, missing="unknown commit")


def measure(chosen: Measurement) -> list[str]:
    """Run a measurement and return its row for the page."""
    commit = commit_of(chosen.paths)
    value, met = chosen.measure()
    shown = f"{value:.4g}" if met else f"{value:.4g} (missed)"
    return [chosen.name, shown, chosen.bound, f"{commit}, {date.today()}", machine()]


def run(names: Sequence[str]) -> bool:
    """Run the named measurements and return True if all meet their bounds.

    Without names, run all measurements that are missing on the page or outdated.
    """
    rows = read_rows()
    outdated = [k for k, known in MEASUREMENTS.items() if k not in rows or not is_current(rows[k], known.paths)]
    for name in names or outdated:
        begin = time.monotonic()
        rows[name] = measure(MEASUREMENTS[name])
        write_rows({known: row for known, row in rows.items() if known in MEASUREMENTS})
        print(" | ".join(rows[name]), f"| {(time.monotonic() - begin) / 60:.1f} minutes", flush=True)
    return not any("(missed)" in rows[name][1] for name in names or rows)


def commit_of(paths: Sequence[str]) -> str:
    """Return the abbreviated commit, followed by + if the code at `paths` has uncommitted changes."""
    return _git("rev-parse", "--short", "HEAD") + "+" * bool(_git("status", "--porcelain", "--", *paths))


def _git(*arguments: str, missing: str = "") -> str:
    done = subprocess.run(["git", "-C", str(CHECKOUT), *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else missing


def machine() -> str:
    """Return the number of cores and the name of the processor."""
    cpu = next((text for text in Path("/proc/cpuinfo").read_text().splitlines() if text.startswith("model name")), "")
    name = re.sub(r"\((R|TM)\)| Processor| CPU", "", cpu.partition(":")[2]).strip()
    return f"{os.cpu_count()} cores, {name or 'unknown processor'}"
