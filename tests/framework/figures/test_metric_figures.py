"""Tests of the figures of a metric: bars, boxes, trade-offs, curves, progress and class heat maps."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from framework.commands.results import figures
from framework.errors import ConfigError, DataError
from framework.figures.experiment_figure import write_figure
from framework.figures.figure_choice import OF_METRIC
from tests.support.metric_runs import AP50, check_layout, list_detections, page, run, sweep, texts

LONG = "chain_without_plane_removal_and_without_lloyd_iterations_{k}"
CLASSES = ("chair", "couch", "dining table", "potted plant", "bed", "refrigerator", "tv", "toilet")


def of_size(root: Path, rows: int, seeds: int = 3) -> Path:
    """Write the runs of an experiment with long names; the second row of several has no run."""
    names = [LONG.format(k=k) if k % 2 else f"row_{k}" for k in range(rows)]
    sweep(root, names, ["seed=0,1,2", "dataset.stride=3"])
    generator = np.random.default_rng(0)
    for k, row in enumerate(names):
        for seed in range(0 if k == 1 and rows > 2 else seeds):
            ap = 0.4 + 0.03 * k + generator.normal(0, 0.02)
            of_classes = {f"{AP50}.{name}": ap for name in CLASSES[: seed + 5]}
            counts = {f"instances.true_count.{name}": 10 for name in CLASSES}
            directory = run(root, {AP50: ap, "fps": 20.0 - k, **of_classes, **counts}, seed, row=row)
            list_detections(directory, generator.integers(0, 20, 5 + k).tolist())
    return root


@pytest.mark.integration
@pytest.mark.parametrize(("rows", "seeds", "page_columns"), [(1, 1, 1), (2, 3, 1), (12, 3, 1), (12, 3, 2)])
@pytest.mark.parametrize("kind", OF_METRIC)
def test_metric_figure_texts_do_not_overlap(
    tmp_path: Path, kind: str, rows: int, seeds: int, page_columns: int
) -> None:
    root = of_size(tmp_path / "sweep", rows, seeds)
    more = ["figure.x=seed"] if kind == "curve" else []
    drawn = page(root, f"figure.kind={kind}", f"figure.page_columns={page_columns}", *more)
    check_layout(drawn)
    width = drawn.figure.get_figwidth() * 25.4
    assert width == pytest.approx({1: 88, 2: 181}[page_columns])
    assert any("Data: dataset=synthetic; " in text and "Command line: " in text for text in texts(drawn))


def bar_ends(root: Path, *overrides: str) -> list[float]:
    drawn = page(root, "figure.kind=bar", *overrides)
    return [patch.get_width() for patch in drawn.figure.axes[-1].patches]


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """Write the runs of a sweep over two refiners, two detectors and three seeds; AP50 is 0.1 to 0.6."""
    root = sweep(tmp_path / "plain", task=["refiner=a,b", "detector=x,y", "seed=0,1,2"])
    for r, refiner in enumerate("ab"):
        for d, detector in enumerate("xy"):
            for seed in range(3):
                run(root, {AP50: 0.1 + 0.1 * seed + 0.3 * r, "fps": 10 + d}, seed, refiner=refiner, detector=detector)
    return root


def test_bar_figure_shows_mean_of_each_row(plain: Path) -> None:
    assert bar_ends(plain) == pytest.approx([0.2, 0.2, 0.5, 0.5])
    found = texts(page(plain, "figure.kind=bar"))
    for text in ("refiner=a, detector=x", "refiner=b, detector=y"):
        assert found.count(text) == 1
    assert found.count("n = 3") == 4
    assert any("Runs of one bar differ in seed." in text for text in found)


def test_bar_figure_groups_runs_by_key_and_color(plain: Path) -> None:
    assert bar_ends(plain, "figure.by=refiner") == pytest.approx([0.2, 0.5])
    assert bar_ends(plain, "figure.by=detector") == pytest.approx([0.35, 0.35])
    assert bar_ends(plain, "figure.by=detector", "figure.metric=fps") == pytest.approx([10, 11])
    split = ["figure.by=detector", "figure.color_by=refiner", "figure.names={a: without, b: with}"]
    assert bar_ends(plain, *split) == pytest.approx([0.2, 0.5, 0.2, 0.5])
    found = texts(page(plain, "figure.kind=bar", *split))
    assert {"x", "y", "without", "with"} <= set(found)
    found = texts(page(plain, "figure.kind=bar", "figure.by=refiner"))
    assert found.count("n = 6") == 2
    assert any("Runs of one bar differ in detector, seed." in text for text in found)


def test_bar_figure_interval_requires_six_runs(plain: Path) -> None:
    without = page(plain, "figure.kind=bar").figure.axes[-1]
    of_six = page(plain, "figure.kind=bar", "figure.by=refiner").figure.axes[-1]
    assert len(without.collections) == 0
    assert len(of_six.collections) == 2  # error bars
    low, high = of_six.collections[0].get_segments()[0][:, 0]
    assert 0.1 < low < 0.2 < high < 0.3


def test_bar_figure_shows_requested_values_without_runs(tmp_path: Path) -> None:
    root = sweep(tmp_path / "sweep", task=["refiner=c,b,a"])
    run(root, {AP50: 0.5}, refiner="a")
    run(root, {AP50: None}, refiner="b")
    found = texts(page(root, "figure.kind=bar", "figure.by=refiner"))
    assert [text for text in found if text in ("a", "b", "c")] == ["c", "b", "a"]
    assert (found.count("n = 1"), found.count("n = 0")) == (1, 2)


def test_bar_figure_sorts_numbers_by_value(tmp_path: Path) -> None:
    root = sweep(tmp_path / "sweep", task=["dataset.stop=100,9"])
    for stop in (100, 9):
        run(root, {AP50: stop / 1000}, dataset={"scene": "office", "stop": stop})
    assert bar_ends(root, "figure.by=dataset.stop") == pytest.approx([0.009, 0.1])


def test_box_figure_shows_quartiles(plain: Path) -> None:
    axes = page(plain, "figure.kind=box", "figure.by=refiner").figure.axes[-1]
    extents = [patch.get_path().get_extents() for patch in axes.patches]
    assert [(box.x0, box.x1) for box in extents] == [pytest.approx((0.125, 0.275)), pytest.approx((0.425, 0.575))]


def test_tradeoff_figure_shows_front_and_names(plain: Path) -> None:
    drawn = page(plain, "figure.kind=tradeoff")
    found = texts(drawn)
    assert {"refiner=a, detector=x", "refiner=b, detector=y"} <= set(found)
    assert any("of each row (n = 3). Dashed line: Pareto front" in text for text in found)
    [front] = [line for line in drawn.figure.axes[0].lines if line.is_dashed()]
    assert 11 in front.get_xdata()
    assert max(front.get_ydata()) == pytest.approx(0.5)
    found = texts(page(plain, "figure.kind=tradeoff", "figure.x=frames"))
    assert any("No Pareto front: frames without a direction" in text for text in found)


def test_curve_figure_shows_means_by_parameter(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = sweep(tmp_path / "sweep", task=["dataset.stop=10,20,null", "refiner=a,b", "seed=0,1"])
    for refiner, base in (("a", 0.1), ("b", 0.3)):
        for stop in (20, 10, None):
            for seed in range(2):
                dataset = {"scene": "office", "stop": stop}
                run(root, {AP50: base + 0.01 * (stop or 0) + 0.1 * seed}, seed, refiner=refiner, dataset=dataset)
    drawn = page(root, "figure.kind=curve", "figure.x=dataset.stop", "figure.by=refiner")
    lines = [line for line in drawn.figure.axes[0].lines if line.get_marker() == "o"]
    assert [line.get_xdata().tolist() for line in lines] == [[10, 20]] * 2
    assert [line.get_ydata().tolist() for line in lines] == [pytest.approx([0.25, 0.35]), pytest.approx([0.45, 0.55])]
    band = drawn.figure.axes[0].collections[0].get_paths()[0].get_extents()
    assert (band.y0, band.y1) == pytest.approx((0.2, 0.4))
    assert sum("dataset.stop is None, not a number" in record.getMessage() for record in caplog.records) == 4
    with pytest.raises(DataError, match=r"figure\.x: expected numbers of refiner in at least one run, got none"):
        page(root, "figure.kind=curve", "figure.x=refiner")


def test_progress_figure_counts_first_detections(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = sweep(tmp_path / "sweep", ["chain"])
    list_detections(run(root, {}, 0, row="chain"), [0, 3, 3], frames=6)
    list_detections(run(root, {}, 1, row="chain"), [1, 5], frames=20)
    run(root, {}, 2, row="chain")
    drawn = page(root, "figure.kind=progress")
    line = drawn.figure.axes[0].lines[0]
    assert line.get_xdata().tolist() == [0, 1, 2, 3, 4, 5]
    assert line.get_ydata().tolist() == [0.5, 1, 1, 2, 2, 2.5]
    assert any("Lines: number of objects of the final map" in text and "n = 2 runs" in text for text in texts(drawn))
    assert "instances.json" in caplog.text


def test_class_heatmap_shows_mean_of_each_class(tmp_path: Path) -> None:
    root = sweep(tmp_path / "sweep", ["chain", "identity", "unstarted"])
    true = {"instances.true_count.chair": 3, "instances.true_count.bed": 1, "instances.true_count.vase": 0}
    for seed in range(2):
        run(root, {f"{AP50}.chair": 0.2 + 0.2 * seed, f"{AP50}.bed": None, **true}, seed, row="chain")
        run(root, {f"{AP50}.chair": 0.9, f"{AP50}.bed": 1.0, **true}, seed, row="identity")
    drawn = page(root, "figure.kind=class_heatmap")
    found = texts(drawn)
    assert {"chair (3)", "bed (1)", "0.30", "0.90", "1.00"} <= set(found)
    assert not any(text.startswith("vase") for text in found)
    assert [bool(patch.get_hatch()) for patch in drawn.figure.axes[0].patches] == [
        False,
        True,
        False,
        False,
        True,
        True,
    ]
    with pytest.raises(DataError, match="expected a metric with values of each class, got fps"):
        page(root, "figure.kind=class_heatmap", "figure.metric=fps")


@pytest.mark.parametrize("kind", ["bar", "box", "tradeoff", "curve"])
def test_metric_figure_unknown_metric_raises(plain: Path, kind: str) -> None:
    more = ["figure.x=seed"] if kind == "curve" else []
    with pytest.raises(
        DataError, match=r"figure\.metric: expected values of .*instances\.ap51.*, got none; "
    ) as caught:
        page(plain, f"figure.kind={kind}", "figure.metric=instances.ap51", *more)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["figure.by=refner"], "figure.by: expected a group of options or a parameter, got refner; did"),
        (["figure.color_by=dataset.scenes"], "figure.color_by: expected a group of options or a parameter, got"),
        (["figure.kind=curve"], "figure.x: expected a numeric key such as dataset.stop, got None"),
        (["figure.kind=maps", "figure.by=refiner"], "figure.kind: expected bar or box or tradeoff or curve"),
        (["figure.x=fps"], "figure.kind: expected tradeoff or curve with figure.x=fps, got bar"),
        (["figure.kind=progress", "figure.metric=fps"], "figure.metric: expected instances.count with"),
        (["figure.page_columns=3"], "figure.page_columns: expected 1, 2 or null, got 3"),
        (["figure.file_name=../x"], "figure.file_name: expected a name without folder, got ../x"),
    ],
)
def test_figure_invalid_settings_raise_one_line_error(plain: Path, overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        page(plain, "figure.kind=bar", *overrides)
    assert str(caught.value).startswith(message)


@pytest.mark.integration
def test_metric_figure_files_are_deterministic_with_embedded_fonts(plain: Path) -> None:
    overrides = ["figure.kind=bar", "figure.by=refiner", "figure.file_name=bars"]
    png, pdf = write_figure(plain, overrides)
    assert (png, pdf) == (plain / "bars.png", plain / "bars.pdf")
    first = png.read_bytes(), pdf.read_bytes()
    assert Image.open(png).width == pytest.approx(88 / 25.4 * 200, abs=1)
    assert b"/FontFile2" in first[1]  # TrueType, type 42
    assert b"/Type3" not in first[1]
    write_figure(plain, overrides)
    assert (png.read_bytes(), pdf.read_bytes()) == first


def test_figures_command_applies_overrides(
    plain: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["figures", str(plain), "figure.kind=bar", "figure.file_name=bars"]
    monkeypatch.setattr(sys, "argv", words)
    figures.main()
    assert capsys.readouterr().out.splitlines() == [str(plain / "bars.png"), str(plain / "bars.pdf")]


def test_missing_groups_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    root = sweep(tmp_path / "sweep", ["chain", "unstarted"])
    run(root, {AP50: 0.5}, row="chain")
    write_figure(root, ["figure.kind=bar"])
    assert [record.getMessage() for record in caplog.records] == ["omitted from the figure: unstarted without runs"]
