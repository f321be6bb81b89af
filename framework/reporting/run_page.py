"""HTML page with the report of one run."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from framework.data import LIKELY, Float64
from framework.editing.edited_run import EDITS, default_directory
from framework.errors import DataError, FrameError
from framework.files.image_files import read_color
from framework.files.manifest import verified
from framework.mapping.instance_map import FORMAT
from framework.mapping.storage.map_file import read_format
from framework.registry import STAGES
from framework.reporting.back_end_section import back_end_section
from framework.reporting.charts import (
    FLAT_HEIGHT,
    HEIGHT,
    Footprint,
    PlottedPath,
    box_corners,
    growth,
    position_errors,
    stage_areas,
    stage_rows,
    top_view,
)
from framework.reporting.explanation_section import explanation_section
from framework.reporting.map_scene import MapScene, colors_by_id, hex_color, likely_ids
from framework.reporting.markup import page
from framework.reporting.object_table import object_data, object_rows
from framework.reporting.pictures import Photographer, Picture, webp_url
from framework.reporting.run_contents import RunContents
from framework.reporting.run_source import Footage, RunSource, TruePath
from framework.reporting.truth_section import TruthCheck, truth_section
from framework.reporting.visibility import NOT_CAMERA, spread_out
from framework.runs.provenance import leaves
from framework.runs.stored_runs import MAP, is_number

OVERVIEW_WIDTH = 1400  # px, of the image for browsers without WebGL
SMALL_PATH = 0.3  # maximum extent of a path that is also shown enlarged, relative to the width of the top view
TOP_VIEW_KEY = (
    ("mine", "estimated"),
    ("truth", "ground truth"),
    ("start", "start"),
    ("end", "end"),
    ("lost", "tracking lost"),
)


@dataclass(frozen=True)
class RunReport:
    """The content of the page of a run."""

    contents: RunContents
    scene: MapScene | None  # None = empty map
    source: RunSource
    pictures: Mapping[int, Picture]  # by object id
    true_path: TruePath | None  # None = fewer than three ground-truth poses
    check: TruthCheck | None  # None = not compared with the ground truth
    why_unchecked: str  # reason why an evaluated run is not compared, "" = none

    @classmethod
    def of(cls, contents: RunContents) -> RunReport:
        """Return the report of a run.

        It contains images of the sequence if the sequence is still readable.
        """
        source = RunSource.of(contents)
        chosen = spread_out(len(contents.poses))
        footage = Footage.of(source, chosen, source.camera or NOT_CAMERA)
        scene = MapScene.of(contents, footage)
        photographer, pictures = None, {}
        if scene is not None:
            photographer = Photographer(scene.mesh, scene.surface, contents.viewpoints, footage)
            colors = colors_by_id(contents.objects)
            pictures = photographer.pictures(scene.mesh.instance_ids, scene.sightings.best, colors)
        truth, why = source.scene_truth()
        check = TruthCheck.of(contents, truth, scene, photographer, footage) if truth is not None else None
        true_path = TruePath.of(contents.poses, footage.true_positions)
        return cls(contents, scene, source, pictures, true_path, check, why)

    def html(self) -> str:
        """Return the HTML page. The result is deterministic."""
        contents = self.contents
        match_results = self.check.match_results if self.check else {}
        colors = colors_by_id(contents.objects)
        data: dict[str, Any] = {
            "likely": LIKELY,
            "maps": [] if self.scene is None else [{"name": contents.name, **self.scene.data()}],
            "objects": [
                object_data(
                    one, contents, hex_color(colors[one.id]), self.pictures.get(one.id), match_results.get(one.id)
                )
                for one in contents.objects
            ],
            "edit": _editing(contents),
        }
        context = {
            "name": contents.name,
            "not_editable": _not_editable(contents),
            "stages": stage_names(contents),
            "numbers": headline_numbers(contents),
            "notices": self._notices(),
            "likely": LIKELY,
            "mapped": self.scene is not None,
            "imported": contents.record.is_imported,
            "still": overview_url(contents.record.directory / "overview.png") if self.scene is not None else "",
            "checked": self.check is not None,
            "objects": object_rows(contents, self.pictures, match_results),
            "truth": truth_section(self.check, self.why_unchecked, contents, self.pictures),
            "explanation": explanation_section(contents, self.source),
            "trajectory": self._trajectory(),
            "back_end": back_end_section(contents, self._up),
            "progress": self._progress(),
            "times": stage_rows(contents.times) if contents.times else [],
            "times_chart": stage_areas(contents.times) if contents.times else "",
            **_provenance(contents),
        }
        maps = [] if self.scene is None else [self.scene.glb()]
        return page("run.html", f"{contents.name} · InstanceMap", context, data, maps)

    def _notices(self) -> list[str]:
        notices, metrics = [], self.contents.record.metrics
        if self.contents.partial:
            notices.append(f"This run is partial: {self.contents.partial}. The page shows the map up to that point.")
        if self.contents.record.is_imported:
            notices.append(
                f"This is an imported map ({metrics.get('external.mesh')}). It has no trajectory and no run times. "
                "Images are rendered from virtual cameras."
            )
        elif self.source.why_not:
            notices.append(
                f"The sequence could not be read ({self.source.why_not}). Object images are rendered from the map, "
                "and the ground-truth path is unknown."
            )
        return notices

    def _trajectory(self) -> dict[str, Any] | None:
        contents = self.contents
        if len(contents.poses) < 2:
            return None
        absent = {"truth"} if self.true_path is None else set()
        absent |= set() if contents.lost_frames else {"lost"}
        keys = [key for key in TOP_VIEW_KEY if key[0] not in absent]
        whole, larger = self._top_views()
        details = [(larger, "The path, enlarged.")] if larger else []
        if self.true_path is not None:
            frames = [contents.tracked_frames[k] for k in self.true_path.chosen]
            chart = position_errors(frames, self.true_path.errors, FLAT_HEIGHT if larger else HEIGHT)
            details.append((chart, self._error_text()))
        return {"whole": whole, "text": self._path_text(), "legend": keys, "details": details}

    @property
    def _up(self) -> Float64:
        """Up direction (3,) of top views in the world frame, z if unknown."""
        up = self.scene.up if self.scene is not None else self.contents.up
        return np.array([0.0, 0.0, 1.0]) if up is None else up

    def _top_views(self) -> tuple[str, str | None]:
        """Return the top view of the path and the objects, and an enlarged view of the path, both as SVG.

        The second view is None if the path is large enough in the first.
        """
        contents, up = self.contents, self._up
        colors = colors_by_id(contents.objects)
        likely = set(likely_ids(contents))
        footprints = [
            Footprint(box_corners(one.obb), one.class_name, hex_color(colors[one.id]))
            for one in contents.objects
            if one.id in likely
        ]
        path = PlottedPath(contents.poses[:, :3, 3], contents.lost_after)
        true_paths = [self.true_path.positions] if self.true_path is not None else []
        whole, fraction = top_view([path], true_paths, footprints, up)
        if fraction > SMALL_PATH:
            return whole, None
        return whole, top_view([path], true_paths, [], up, FLAT_HEIGHT if true_paths else HEIGHT)[0]

    def _path_text(self) -> str:
        steps = np.linalg.norm(np.diff(self.contents.poses[:, :3, 3], axis=0), axis=1)
        lost = len(self.contents.lost_frames)
        text = f"Top view: path of {steps.sum():.2f} m in {len(self.contents.poses)} frames"
        return f"{text}, {lost} lost." if lost else f"{text}, none lost."

    def _error_text(self) -> str:
        metrics = self.contents.record.metrics
        parts = []
        for key, name in (
            ("trajectory.ate_rmse_m", "ATE RMSE"),
            ("trajectory.tracked_ate_rmse_m", "ATE RMSE before correction"),
            ("trajectory.rpe_rmse_m", "RPE RMSE"),
        ):
            if is_number(value := metrics.get(key)):
                parts.append(f"{name} {1e3 * value:.1f} mm")
        if is_number(value := metrics.get("trajectory.rpe_rotation_rmse_rad")):
            parts.append(f"{np.rad2deg(value):.2f}° per frame")
        assert self.true_path is not None
        chart = f"The chart shows {len(self.true_path.chosen)} frames, after alignment."
        return f"{', '.join(parts)} over all frames. {chart}" if parts else chart

    def _progress(self) -> dict[str, Any] | None:
        contents, scene = self.contents, self.scene
        if scene is None or not contents.tracked_frames:
            return None
        frames = [contents.tracked_frames[k] for k in scene.sightings.chosen]
        likely = set(likely_ids(contents))
        first = [one.first_frame for one in contents.objects if one.id in likely]
        chart = growth(frames, scene.sightings.growth, first, contents.tracked_frames[-1])
        return {"chart": chart, "pictures": scene.progress_pictures()}


def stage_names(contents: RunContents) -> list[str]:
    """Return the chosen options of the stages. For an imported map, they are the dataset and the name of its row."""
    metrics = contents.record.metrics
    if contents.record.is_imported:
        return [*filter(None, [metrics.get("choice.dataset")]), contents.record.row]
    return [name for group in STAGES if (name := metrics.get(f"choice.{group}"))]


def headline_numbers(contents: RunContents) -> list[tuple[str, str, str, str]]:
    """Return the label, value, unit and note of each main metric that the run has."""
    metrics = contents.record.metrics

    def known(key: str) -> float | None:
        value = metrics.get(key)
        return value if is_number(value) else None

    found: list[tuple[str, str, str, str]] = []
    if (frames := known("frames")) is not None:
        lost = int(known("frames_lost") or 0)
        found.append(("Frames", f"{frames:.0f}", "", f"{lost} lost" if lost else "none lost"))
    if (fps := known("fps")) is not None:
        found.append(("Frames per second", f"{fps:.1f}", "/s", "all stages"))
    if (count := known("instances.count")) is not None:
        found.append(("Objects", str(len(likely_ids(contents))), "", f"of {count:.0f}; probability ≥ {LIKELY}"))
    if space := metrics.get("label_space"):
        found.append(("Label space", str(space), "", ""))
    if (ap50 := known("instances.ap50")) is not None:
        ap25 = known("instances.ap25")
        found.append(("AP50", f"{ap50:.2f}", "", "" if ap25 is None else f"AP25 {ap25:.2f}"))
    if metrics.get("pose_source") == "ground_truth":
        found.append(("Poses", "ground truth", "", "not estimated"))
    elif (ate := known("trajectory.ate_rmse_m")) is not None:
        found.append(("ATE RMSE", f"{1e3 * ate:.1f}", "mm", "after alignment"))
    if (voxels := known("map.voxels")) is not None:
        taken = known("map.bytes")
        found.append(("Voxels", f"{voxels / 1e6:.1f}", "M", "" if taken is None else f"{taken / 2**20:.0f} MiB"))
    return found


def overview_url(path: Path) -> str:
    """Return a reduced overview.png as a `data:` URL, or "" if it cannot be read.

    Raises:
        DataError: The file has changed since the run.
    """
    try:
        with verified(path):
            small = Image.fromarray(read_color(path))
    except FrameError:
        return ""
    small.thumbnail((OVERVIEW_WIDTH, OVERVIEW_WIDTH))
    return webp_url(small, 80)


def _editing(contents: RunContents) -> dict[str, Any]:
    """Return the class names of a map, and the command that applies edits to it."""
    run = contents.record.directory
    names = {name for one in contents.objects for name in (one.class_name, *one.class_probabilities)}
    command = ["instancemap", "edit", str(run), "--edits", EDITS, "--out", str(default_directory(run))]
    return {"classes": sorted(names), "command": shlex.join(command)}


def _not_editable(contents: RunContents) -> str:
    """Return the reason why `instancemap edit` cannot edit a run, "" = none."""
    if contents.partial:
        return "instancemap edit cannot apply edits to this run, because it is partial."
    try:
        if read_format(contents.record.directory / MAP) == str(FORMAT):
            return ""
    except DataError:
        pass  # missing, as in imported maps, or damaged
    return f"instancemap edit cannot apply edits to this run, because it has no {MAP} with instances in voxels."


def _provenance(contents: RunContents) -> dict[str, Any]:
    record = contents.record
    prefix = "environment."
    environment = [(key.removeprefix(prefix), record.metrics[key]) for key in record.metrics if key.startswith(prefix)]
    facts = [(key, record.metrics.get(key)) for key in ("seed", "config_hash")]
    return {
        "facts": [("Code", record.commit), *environment, *facts],
        "config": yaml.safe_dump(dict(record.config), sort_keys=False, allow_unicode=True),
        "metrics": "\n".join(f"{key}: {value}" for key, value in leaves(dict(record.metrics))),
    }
