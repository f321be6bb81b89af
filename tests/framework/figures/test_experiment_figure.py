"""Tests for the figures of experiments."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image

from framework.commands.results import figures
from framework.commands.running.sweep import sweep_in
from framework.errors import ConfigError, DataError, InstanceMapError
from framework.figures import map_figure
from framework.figures.experiment_figure import DRAWN, write_figure
from framework.figures.figure_choice import FigureChoice
from framework.figures.figure_runs import Pictured
from framework.files.tum_trajectory import write_tum
from framework.runs.mesh_file import write_mesh
from framework.runs.provenance import config_hash
from tests.support.metric_runs import check_layout
from tests.support.scenes.boxes_room import furnished, walk

pytestmark = pytest.mark.usefixtures("fakes_registered")
STAGE_MS = (("tracking", 20), ("refinement", 10), ("update", 10), ("integration", 20))
ROWS: Mapping[str, list[str]] = {"part": ["dataset.stop=8"], "whole": []}


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the resolution so that panels are drawn quickly."""
    monkeypatch.setattr(map_figure, "PDF_DPI", 40)


def list_objects(directory: Path, class_name: str, vertices: list[int]) -> None:
    """Write an instances.json with one object per vertex count in `vertices`."""
    expected = {"class": class_name, "confidence": 0.9, "class_probabilities": {class_name: 1.0}, "observations": 5}
    box = {"center": [0, 0, 0], "extent": [1, 1, 1], "rotation": np.eye(3).tolist()}
    expected |= {"first_frame": 0, "last_frame": 9, "centroid": [0, 0, 0], "obb": box}
    entries = [{"id": k, **expected, "vertices": number} for k, number in enumerate(vertices, start=1)]
    (directory / "instances.json").write_text(json.dumps(entries))


def run(root: Path, row: str, scene: str, frames: int = 20) -> Path:
    """Write the outputs of a run in which both boxes were found."""
    directory = root / f"dataset.scene={scene},row={row},seed=0"
    directory.mkdir(parents=True)
    room = {"_target_": "tests.support.scenes.boxes_room.BoxesRoom", "scene": scene}
    config = {"row": row, "seed": 0, "dataset": room}
    (directory / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    mesh, poses = furnished(), walk()[:frames]
    write_mesh(directory / "mesh.ply", mesh)
    list_objects(directory, "chair", [1538, 1538])
    write_tum(directory / "trajectory.txt", np.arange(len(poses)) / 30, poses)
    times = [f"{k},{stage},{ms}" for k in range(frames) for stage, ms in STAGE_MS]
    (directory / "timings.csv").write_text("\n".join(["frame,stage,milliseconds", *times]) + "\n")
    metrics: dict[str, Any] = {
        **{"frames": frames, "instances.count": 2, "instances.ap50": 0.5, "annotation_release": "made up"},
        **{"config_hash": config_hash(config), "git_commit": "1234567890", "git_dirty": False},
        **{"environment.cpus": 2, "environment.processor": "Z80"},
    }
    (directory / "metrics.json").write_text(json.dumps(metrics))
    return directory


def experiment(root: Path, rows: Mapping[str, list[str]] = ROWS, **figure: Any) -> Path:
    root.mkdir()
    config = {"rows": rows, "figure": figure, "table": {"columns": ["fps"]}}
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(config)))
    return root


def texts(root: Path) -> list[str]:
    """Return all texts of the page, including the texts of diagrams."""
    pictured = Pictured.below(root)
    page = DRAWN[pictured.choice.kind](pictured)
    found = [*page.figure.texts, *(text for axes in page.figure.axes for text in axes.texts)]
    return [text.get_text() for text in found]


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """Write the runs of two rows on two sequences and return their folder. One run of the first row failed."""
    root = experiment(tmp_path / "figure4", kind="maps", names={"part": "in progress"})
    run(root, "part", "011", frames=8)
    run(root, "whole", "011")
    run(root, "whole", "206")
    failed = root / "dataset.scene=206,row=part,seed=0"
    failed.mkdir()
    (failed / "instancemap.log").write_text("12:00:00 ERROR   the map is full\n")
    return root


def test_write_figure_output_files_are_deterministic(maps: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    paths = write_figure(maps)
    assert [path.name for path in paths] == ["figure.png", "figure.pdf"]
    assert sorted(path.name for path in maps.iterdir() if path.is_file()) == [
        "figure.pdf",
        "figure.png",
        "multirun.yaml",
    ]
    first = [path.read_bytes() for path in paths]
    width, height = Image.open(paths[0]).size
    assert width == pytest.approx(181 / 25.4 * 200, abs=1)  # 181 mm at 200 dpi
    assert height > 400
    assert first[1].startswith(b"%PDF")
    [message] = [record.getMessage() for record in caplog.records]
    assert "dataset.scene=206,row=part,seed=0: failed: the map is full" in message
    assert "in progress without 206" in message
    assert "\n" not in message
    write_figure(maps)
    assert [path.read_bytes() for path in paths] == first


def test_map_figure_has_sequences_as_lines_and_rows_as_columns(maps: Path) -> None:
    found = texts(maps)
    for text in ("in progress", "whole", "ground truth", "011", "206", "8 frames, 2 instances, AP50 0.50"):
        assert found.count(text) == 1
    assert found.count("20 frames, 2 instances, AP50 0.50") == 2
    assert found.count("2 instances") == 2
    assert found.count("incomplete") == 1
    [note] = [text for text in found if text.startswith("An object")]
    for message in ("Data: dataset=unknown, annotation made up", "2 cores of Z80", "code 1234567."):
        assert message in " ".join(note.split())


def test_figure_note_names_overrides_and_data(maps: Path) -> None:
    sweep = OmegaConf.load(maps / "multirun.yaml")
    task = ["experiment=figure4_progress", "dataset.stride=3", "figure.zoom=true", "launcher=joblib", "seed=0"]
    (maps / "multirun.yaml").write_text(OmegaConf.to_yaml({**sweep, "hydra": {"overrides": {"task": task}}}))
    [note] = [text for text in texts(maps) if text.startswith("An object")]
    expected = "annotation made up; 8 to 20 frames per run. Command line: dataset.stride=3 seed=0. 2 cores"
    assert expected in " ".join(note.split())


def test_map_figure_omits_rows_that_were_not_requested(tmp_path: Path) -> None:
    root = experiment(tmp_path / "figure4", {"part": [], "whole": [], "paper": [], "last": []}, kind="maps")
    run(root, "part", "011")
    run(root, "paper", "011")  # by an earlier sweep
    sweep = OmegaConf.load(root / "multirun.yaml")
    task = {"overrides": {"task": ["row=part,whole"]}}
    (root / "multirun.yaml").write_text(OmegaConf.to_yaml({**sweep, "hydra": task}))
    assert [*Pictured.below(root).rows] == ["part", "whole", "paper"]


def test_map_figure_labels_damaged_map_and_missing_truth(maps: Path, caplog: pytest.LogCaptureFixture) -> None:
    (maps / "dataset.scene=011,row=part,seed=0" / "mesh.ply").write_bytes(b"ply\n")
    run(maps, "whole", "gone")
    found = texts(maps)
    assert (found.count("incomplete"), found.count("no ground truth")) == (3, 1)
    message = [record.getMessage() for record in caplog.records]
    assert len(message) == 2
    assert "mesh.ply" in message[0]
    assert message[1].endswith("expected an existing scene, got none")


@pytest.mark.parametrize("vertices", [[1538], [1538, 7]])
def test_map_figure_inconsistent_objects_are_not_drawn(
    maps: Path, caplog: pytest.LogCaptureFixture, vertices: list[int]
) -> None:
    list_objects(maps / "dataset.scene=011,row=part,seed=0", "bed", vertices)
    texts(maps)
    assert "repeat the run, because the files are from different runs" in caplog.text


def test_map_figure_has_one_line_per_seed(tmp_path: Path) -> None:
    root = experiment(tmp_path / "figure4", kind="maps", sequences="seed")
    run(root, "whole", "011")
    assert "0" in texts(root)
    root = experiment(tmp_path / "again", kind="maps")
    for seed in (0, 1):
        directory = run(root / str(seed), "whole", "011")
        config = OmegaConf.to_container(OmegaConf.load(directory / "config.yaml"))
        assert isinstance(config, dict)
        config["seed"] = seed
        (directory / "config.yaml").write_text(OmegaConf.to_yaml(config))
        metrics = json.loads((directory / "metrics.json").read_text())
        metrics["config_hash"] = config_hash({str(key): value for key, value in config.items()})
        (directory / "metrics.json").write_text(json.dumps(metrics))
    assert {"011, seed 0", "011, seed 1"} <= set(texts(root))


def test_map_figure_zoom_adds_second_line(tmp_path: Path) -> None:
    root = experiment(tmp_path / "figure5", kind="maps", zoom=True)
    directory = run(root, "part", "011")
    list_objects(directory, "chair", [1538])
    metrics = json.loads((directory / "metrics.json").read_text())
    (directory / "metrics.json").write_text(json.dumps(metrics | {"instances.count": 1}))
    run(root, "whole", "011")
    pictured = Pictured.below(root)
    page = DRAWN["maps"](pictured)
    assert len(page.figure.axes) == 6
    assert [len(axes.patches) for axes in page.figure.axes] == [1, 1, 1, 0, 0, 0]  # the border of the zoom window
    names = [[text.get_text() for text in axes.texts] for axes in page.figure.axes[3:]]
    assert all("chair" in one for one in names[1:])


def test_stage_times_figure_averages_sequences(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = experiment(tmp_path / "figure3", kind="stage_times", names={"whole": "ours"})
    run(root, "whole", "011")
    run(root, "whole", "206", frames=12)
    (run(root, "whole", "300") / "timings.csv").write_text("frame,stage,milliseconds\n0,integration,x\n")
    paths = write_figure(root)
    assert Image.open(paths[0]).size[0] == pytest.approx(88 / 25.4 * 200, abs=1)
    assert [record.getMessage() for record in caplog.records][1].endswith("got '0,integration,x'")
    found = texts(root)
    assert {"GMM", "map integration", "30 ms", "incomplete"} <= set(found)
    assert "tracking" not in found
    note = " ".join(found[0].split())
    assert "map integration: update and integration. Lines: mean over 2 sequences (011, 206) " in note
    assert "Lines end at the last frame of the shortest sequence." in note
    assert "annotation made up; 12 to 20 frames per run." in note


@pytest.mark.parametrize(
    ("figure", "message"),
    [
        ({"kind": "pie"}, r"figure\.kind: expected one of stage_times, maps, bar, .*, got 'pie'"),
        ({"kind": "stage_times", "zoom": True}, r"figure\.kind: expected maps with figure\.zoom=true, got stage_times"),
        ({"colour": "red"}, "figure: expected one of kind, sequences, names, zoom, .*, got 'colour'"),
        ("maps", "figure: expected keys and values"),
    ],
)
def test_figure_choice_invalid_settings_raise_one_line_error(figure: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        FigureChoice.of(figure)
    assert "\n" not in str(caught.value)


def test_write_figure_without_data_raises_one_line_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a folder of runs, got no folder"):
        write_figure(tmp_path / "nowhere")
    with pytest.raises(DataError, match=r"expected a sweep with a figure, got none; add figure\.kind=bar"):
        write_figure(tmp_path)
    root = experiment(tmp_path / "none")
    with pytest.raises(DataError, match="expected a sweep with a figure, got none"):
        write_figure(root)
    for kind, name in (("maps", "mesh.ply"), ("stage_times", "timings.csv")):
        root = experiment(tmp_path / kind, kind=kind)
        with pytest.raises(DataError, match="expected a completed run, got none"):
            write_figure(root)
        (run(root, "whole", "011") / name).write_text("")
        with pytest.raises(DataError, match=r"expected a readable .*, got none; see the log for the reasons"):
            write_figure(root)
        assert not list(root.glob("figure.*"))


def test_figures_command_prints_paths_and_errors(
    maps: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["figures", str(maps), str(maps / "nowhere")])
    with pytest.raises(SystemExit) as ended:
        figures.main()
    printed = capsys.readouterr()
    assert ended.value.code == 1
    assert printed.out.splitlines() == [str(maps / "figure.png"), str(maps / "figure.pdf")]
    assert printed.err.splitlines()[-1] == f"error: {maps / 'nowhere'}: expected a folder of runs, got no folder"


@pytest.mark.parametrize("error", [None, RuntimeError("a worker failed"), KeyboardInterrupt()])
def test_sweep_writes_figure_except_after_ctrl_c(
    maps: Path, error: BaseException | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("signal.signal", lambda *_: None)  # a sweep changes the signal handlers of the process
    monkeypatch.setenv("PYTHONWARNINGS", "")
    with suppress(InstanceMapError, KeyboardInterrupt), sweep_in(maps, with_table=False, with_figure=True):
        if error is not None:
            raise error
    assert len(list(maps.glob("figure.*"))) == (0 if isinstance(error, KeyboardInterrupt) else 2)


@pytest.mark.parametrize("count", [2, 5])
def test_map_figure_long_names_do_not_overlap(tmp_path: Path, count: int) -> None:
    rows = [f"final map without plane_removal, gmm_em_and_connected_components_{k}" for k in range(count)]
    root = experiment(tmp_path / "figure4", rows={row: [] for row in rows}, kind="maps")
    name = "rgbd_dataset_freiburg3_long_office_household_validation"
    for row in rows:
        run(root, row, name)
    run(root, rows[0], "011", frames=8)
    pictured = Pictured.below(root)
    check_layout(DRAWN[pictured.choice.kind](pictured))
