"""HTML page with a comparison of several runs."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.data import LIKELY
from framework.registry import STAGES
from framework.reporting.charts import RUN_COLORS, RUN_WIDTHS, PlottedPath, stage_rows, top_view
from framework.reporting.map_scene import MapScene
from framework.reporting.markup import page
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import Footage
from framework.reporting.visibility import NOT_CAMERA
from framework.runs.metrics import LABEL_SPACE
from framework.runs.provenance import leaves
from framework.runs.stored_runs import is_number

MAX_MAPS = 6  # maximum number of maps in the page; their total size has the limit of a single map


@dataclass(frozen=True)
class Row:
    """A metric in the comparison table."""

    key: str  # key in metrics.json
    name: str
    unit: str  # "" = none
    digits: int  # number of decimal places
    scale: float = 1.0  # factor from the unit of metrics.json to `unit`
    better: int = 0  # 1 = higher is better, -1 = lower is better


ROWS = (
    Row("frames", "Frames", "", 0),
    Row("frames_lost", "Frames lost", "", 0, better=-1),
    Row("fps", "Frames per second", "/s", 1, better=1),
    Row("instances.count", "Objects", "", 0),
    Row("instances.ap50", "AP50", "", 3, better=1),
    Row("instances.ap25", "AP25", "", 3, better=1),
    Row("instances.ap", "AP", "", 3, better=1),
    Row("instances.ap50_agnostic", "AP50, class-agnostic", "", 3, better=1),
    Row("instances.mean_iou", "Mean IoU", "", 3, better=1),
    Row("instances.precision50", "Precision", "", 3, better=1),
    Row("instances.recall50", "Recall", "", 3, better=1),
    Row("trajectory.ate_rmse_m", "ATE", "mm", 1, 1e3, better=-1),
    Row("trajectory.rpe_rmse_m", "RPE", "mm", 2, 1e3, better=-1),
    Row("map.voxels", "Voxels", "M", 2, 1e-6),
    Row("map.bytes", "Map", "MiB", 0, 2.0**-20, better=-1),
    Row("peak_rss_bytes", "Peak memory", "MiB", 0, 2.0**-20, better=-1),
)


@dataclass(frozen=True)
class Cell:
    """The value of one run in a table."""

    text: str  # "" = unknown
    best: bool = False
    difference: str = ""  # from the value of the first run, "" = none


@dataclass(frozen=True)
class TableRow:
    """A table row with the values of all runs."""

    name: str
    cells: list[Cell]
    unit: str = ""


@dataclass(frozen=True)
class Table:
    """A table with a column for each run."""

    id: str
    title: str
    first: str  # heading of the first column, which contains the row names
    rows: list[TableRow]
    lead: str = ""  # text below the title, "" = none
    empty: str = ""  # text for a table without rows; "" = omit the section


@dataclass(frozen=True)
class Comparison:
    """A comparison of several runs with the first run."""

    runs: Sequence[RunContents]
    names: Sequence[str]  # unique
    links: Sequence[str]  # link to the page of each run, "" = none
    scenes: Sequence[MapScene | None]  # maps of the first MAX_MAPS runs; None = empty map

    @classmethod
    def of(cls, runs: Sequence[RunContents], links: Sequence[str]) -> Comparison:
        """Return the comparison of runs.

        The maps are decimated, so that their total size is that of one map.

        Args:
            runs: Outputs of the runs, at least one.
            links: Link to the page of each run, "" = none.
        """
        mapped = runs[:MAX_MAPS]
        no_footage = Footage(NOT_CAMERA, {}, {}, {}, {})
        scenes = [MapScene.of(run, no_footage, 1 / len(mapped)) for run in mapped]
        return cls(runs, short_names([run.record.directory for run in runs]), links, scenes)

    def html(self) -> str:
        """Return the HTML page. The result is deterministic."""
        shown = [(name, scene) for name, scene in zip(self.names, self.scenes, strict=False) if scene is not None]
        sequences = {run.name for run in self.runs}
        title = next(iter(sequences)) if len(sequences) == 1 else f"{len(sequences)} sequences"
        heading = f"{len(self.runs)} runs of {title}"
        data: dict[str, Any] = {
            "likely": LIKELY,
            "sameWorld": len(sequences) == 1,
            "maps": [{"name": name, **scene.data()} for name, scene in shown],
        }
        context = {
            "heading": heading,
            "runs": list(zip(self.names, self.links, map(_system, self.runs), strict=True)),
            "run_colors": len(RUN_COLORS),
            "notices": self._notices(),
            "shown": [name for name, _ in shown],
            "likely": LIKELY,
            "tables": [self._metrics(), self._classes(), self._settings(), self._times(), self._objects()],
            **self._paths(),
        }
        return page("comparison.html", f"{heading} · InstanceMap", context, data, [scene.glb() for _, scene in shown])

    def _notices(self) -> list[str]:
        notices = [
            f"{name} is partial: {run.partial}." for name, run in zip(self.names, self.runs, strict=True) if run.partial
        ]
        if len(self.runs) > MAX_MAPS:
            notices.append(f"Only the maps of the first {MAX_MAPS} runs are shown; see the pages of the other runs.")
        spaces = {name: run.record.metrics.get(LABEL_SPACE) for name, run in zip(self.names, self.runs, strict=True)}
        if len(set(spaces.values())) > 1:
            listed = ", ".join(f"{name}: {space or 'names unchanged'}" for name, space in spaces.items())
            notices.append(f"The evaluation label spaces differ, so AP and IoU are not comparable: {listed}.")
        return notices

    def _metrics(self) -> Table:
        rows = []
        for row in ROWS:
            values = self._values(row.key, row.scale)
            if any(value is not None for value in values):
                rows.append(TableRow(row.name, compared(values, row.digits, row.better), row.unit))
        lead = "The best value is bold. The difference from the first run is below each value."
        return Table("figures", "Metrics", "Metric", rows, lead)

    def _values(self, key: str, scale: float = 1.0) -> list[float | None]:
        values = [run.record.metrics.get(key) for run in self.runs]
        return [scale * value if is_number(value) else None for value in values]

    def _classes(self) -> Table:
        prefix = "instances.ap50."
        keys = sorted({key for run in self.runs for key in run.record.metrics if key.startswith(prefix)})
        rows = [TableRow(key.removeprefix(prefix), compared(self._values(key), 2, 1)) for key in keys]
        return Table("classes", "AP50 by class", "Class", rows)

    def _settings(self) -> Table:
        configs = [dict(run.record.config) for run in self.runs]
        rows = []
        for group in STAGES:  # different plugins have different parameters
            targets = [_target(config.get(group)) for config in configs]
            if len(set(targets)) > 1:
                rows.append(TableRow(group, [Cell(target) for target in targets]))
                configs = [{key: node for key, node in config.items() if key != group} for config in configs]
        settings = [dict(leaves(config)) for config in configs]
        keys = dict.fromkeys(key for one in settings for key in one)
        rows += [
            TableRow(key, [Cell(str(one.get(key, ""))) for one in settings])
            for key in keys
            if len({repr(one.get(key)) for one in settings}) > 1
        ]
        empty = "None: all parameters are equal."
        return Table("settings", "Parameter differences", "Parameter", rows, empty=empty)

    def _paths(self) -> dict[str, Any]:
        chosen = [k for k, run in enumerate(self.runs) if len(run.poses) > 1 and run.name == self.runs[0].name]
        if not chosen:
            return {"paths": ""}
        styles = list(zip(RUN_COLORS, RUN_WIDTHS, strict=True))
        paths = []
        for k in chosen:
            color, width = styles[k % len(styles)]
            paths.append(PlottedPath(self.runs[k].poses[:, :3, 3], self.runs[k].lost_after, color, width))
        up = self.runs[chosen[0]].up
        picture, _ = top_view(paths, [], [], np.array([0.0, 0.0, 1.0]) if up is None else up)
        return {"paths": picture, "path_names": [(k, self.names[k]) for k in chosen]}

    def _times(self) -> Table:
        medians = [{row.stage: row.median for row in stage_rows(run.times)} if run.times else {} for run in self.runs]
        stages = dict.fromkeys(stage for one in medians for stage in one)
        rows = [TableRow(stage, compared([one.get(stage) for one in medians], 1, -1)) for stage in stages]
        return Table("times", "Stage times", "Median, ms", rows)

    def _objects(self) -> Table:
        counts = [Counter(one.class_name for one in run.objects if one.existence >= LIKELY) for run in self.runs]
        names = sorted({name for one in counts for name in one}, key=lambda name: (-max(c[name] for c in counts), name))
        rows = [TableRow(name, compared([float(one[name]) for one in counts], 0, 0)) for name in names]
        return Table("objects", "Objects by class", "Class", rows, f"With a probability of at least {LIKELY}.")


def compared(values: Sequence[float | None], digits: int, better: int) -> list[Cell]:
    """Return the cells of a row, with the best value marked and the differences from the first run.

    Differences that round to zero are omitted.

    Args:
        values: Value of each run, None = unknown.
        digits: Number of decimal places.
        better: 1 = higher is better, -1 = lower is better, 0 = no best value.
    """
    known = [round(value, digits) for value in values if value is not None]
    best = None if not better or len(set(known)) < 2 else max(known) if better > 0 else min(known)
    cells = []
    for k, value in enumerate(values):
        if value is None:
            cells.append(Cell(""))
            continue
        first, difference = values[0], ""
        if k and first is not None and round(value - first, digits):
            difference = f"{value - first:+.{digits}f}".replace("-", "\u2212")
        cells.append(Cell(f"{value:.{digits}f}", best is not None and round(value, digits) == best, difference))
    return cells


def short_names(directories: Sequence[Path]) -> list[str]:
    """Return the paths of directories relative to their deepest common parent directory."""
    resolved = [path.resolve() for path in directories]
    common = Path(os.path.commonpath([path.parent for path in resolved]))
    return [str(path.relative_to(common)) for path in resolved]


def _system(run: RunContents) -> str:
    """Return the detector and the fuser of a run, or the name of the row of an imported map."""
    if run.record.is_imported:
        return run.record.row
    metrics = run.record.metrics
    return ", ".join(filter(None, (metrics.get("choice.detector"), metrics.get("choice.fuser"))))


def _target(node: Any) -> str:
    """Return the class name of the plugin in a config node, or "" without a plugin."""
    return str(node.get("_target_")).rpartition(".")[2] if isinstance(node, dict) else ""
