"""The page that sets several runs side by side."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from framework.registry import STAGES
from framework.reporting.map_scene import MapScene
from framework.reporting.markup import page, section, table, tag, words
from framework.reporting.run_contents import RunContents
from framework.reporting.run_page import lost_after, viewer
from framework.reporting.source_frames import Footage
from framework.reporting.time_charts import stage_rows
from framework.reporting.trajectory_chart import Way, top_view
from framework.reporting.visibility import NOT_CAMERA
from framework.runs.provenance import leaves
from framework.runs.run_directory import LIKELY
from framework.runs.stored_runs import is_number

MOST_MAPS = 6  # runs whose maps are in the page: they share what one map may have
RUN_COLORS = 6  # of report.css


@dataclass(frozen=True)
class Row:
    """A figure of several runs."""

    key: str  # of metrics.json
    name: str
    unit: str
    digits: int
    scale: float = 1.0
    better: int = 0  # 1 = more is better, -1 = less is


ROWS = (
    Row("frames", "Frames", "", 0),
    Row("frames_lost", "Frames lost", "", 0, better=-1),
    Row("fps", "Frames a second", "/s", 1, better=1),
    Row("instances.count", "Objects", "", 0),
    Row("instances.ap50", "AP50", "", 3, better=1),
    Row("instances.ap25", "AP25", "", 3, better=1),
    Row("instances.ap", "AP", "", 3, better=1),
    Row("instances.ap50_agnostic", "AP50, classes ignored", "", 3, better=1),
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
class Comparison:
    """N runs, the first of which the others are compared with."""

    runs: Sequence[RunContents]
    names: Sequence[str]  # short, each another one
    links: Sequence[str]  # to the page of each run, "" = it has none
    scenes: Sequence[MapScene | None]  # of the first MOST_MAPS

    @classmethod
    def of(cls, runs: Sequence[RunContents], links: Sequence[str]) -> Comparison:
        """Decimates the maps, so that all of them together are as light as that of one run."""
        mapped = runs[:MOST_MAPS]
        nothing = Footage(NOT_CAMERA, {}, {}, {}, {})
        scenes = [MapScene.of(run, nothing, 1 / len(mapped)) for run in mapped]
        return cls(runs, short_names([run.record.directory for run in runs]), links, scenes)

    def html(self) -> str:
        """The page, the same for the same records."""
        shown = [(name, scene) for name, scene in zip(self.names, self.scenes, strict=False) if scene is not None]
        sequences = {run.name for run in self.runs}
        title = next(iter(sequences)) if len(sequences) == 1 else f"{len(sequences)} recordings"
        head = tag(
            "header",
            tag("p", "InstanceMap", class_="brand"),
            tag("h1", words(f"{len(self.runs)} runs of {title}")),
            tag("ol", *(self._run(k) for k in range(len(self.runs))), class_="runs"),
            class_="head",
        )
        parts = [self._notices(), self._map(shown), self._figures(), self._classes(), self._settings()]
        parts += [self._trajectories(), self._times(), self._objects()]
        footer = tag("footer", "Made by InstanceMap from the runs' records. Nothing here is loaded from elsewhere.")
        data: dict[str, Any] = {
            "likely": LIKELY,
            "sameWorld": len(sequences) == 1,
            "maps": [{"name": name, **scene.data()} for name, scene in shown],
        }
        body = "\n".join([head, tag("main", *parts), footer])
        return page(f"{len(self.runs)} runs of {title} · InstanceMap", body, data, [scene.glb() for _, scene in shown])

    def _run(self, k: int) -> str:
        name = words(self.names[k])
        linked = tag("a", name, href=self.links[k]) if self.links[k] else name
        chosen = [str(self.runs[k].record.metrics.get(f"choice.{group}") or "") for group in ("detector", "fuser")]
        said = ", ".join(filter(None, chosen))
        return tag("li", _key(k), tag("b", linked), " ", tag("span", words(said), class_="faint"))

    def _notices(self) -> str:
        said = [
            f"{name} is partial: {run.partial}." for name, run in zip(self.names, self.runs, strict=True) if run.partial
        ]
        if len(self.runs) > MOST_MAPS:
            said.append(f"The maps of the first {MOST_MAPS} runs are shown; the others are in their own pages.")
        return "".join(tag("p", words(text), class_="notice", role="status") for text in said)

    def _map(self, shown: Sequence[tuple[str, MapScene]]) -> str:
        if not shown:
            return section("map", "Maps", tag("p", "Nothing was mapped.", class_="empty"))
        buttons = [
            tag("button", words(name), type="button", data_map=k, aria_pressed="false" if k else "true")
            for k, (name, _) in enumerate(shown)
        ]
        choice = tag("div", tag("div", *buttons, class_="choice", role="group", aria_label="Run"), class_="tools")
        return section("map", "Maps", choice, viewer(""))

    def _figures(self) -> str:
        rows = []
        for row in ROWS:
            values = [run.record.metrics.get(row.key) for run in self.runs]
            numbers = [row.scale * value if is_number(value) else None for value in values]
            if any(value is not None for value in numbers):
                name = words(row.name) + (tag("span", f" {row.unit}", class_="faint") if row.unit else "")
                rows.append([name, *compared(numbers, row.digits, row.better)])
        lead = "Best in bold where one is better; below it the difference from the first run."
        return section("figures", "Figures", self._table("Figure", rows), lead=lead)

    def _classes(self) -> str:
        prefix = "instances.ap50."
        found = sorted({key for run in self.runs for key in run.record.metrics if key.startswith(prefix)})
        rows = []
        for key in found:
            values = [run.record.metrics.get(key) for run in self.runs]
            numbers = [value if is_number(value) else None for value in values]
            rows.append([words(key.removeprefix(prefix)), *compared(numbers, 2, 1)])
        return section("classes", "AP50 by class", self._table("Class", rows)) if rows else ""

    def _settings(self) -> str:
        configs = [dict(run.record.config) for run in self.runs]
        rows = []
        for group in STAGES:  # of another plugin all parameters are others
            targets = [_target(config.get(group)) for config in configs]
            if len(set(targets)) > 1:
                rows.append([words(group), *map(words, targets)])
                configs = [{key: node for key, node in config.items() if key != group} for config in configs]
        settings = [dict(leaves(config)) for config in configs]
        keys = list(dict.fromkeys(key for one in settings for key in one))
        rows += [
            [words(key), *(words(one.get(key, "")) for one in settings)]
            for key in keys
            if len({repr(one.get(key)) for one in settings}) > 1
        ]
        body = (
            self._table("Parameter", rows) if rows else tag("p", "None: all parameters are the same.", class_="empty")
        )
        return section("settings", "What was set otherwise", body)

    def _trajectories(self) -> str:
        chosen = [k for k, run in enumerate(self.runs) if len(run.poses) > 1 and run.name == self.runs[0].name]
        if not chosen:
            return ""
        ways = [Way(self.runs[k].poses[:, :3, 3], f"run-{k % RUN_COLORS}", lost_after(self.runs[k])) for k in chosen]
        up = self.runs[chosen[0]].up
        picture, _ = top_view(ways, [], [], np.array([0.0, 0.0, 1.0]) if up is None else up)
        keys = [tag("span", _key(k), words(self.names[k]), class_="pair") for k in chosen]
        caption = tag("figcaption", "From above, each in its own world. ", *keys)
        return section("trajectory", "Trajectories", tag("div", tag("figure", picture, caption), class_="charts"))

    def _times(self) -> str:
        of_runs = [{row.stage: row for row in stage_rows(run.times)} if run.times else {} for run in self.runs]
        stages = list(dict.fromkeys(stage for rows in of_runs for stage in rows))
        rows = [
            [words(stage), *compared([one[stage].median if stage in one else None for one in of_runs], 1, -1)]
            for stage in stages
        ]
        return section("times", "Stage times", self._table("Median, ms", rows)) if rows else ""

    def _objects(self) -> str:
        counts = [Counter(one.class_name for one in run.objects if one.confidence >= LIKELY) for run in self.runs]
        names = sorted({name for one in counts for name in one}, key=lambda name: (-max(c[name] for c in counts), name))
        rows = [[words(name), *compared([float(one[name]) for one in counts], 0, 0)] for name in names]
        lead = f"Of a confidence of {LIKELY} or more."
        return section("objects", "Objects by class", self._table("Class", rows), lead=lead) if rows else ""

    def _table(self, first: str, rows: Sequence[Sequence[str]]) -> str:
        return table([first, *self.names], rows, numbers=range(1, 1 + len(self.names)), class_="compared")


def compared(values: Sequence[float | None], digits: int, better: int) -> list[str]:
    """Cells: the best is bold, and each tells how much it differs from the first as far as the digits show."""
    known = [round(value, digits) for value in values if value is not None]
    best = None if not better or len(set(known)) < 2 else max(known) if better > 0 else min(known)
    cells = []
    for k, value in enumerate(values):
        if value is None:
            cells.append(tag("span", "–", class_="faint"))
            continue
        text = f"{value:.{digits}f}"
        cell = tag("b", text) if round(value, digits) == best else text
        first = values[0]
        if k and first is not None and round(value - first, digits):
            cell += tag("small", words(f"{value - first:+.{digits}f}".replace("-", "\u2212")))
        cells.append(cell)
    return cells


def short_names(directories: Sequence[Path]) -> list[str]:
    """What tells the directories apart: their paths below the folder that they are all in."""
    resolved = [path.resolve() for path in directories]
    common = Path(os.path.commonpath([path.parent for path in resolved]))
    return [str(path.relative_to(common)) for path in resolved]


def _target(node: Any) -> str:
    """The name of a plugin's class."""
    return str(node.get("_target_")).rpartition(".")[2] if isinstance(node, dict) else ""


def _key(k: int) -> str:
    return tag("span", class_=f"key run-{k % RUN_COLORS}")
