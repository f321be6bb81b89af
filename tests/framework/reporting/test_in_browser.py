"""Tests for the report page in a browser without network access."""

from __future__ import annotations

import io
import json
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import instancemap
from framework.commands.results import edit
from framework.commands.results.report import write_reports
from framework.config import composition
from framework.runs.instances_file import read_instances
from tests.support.reported_run import FAKES, rename_class, unverified_copy, write_run

pytestmark = pytest.mark.integration

CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
HOSTILE = "<img src=x onerror=alert(1)>"
PLACE_OF = """id => {
    const { shown, camera, canvas } = window.report.viewer;
    const { geometry } = shown.parts.get(id);
    geometry.computeBoundingBox();
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const at = geometry.boundingBox.getCenter(new THREE.Vector3()).project(camera);
    return [left + width * (at.x + 1) / 2, top + height * (1 - at.y) / 2];
}"""

SHOWN_AT = """id => {
    const { viewer } = window.report;
    const { left, top, width, height } = viewer.canvas.getBoundingClientRect();
    for (let y = top + 16; y < Math.min(top + height, innerHeight); y += 16)
        for (let x = left + 16; x < left + width; x += 16)
            if ([id, 4, -4].every((step, k) => viewer.objectAt(k ? x + step : x, y) === id)) return [x, y];
}"""
"""Returns a position in the window, px, where an object is visible."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: pip install --group test")
    if not Path(CHROMIUM).exists():
        pytest.skip(f"{CHROMIUM} does not exist")
    with playwright.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield found
        found.close()


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return the pages of two runs and of their comparison. A class name of the second run contains HTML."""
    folder = tmp_path_factory.mktemp("runs")
    first = write_run(folder / "first")
    second = unverified_copy(first, folder / "second")
    rename_class(second, HOSTILE)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [FAKES])
        return write_reports([first, second])


@pytest.fixture(scope="module")
def divided(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run with four instances: 1 and 3 are parts of the chair, 2 and 4 are parts of the couch."""
    folder = tmp_path_factory.mktemp("divided runs")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [FAKES])
        run = write_run(folder / "room")
        out = instancemap.edit(run, [{"split": [1, "plane"]}, {"split": [2, "plane"]}], out=folder / "divided room")
        write_reports([out])
    return out


@pytest.fixture
def opened(browser: Any) -> Iterator[Any]:
    """Return a function that opens a page offline. After the test, check that there were no requests and no errors."""
    contexts, faults = [], []

    def open_page(path: Path, **options: Any) -> Any:
        context = browser.new_context(offline=True, **({"viewport": {"width": 1280, "height": 900}} | options))
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("dialog", lambda dialog: faults.append(f"a dialog: {dialog.message}"))
        page.on("request", lambda asked: None if asked.url == path.as_uri() else requests.append(asked.url))
        requests: list[str] = []
        page.goto(path.as_uri())
        page.wait_for_selector("body[data-ready]", timeout=30_000)
        faults.extend(url for url in requests if not url.startswith(("data:", "blob:")))
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not faults


def canvas(page: Any) -> np.ndarray:
    """Return the RGB image (H, W, 3) of the map."""
    page.wait_for_timeout(150)  # until the next frame is rendered
    picture = page.locator("#canvas").screenshot()
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(int)


def colored(image: np.ndarray) -> float:
    """Return the fraction of colored pixels."""
    return float((np.ptp(image, axis=2) > 60).mean())


def test_report_click_on_object_shows_details(pages: list[Path], opened: Any, tmp_path: Path) -> None:
    page = opened(pages[0])
    before = canvas(page)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 200, "expected an image on the canvas"
    assert page.locator("#panel .details").count() == 0
    first = page.evaluate("report.objects[0]")
    page.mouse.click(*page.evaluate(PLACE_OF, first["id"]))
    panel = page.inner_text("#panel")
    for text in (
        first["class"],
        first["size"],
        first["place"],
        f"{first['confidence']:.2f}",
        "Class probabilities",
        "Truth",
    ):
        assert text in panel
    assert page.locator("#panel img").count() == 1
    row = page.locator(f"tr[data-id='{first['id']}']")
    assert row.get_attribute("aria-selected") == "true"
    assert np.abs(canvas(page) - before).max() > 30, "expected a highlighted object"
    page.screenshot(path=tmp_path / "chosen.png", full_page=True)
    assert (tmp_path / "chosen.png").stat().st_size > 50_000
    page.get_by_label("Clear selection").click()
    assert page.locator("#panel .details").count() == 0


def test_report_view_buttons_change_map_colors(pages: list[Path], opened: Any) -> None:
    page = opened(pages[0])
    own = canvas(page)
    page.get_by_role("button", name="Instances").click()
    instances = canvas(page)
    assert page.get_by_role("button", name="Instances").get_attribute("aria-pressed") == "true"
    assert np.abs(instances - own).max() > 60
    page.locator("#confidence").fill("1")
    assert page.inner_text("#confidence-value") == "1.00"
    assert colored(canvas(page)) < 0.5 * colored(instances), "expected paler colors: no object has confidence 1"
    page.get_by_role("button", name="Classes").click()
    assert page.locator("#legend button").count() == 0
    page.locator("#confidence").fill("0")
    assert page.locator("#legend button").count() > 0


def test_report_time_slider_limits_visible_map(pages: list[Path], opened: Any) -> None:
    page = opened(pages[0])
    page.locator("#path").uncheck()
    void = np.array(Image.new("RGB", (1, 1), "#e5e8ec"))[0, 0]
    shown = []
    for time in ("0", "500", "1000"):
        page.locator("#time").fill(time)
        shown.append(float((np.abs(canvas(page) - void).max(axis=2) > 12).mean()))
    assert 0.02 < shown[0] <= shown[1] < shown[2]
    assert page.inner_text("#time-value") == "frame 5"


def test_report_table_is_sorted_searched_and_selected_by_keys(pages: list[Path], opened: Any) -> None:
    page = opened(pages[0])
    rows = page.locator("#objects-table tbody tr:not([hidden])")
    ids = [row.get_attribute("data-id") for row in rows.all()]
    assert len(ids) > 1
    page.get_by_role("button", name="Object", exact=True).click()
    by_name = rows.evaluate_all("rows => rows.map(row => row.cells[1].dataset.value)")
    assert by_name == sorted(by_name)
    page.get_by_role("button", name="Size, cm").click()
    sizes = rows.evaluate_all("rows => rows.map(row => Number(row.cells[4].dataset.value))")
    assert sizes == sorted(sizes, reverse=True)
    page.get_by_role("button", name="Size, cm").click()
    assert page.locator("th[aria-sort='ascending']").inner_text().startswith("Size")
    assert rows.evaluate_all("rows => rows.map(row => Number(row.cells[4].dataset.value))") == sorted(sizes)
    before = page.evaluate("window.report.viewer.camera.position.toArray()")
    rows.nth(0).focus()
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    chosen = rows.nth(1).get_attribute("data-id")
    assert rows.nth(1).get_attribute("aria-selected") == "true"
    assert page.locator("#panel h3").inner_text().endswith(str(chosen))
    # wait_for_function uses eval, which the policy forbids
    while page.evaluate("Boolean(window.report.viewer.flight)"):
        page.wait_for_timeout(50)
    after = page.evaluate("window.report.viewer.camera.position.toArray()")
    assert np.linalg.norm(np.subtract(after, before)) > 0.05, "expected the camera to move"
    page.locator("#search").fill(str(chosen))
    assert rows.count() >= 1
    page.locator("#search").fill("no such thing")
    assert rows.count() == 0
    assert page.inner_text("#count").startswith("0 of")


def test_report_fits_phone_screen_and_dark_mode(pages: list[Path], opened: Any) -> None:
    page = opened(pages[0], viewport={"width": 390, "height": 844}, color_scheme="dark")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert max(page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)")) < 60
    assert np.median(canvas(page)) < 120


def test_report_malicious_class_name_is_escaped(pages: list[Path], opened: Any) -> None:
    page = opened(pages[1])
    page.locator("#objects-table tbody tr").filter(has_text="<img").click()
    assert HOSTILE in page.inner_text("#panel h3")
    assert page.locator("img[src='x']").count() == 0


def test_report_comparison_switches_runs_and_keeps_view(pages: list[Path], opened: Any) -> None:
    page = opened(pages[2])
    page.locator("#canvas").focus()
    page.keyboard.press("ArrowLeft")
    before = page.evaluate("window.report.viewer.camera.position.toArray()")
    page.get_by_role("button", name="second", exact=True).click()
    assert page.evaluate("window.report.viewer.shown === window.report.viewer.maps[1]")
    assert page.evaluate("window.report.viewer.camera.position.toArray()") == pytest.approx(before, abs=1e-3)
    assert HOSTILE in page.inner_text("#legend") or page.locator("#legend button").count() == 0
    assert len(np.unique(canvas(page).reshape(-1, 3), axis=0)) > 200
    page.get_by_role("link", name="first").click()
    page.wait_for_selector("body[data-ready]", timeout=30_000)
    assert page.url == pages[0].as_uri()


def test_report_without_webgl_shows_still_image(pages: list[Path], browser: Any) -> None:
    context = browser.new_context(offline=True)
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null;")
    page = context.new_page()
    page.goto(pages[0].as_uri())
    page.wait_for_selector("body[data-ready]", timeout=30_000)
    assert page.locator("#canvas").is_hidden()
    assert page.locator(".still").is_visible()
    assert page.evaluate("document.querySelector('.still').naturalWidth") > 1000
    page.locator("#objects-table tbody tr").first.click()
    assert "Class probabilities" in page.inner_text("#panel")
    page.get_by_role("button", name="Edit", exact=True).click()
    page.locator("#objects-table tbody tr").first.click()
    page.get_by_role("button", name="Delete", exact=True).click()
    assert "deleted" in page.locator("#objects-table tbody tr").first.inner_text()
    context.close()


def row(page: Any, key: int) -> Any:
    return page.locator(f"tr[data-id='{key}']")


def click_map(page: Any, key: int) -> None:
    page.mouse.click(*page.evaluate(SHOWN_AT, key))


def downloaded_edits(page: Any, path: Path) -> list[Any]:
    with page.expect_download() as download:
        page.get_by_role("button", name="Download edits.json").click()
    assert download.value.suggested_filename == "edits.json"
    download.value.save_as(path)
    return list(json.loads(path.read_text()))


def test_report_edits_are_downloaded_and_applied(
    divided: Path, opened: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = opened(divided / "report.html")
    before = canvas(page)
    page.get_by_role("button", name="Edit", exact=True).click()
    page.locator("#map").evaluate("map => map.scrollIntoView()")
    click_map(page, 3)
    click_map(page, 1)
    assert page.inner_text("#edit-selection") == "Selected: chair 3, chair 1"
    click_map(page, 3)
    click_map(page, 3)
    assert page.inner_text("#edit-selection") == "Selected: chair 1, chair 3", "the order of the clicks"
    assert row(page, 3).get_attribute("aria-selected") == "true"
    page.get_by_role("button", name="Merge", exact=True).click()
    assert row(page, 3).inner_text().split("\n")[1].split("\t")[0] == "merged into 1"
    assert page.evaluate("new Set(window.report.viewer.maps[0].data.objects.map(one => one.color)).size") == 4
    paints = page.evaluate("[1, 3].map(id => window.report.viewer.shown.parts.get(id).material.uniforms.paint.value)")
    assert paints[0] == paints[1]
    click_map(page, 3)
    assert page.locator("#edit-selection").inner_text().startswith("Select objects"), "a click on 3 deselects 1"
    row(page, 2).click()
    page.get_by_label("Class", exact=True).fill("chair")
    page.get_by_label("Class", exact=True).press("Enter")
    assert row(page, 2).locator("b").inner_text() == "chair"
    assert "chair 2" in page.inner_text(".labels")
    row(page, 2).click()
    row(page, 4).click()
    page.get_by_role("button", name="Delete", exact=True).click()
    row(page, 1).click()
    page.get_by_role("button", name="Delete", exact=True).click()
    assert "deleted" in row(page, 3).inner_text()
    page.get_by_role("button", name="Undo").click()
    assert "merged into 1" in row(page, 3).inner_text()
    edits = [{"merge": [1, 3]}, {"rename": [2, "chair"]}, {"delete": [4]}]
    assert downloaded_edits(page, tmp_path / "edits.json") == edits
    names = page.evaluate("[...window.report.editing.edited.instances].map(([id, one]) => [id, one.names])")
    assert names == [[1, ["chair"]], [2, ["chair"]]]
    assert np.abs(canvas(page) - before).max() > 60

    words = shlex.split(page.inner_text("#edit-command"))
    assert words[:2] == ["instancemap", "edit"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", words[1:])
    monkeypatch.setattr(composition, "_added", [FAKES])
    edit.main()
    result = divided.with_name("divided room_edited")
    [first, second] = read_instances(result / "instances.json")
    assert [(one.id, one.class_name) for one in (first, second)] == [(1, "chair"), (2, "chair")]
    sizes = {one.id: one.vertices for one in read_instances(divided / "instances.json")}
    assert first.vertices == pytest.approx(sizes[1] + sizes[3], abs=5), "vertices between the parts change"
    assert second.vertices == pytest.approx(sizes[2], abs=5)
    assert json.loads((result / "edits.json").read_text()) == edits


def test_report_without_editing_mode_is_unchanged(divided: Path, opened: Any) -> None:
    page = opened(divided / "report.html")
    table, before = page.inner_html("#objects-table"), canvas(page)
    assert page.locator("#editor").is_hidden()
    page.get_by_role("button", name="Edit", exact=True).click()
    row(page, 4).click()
    page.get_by_role("button", name="Delete", exact=True).click()
    row(page, 2).click()
    page.get_by_label("Close the editing mode").click()
    assert page.locator("#editor").is_hidden()
    row(page, 1).click()
    page.get_by_label("Clear selection").click()
    page.evaluate("window.report.viewer.reset()")
    assert 'aria-selected="true"' not in page.inner_html("#objects-table")
    assert page.inner_html("#objects-table").replace(' aria-selected="false"', "").replace(' class=""', "") == table
    page.mouse.move(0, 0)
    page.evaluate("scrollTo(0, 0)")
    assert np.array_equal(canvas(page), before)
    page.get_by_role("button", name="Edit", exact=True).click()
    assert "deleted" in row(page, 4).inner_text(), "the edits are kept"


def test_report_impossible_edits_are_disabled(divided: Path, opened: Any) -> None:
    page = opened(divided / "report.html")
    page.get_by_role("button", name="Edit", exact=True).click()
    buttons = {name: page.locator(f"#edit-{name}") for name in ("merge", "parts", "rename", "delete", "undo", "save")}

    def reasons() -> dict[str, str]:
        return {name: one.get_attribute("title") for name, one in buttons.items() if one.is_disabled()}

    nothing = {"undo": "There are no edits", "save": "There are no edits"}
    select = dict.fromkeys(("parts", "rename", "delete"), "Select an object")
    assert reasons() == select | nothing | {"merge": "Select two or more objects"}
    row(page, 1).focus()
    page.keyboard.press("Enter")
    assert reasons() == nothing | {"merge": "Select two or more objects", "rename": "Enter a class name"}
    page.locator("#edit-name").fill("  ")
    assert reasons()["rename"] == "Enter a class name"
    page.locator("#edit-name").fill("a\u200bb")
    assert reasons()["rename"] == "Enter a name without control characters"
    row(page, 2).click()
    single = dict.fromkeys(("parts", "rename"), "Select a single object")
    assert reasons() == nothing | single
    page.keyboard.press("Escape")
    assert reasons() == select | nothing | {"merge": "Select two or more objects"}
    row(page, 1).click()
    buttons["delete"].click()
    row(page, 1).click()
    assert page.inner_text("#edit-selection").startswith("Select objects"), "deleted objects cannot be selected"
    assert reasons() == select | {"merge": "Select two or more objects"}


def test_report_new_class_and_splits_are_listed(divided: Path, opened: Any, tmp_path: Path) -> None:
    page = opened(divided / "report.html", viewport={"width": 390, "height": 844})
    page.get_by_role("button", name="Edit", exact=True).click()
    row(page, 1).click()
    page.locator("#edit-name").fill(f"  {HOSTILE} ")
    page.locator("#edit-rename").click()
    page.get_by_role("button", name="Split into parts").click()
    page.get_by_role("button", name="Split by plane").click()
    items = page.locator("#edit-list li").all_inner_texts()
    assert [item.removesuffix("×").strip() for item in items] == [
        f"Rename 1 to {HOSTILE} (new class)",
        "Split 1 into parts",
        "Split 1 by plane",
    ]
    assert "was chair; split into parts; split by plane" in row(page, 1).inner_text()
    page.get_by_label("Remove edit 2").click()
    assert page.locator("#edit-apply").is_hidden()
    edits = [{"rename": [1, HOSTILE]}, {"split": [1, "plane"]}]
    assert downloaded_edits(page, tmp_path / "edits.json") == edits
    assert page.locator("#edit-apply").is_visible()
    page.locator("#edit-name").fill(120 * "x")
    page.locator("#edit-rename").click()
    assert page.locator("#edit-apply").is_hidden(), "the downloaded file is outdated"
    assert row(page, 1).locator("b").inner_text() == 100 * "x"
    assert page.evaluate("document.documentElement.scrollWidth") == 390


def test_report_without_map_is_edited_in_table(divided: Path, opened: Any, tmp_path: Path) -> None:
    run = Path(shutil.copytree(divided, tmp_path / "no mesh"))
    (run / "mesh.ply").unlink()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(composition, "_added", [FAKES])
        [path] = write_reports([run])
    page = opened(path)
    assert page.locator("#canvas").count() == 0
    page.get_by_role("button", name="Edit", exact=True).press("Enter")
    for key in (4, 2):
        row(page, key).focus()
        page.keyboard.press("Space")
    page.get_by_role("button", name="Merge", exact=True).click()
    colors = [row(page, key).locator(".swatch rect").get_attribute("fill") for key in (2, 4)]
    assert colors[0] == colors[1]
    assert downloaded_edits(page, tmp_path / "edits.json") == [{"merge": [4, 2]}]


def test_report_merge_of_classes_shows_possible_names(divided: Path, opened: Any) -> None:
    """The command derives the class of a merged instance from all detections. A renamed class is certain."""
    page = opened(divided / "report.html")
    name = """edits => {
        const edited = new EditedInstances(report.objects, edits);
        return edited.name(1);
    }"""
    assert page.evaluate(name, [{"merge": [1, 2]}]) == "chair or couch"
    assert page.evaluate(name, [{"rename": [2, "couch"]}, {"merge": [1, 2]}]) == "couch"
    assert page.evaluate(name, [{"merge": [1, 2]}, {"rename": [1, "bench"]}]) == "bench"
