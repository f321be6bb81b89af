"""The page of one run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from framework.data import Float64
from framework.errors import FrameError
from framework.files.image_files import read_color
from framework.registry import STAGES
from framework.reporting.map_scene import MapScene, colors_by_id, hex_color, likely_ids
from framework.reporting.markup import figure, page, section, table, tag, words
from framework.reporting.object_table import object_data, object_table
from framework.reporting.pictures import Photographer, Picture, webp_url
from framework.reporting.progress_pictures import GrowthPicture, growth_pictures
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import RunSource, TruePath
from framework.reporting.source_frames import Footage
from framework.reporting.time_charts import growth, stage_areas, stage_rows
from framework.reporting.trajectory_chart import (
    FLAT_HEIGHT,
    HEIGHT,
    Footprint,
    Way,
    box_corners,
    error_over_time,
    top_view,
)
from framework.reporting.truth_check import TruthCheck
from framework.reporting.truth_section import truth_section
from framework.reporting.visibility import NOT_CAMERA, spread_out
from framework.runs.provenance import leaves
from framework.runs.run_directory import LIKELY
from framework.runs.stored_runs import is_number

OVERVIEW_WIDTH = 1400  # px, of the picture for browsers without WebGL


@dataclass(frozen=True)
class RunReport:
    """All that a run's page shows."""

    contents: RunContents
    scene: MapScene | None  # None = nothing was mapped
    recording: RunSource
    pictures: Mapping[int, Picture]
    true_path: TruePath | None
    check: TruthCheck | None
    why_unchecked: str  # why there is no check although there were true instances once

    @classmethod
    def of(cls, contents: RunContents) -> RunReport:
        """Looks at the recording again, where it can be read."""
        recording = RunSource.of(contents)
        chosen = spread_out(len(contents.poses))
        footage = Footage.of(recording, chosen, recording.camera or NOT_CAMERA)
        scene = MapScene.of(contents, footage)
        photographer, pictures = None, {}
        if scene is not None:
            photographer = Photographer(scene.mesh, scene.surface, contents.poses, footage)
            colors = colors_by_id(contents.objects)
            pictures = photographer.pictures(scene.mesh.instance_ids, scene.sightings.best, colors)
        truth, why = recording.scene_truth()
        check = TruthCheck.of(contents, truth, scene, photographer, footage) if truth is not None else None
        return cls(
            contents, scene, recording, pictures, TruePath.of(contents.poses, footage.true_positions), check, why
        )

    def html(self) -> str:
        """The page, the same for the same record and recording."""
        contents = self.contents
        parts = [
            self._head(),
            tag(
                "main",
                self._notices(),
                self._map(),
                self._objects(),
                truth_section(self.check, self.why_unchecked, contents, self.pictures),
                self._trajectory(),
                self._growth(),
                self._times(),
                _provenance(contents),
            ),
            tag("footer", "Made by InstanceMap from one run's record. Nothing in this page is loaded from elsewhere."),
        ]
        judgements = self.check.judgements if self.check else {}
        data: dict[str, Any] = {
            "likely": LIKELY,
            "maps": [] if self.scene is None else [{"name": contents.name, **self.scene.data()}],
            "objects": [
                object_data(one, contents, self.pictures.get(one.id), judgements.get(one.id))
                for one in contents.objects
            ],
        }
        maps = [] if self.scene is None else [self.scene.glb()]
        return page(f"{contents.name} · InstanceMap", "\n".join(parts), data, maps)

    def _head(self) -> str:
        metrics = self.contents.record.metrics
        chosen = [str(metrics.get(f"choice.{group}") or "") for group in STAGES]
        stages = [tag("li", words(name)) for name in chosen if name]
        figures = [figure(*one) for one in headline_figures(self.contents)]
        return tag(
            "header",
            tag("p", "InstanceMap", class_="brand"),
            tag("h1", words(self.contents.name)),
            tag("ol", *stages, class_="stages", aria_label="dataset, detector, tracker, refiner and fuser"),
            tag("dl", *figures, class_="figures"),
            class_="head",
        )

    def _notices(self) -> str:
        notices = []
        if self.contents.partial:
            notices.append(f"This run is partial: {self.contents.partial}. What it had mapped until then is below.")
        if self.recording.why_not:
            notices.append(
                f"The recording could not be read ({self.recording.why_not}): pictures of objects are renderings of "
                "the map, and the true path is not known."
            )
        return "".join(tag("p", words(text), class_="notice", role="status") for text in notices)

    def _map(self) -> str:
        if self.scene is None:
            return section("map", "Map", tag("p", "Nothing was mapped.", class_="empty"))
        overview = overview_url(self.contents.record.directory / "overview.png")
        still = f'<img class="still" src="{overview}" alt="The map and its instances, rendered">' if overview else ""
        return section("map", "Map", viewer(still))

    def _objects(self) -> str:
        contents = self.contents
        if not contents.objects:
            return section("objects", "Objects", tag("p", "No object was found.", class_="empty"))
        colors = {key: hex_color(color) for key, color in colors_by_id(contents.objects).items()}
        search = tag(
            "div",
            '<input type="search" id="search" placeholder="Search by class or number" aria-label="Search objects">',
            tag("span", id="count", class_="faint", role="status"),
            class_="tools",
        )
        judgements = self.check.judgements if self.check else None
        return section("objects", "Objects", search, object_table(contents, colors, self.pictures, judgements))

    def _trajectory(self) -> str:
        contents = self.contents
        if len(contents.poses) < 2:
            return ""
        up = self.scene.up if self.scene is not None else contents.up
        if up is None:
            up = np.array([0.0, 0.0, 1.0])
        absent = {"truth"} if self.true_path is None else set()
        absent |= set() if contents.lost_frames else {"lost"}
        keys = tuple(key for key in TOP_VIEW_KEY if key[0] not in absent)
        whole, larger = self._top_views(up)
        beside = [(larger, "The same, larger.")] if larger else []
        if self.true_path is not None:
            frames = [contents.tracked_frames[k] for k in self.true_path.chosen]
            height = FLAT_HEIGHT if larger else HEIGHT
            beside += [(error_over_time(frames, self.true_path.errors, height), self._error_words())]
        figures = [tag("figure", picture, _caption(said)) for picture, said in beside]
        charts = [tag("figure", whole, _caption(self._way_words(), keys))]
        if figures:
            charts.append(tag("div", *figures, class_="column"))
        return section("trajectory", "Trajectory", tag("div", *charts, class_="charts"))

    def _top_views(self, up: Float64) -> tuple[str, str]:
        """Among the objects, and larger where it is small among them."""
        contents = self.contents
        colors = colors_by_id(contents.objects)
        likely = set(likely_ids(contents))
        footprints = [
            Footprint(box_corners(one.obb), one.class_name, hex_color(colors[one.id]))
            for one in contents.objects
            if one.id in likely
        ]
        way = Way(contents.poses[:, :3, 3], "mine", lost_after(contents))
        true_ways = [self.true_path.positions] if self.true_path is not None else []
        whole, share = top_view([way], true_ways, footprints, up)
        if share > SMALL_WAY:
            return whole, ""
        return whole, top_view([way], true_ways, [], up, FLAT_HEIGHT if true_ways else HEIGHT)[0]

    def _way_words(self) -> str:
        steps = np.linalg.norm(np.diff(self.contents.poses[:, :3, 3], axis=0), axis=1)
        lost = len(self.contents.lost_frames)
        text = f"From above: {steps.sum():.2f} m in {len(self.contents.poses)} frames"
        return f"{text}, {lost} lost." if lost else f"{text}, none lost."

    def _error_words(self) -> str:
        metrics = self.contents.record.metrics
        parts = []
        for key, name in (("trajectory.ate_rmse_m", "ATE"), ("trajectory.rpe_rmse_m", "RPE")):
            if is_number(value := metrics.get(key)):
                parts.append(f"{name} {1e3 * value:.1f} mm")
        if is_number(value := metrics.get("trajectory.rpe_rotation_rmse_rad")):
            parts.append(f"RPE {np.rad2deg(value):.2f}° a frame")
        assert self.true_path is not None
        looked = f"drawn from {len(self.true_path.chosen)} frames, after alignment"
        return f"{', '.join(parts)} over all frames; {looked}." if parts else f"{looked.capitalize()}."

    def _growth(self) -> str:
        contents, scene = self.contents, self.scene
        if scene is None or not contents.tracked_frames:
            return ""
        frames = [contents.tracked_frames[k] for k in scene.sightings.chosen]
        likely = set(likely_ids(contents))
        first = [one.first_frame for one in contents.objects if one.id in likely]
        lead = (
            "When each part of the final map first came into sight, by looking at it again from the trajectory, and "
            "when each of its likely objects was first detected. The slider below the map plays it."
        )
        picture = growth(frames, scene.sightings.growth, first, contents.tracked_frames[-1])
        chart = tag("figure", picture, _caption("", GROWTH_KEY))
        strip = [
            tag("figure", f'<img src="{one.url}" alt="" width="480" height="320">', _caption(_seen_words(one)))
            for one in growth_pictures(scene)
        ]
        charts = tag("div", chart, tag("div", *strip, class_="strip"), class_="charts")
        return section("growth", "Growth", charts, lead=lead)

    def _times(self) -> str:
        times = self.contents.times
        if times is None or not stage_rows(times):
            return ""
        rows = stage_rows(times)
        widest = max(row.p95 for row in rows)
        body = [
            [
                f'<span class="key stage-{row.stage}"></span>{words(row.stage)}',
                _time_bar(row.lowest / widest, row.median / widest, row.p95 / widest),
                f"{row.median:.1f}",
                f"{row.p95:.1f}",
            ]
            for row in rows
        ]
        heads = ["Stage", "5% to 95%", "Median, ms", "p95, ms"]
        lead = "Reading and detection of the next frame run beside the other stages: a frame takes less than their sum."
        return section(
            "times",
            "Stage times",
            tag(
                "div",
                table(heads, body, numbers=(2, 3), class_="stage-times"),
                tag("figure", stage_areas(times)),
                class_="charts",
            ),
            lead=lead,
        )


SMALL_WAY = 0.3  # of the width of the view from above: what is smaller is shown larger, too
TOP_VIEW_KEY = (("mine", "estimated"), ("truth", "true"), ("start", "start"), ("end", "end"), ("lost", "then lost"))
GROWTH_KEY = (("seen", "surface in sight, share of all"), ("objects", "objects found"))


def viewer(still: str) -> str:
    """The map's place in the page, with its buttons; `still` is shown where there is no WebGL."""
    views = [
        tag("button", name, type="button", data_view=view, aria_pressed="true" if view == "color" else "false")
        for view, name in (("color", "Colour"), ("instance", "Instances"), ("class", "Classes"))
    ]
    bar = tag(
        "div",
        tag("div", *views, class_="choice", role="group", aria_label="What the colours say"),
        tag("label", '<input type="checkbox" id="path" checked>', "Camera path"),
        tag(
            "label",
            "Confidence ≥ ",
            tag("output", f"{LIKELY:.2f}", id="confidence-value"),
            f'<input type="range" id="confidence" min="0" max="1" step="0.01" value="{LIKELY}">',
        ),
        tag("span", class_="spring"),
        tag("button", "Reset view", type="button", id="reset"),
        tag("button", "Save GLB", type="button", id="save"),
        class_="tools",
    )
    time = tag(
        "div",
        tag("button", "Play growth", type="button", id="play"),
        '<input type="range" id="time" min="0" max="1000" value="1000" aria-label="Growth of the map">',
        tag("output", id="time-value", class_="faint"),
        class_="tools time",
    )
    hint = tag("p", "Drag to turn, scroll or pinch to come closer, click an object for its numbers.", class_="faint")
    panel = tag("aside", hint, tag("div", id="legend"), id="panel", aria_live="polite")
    stage = tag("div", '<canvas id="canvas" tabindex="0" aria-label="The map in 3D"></canvas>', still, class_="stage")
    return tag("div", bar, tag("div", stage, panel, class_="split"), time, class_="viewer")


def headline_figures(contents: RunContents) -> list[tuple[str, str, str, str]]:
    """Value, unit, label and note of a run's main figures, as far as there are any."""
    metrics = contents.record.metrics

    def known(key: str) -> float | None:
        value = metrics.get(key)
        return value if is_number(value) else None

    found: list[tuple[str, str, str, str]] = []
    if (frames := known("frames")) is not None:
        lost = int(known("frames_lost") or 0)
        found.append((f"{frames:.0f}", "", "Frames", f"{lost} lost" if lost else "none lost"))
    if (fps := known("fps")) is not None:
        found.append((f"{fps:.1f}", "/s", "Speed", "whole loop"))
    if (count := known("instances.count")) is not None:
        found.append((str(likely_count(contents)), "", "Objects", f"likely, of {count:.0f}"))
    if (ap50 := known("instances.ap50")) is not None:
        ap25 = known("instances.ap25")
        found.append((f"{ap50:.2f}", "", "AP50", "" if ap25 is None else f"AP25 {ap25:.2f}"))
    if metrics.get("pose_source") == "ground_truth":
        found.append(("given", "", "Poses", "not estimated"))
    elif (ate := known("trajectory.ate_rmse_m")) is not None:
        found.append((f"{1e3 * ate:.1f}", "mm", "ATE", "after alignment"))
    if (voxels := known("map.voxels")) is not None:
        taken = known("map.bytes")
        found.append((f"{voxels / 1e6:.1f}", "M", "Voxels", "" if taken is None else f"{taken / 2**20:.0f} MiB"))
    return found


def likely_count(contents: RunContents) -> int:
    """How many objects are likely."""
    return len(likely_ids(contents))


def lost_after(contents: RunContents) -> list[int]:
    """The poses after which frames were lost."""
    numbers, lost = contents.tracked_frames, contents.lost_frames
    if not numbers or not lost:
        return []
    before = np.searchsorted(numbers, lost) - 1
    return sorted({max(0, int(k)) for k in before})


def overview_url(path: Path) -> str:
    """overview.png as a smaller picture, "" where there is none that can be read."""
    try:
        small = Image.fromarray(read_color(path))
    except FrameError:
        return ""
    small.thumbnail((OVERVIEW_WIDTH, OVERVIEW_WIDTH))
    return webp_url(small, 80)


def _seen_words(one: GrowthPicture) -> str:
    return f"Frame {one.frame}: {100 * one.share:.0f}%"


def _caption(text: str, keys: tuple[tuple[str, str], ...] = ()) -> str:
    shown = [f'<span class="pair"><span class="key {css}"></span>{words(name)}</span> ' for css, name in keys]
    return tag("figcaption", words(text), " ", tag("span", *shown, class_="keys") if shown else "")


def _time_bar(lowest: float, median: float, p95: float) -> str:
    low, middle, wide = (f"{100 * share:.1f}" for share in (lowest, median, p95 - lowest))
    return (
        '<svg class="spread" viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="spread-all" x="{low}" y="3" width="{wide}" height="4"/>'
        f'<rect class="spread-median" x="{middle}" y="0" width="1" height="10"/></svg>'
    )


def _provenance(contents: RunContents) -> str:
    record = contents.record
    rows = [("Code", record.commit)]
    rows += [
        (key.removeprefix("environment."), str(value))
        for key, value in record.metrics.items()
        if key.startswith("environment.")
    ]
    rows += [("seed", str(record.metrics.get("seed"))), ("config_hash", str(record.metrics.get("config_hash")))]
    listed = tag("dl", *(tag("dt", words(key)) + tag("dd", words(value)) for key, value in rows), class_="facts")
    config = yaml.safe_dump(dict(record.config), sort_keys=False, allow_unicode=True)
    figures = "\n".join(f"{key}: {value}" for key, value in leaves(dict(record.metrics)))
    return section(
        "provenance",
        "How it was made",
        listed,
        tag("details", tag("summary", "Every parameter"), tag("pre", words(config))),
        tag("details", tag("summary", "Every figure"), tag("pre", words(figures))),
    )
