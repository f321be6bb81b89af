"""Tests for docs/gallery.md and docs/gallery/picture.py."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from framework.exporting.exports import ExportFormat, export
from framework.exporting.object_meshes import linear
from framework.exporting.upright_room import read_room
from tests.support.doc_pages import DOCS, PAGES
from tests.support.scenes.exported_room import Y_UP, ExportedRoom

pytestmark = pytest.mark.integration

SCRIPT = DOCS / "gallery" / "picture.py"
script = sys.modules["picture_script"] = importlib.util.module_from_spec(
    importlib.util.spec_from_file_location("picture_script", SCRIPT)
)
script.__spec__.loader.exec_module(script)

SHOWN = re.compile(r"!\[[^\]]+\]\(gallery/([\w.]+)\)(.*?)```console\n(.*?)```", re.DOTALL)
MAX_BYTES, MAX_TOTAL_BYTES = 150_000, 1_200_000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ExportedRoom(R_world_room=Y_UP, shift=(0.5, -1.25, 2.0)).write(tmp_path_factory.mktemp("runs") / "room")


def test_gallery_pictures_are_written_by_next_command() -> None:
    shown = SHOWN.findall(PAGES["docs/gallery.md"])
    assert {name for name, _, _ in shown} == {path.name for path in SCRIPT.parent.glob("*.webp")}
    for name, caption, commands in shown:
        assert f"{name} " in commands
        assert "![" not in caption


def test_gallery_pictures_are_small() -> None:
    paths = list(SCRIPT.parent.glob("*.webp"))
    assert max(path.stat().st_size for path in paths) <= MAX_BYTES
    assert sum(path.stat().st_size for path in paths) <= MAX_TOTAL_BYTES
    assert max(Image.open(path).width for path in paths) <= script.WIDTH


def test_encoded_is_inverse_of_linear() -> None:
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(script.encoded(linear(levels)), levels)


@pytest.mark.parametrize("kind", [ExportFormat.GLB, ExportFormat.USD])
def test_read_scene_has_vertices_and_colors_of_run(kind: ExportFormat, run: Path, tmp_path: Path) -> None:
    if kind is ExportFormat.USD:
        pytest.importorskip("pxr", reason="usd-core is missing: pip install 'instancemap[usd]'")
    export(run, [kind], tmp_path)
    [scene] = tmp_path.glob("scene.*")
    meshes = script.READERS[scene.suffix](scene)
    mesh = read_room(run).mesh
    assert sum(len(triangles) for _, triangles, _ in meshes) == len(mesh.triangles)
    vertices = np.concatenate([vertices for vertices, _, _ in meshes])
    for found, expected in (
        (vertices.min(axis=0), mesh.vertices.min(axis=0)),
        (vertices.max(axis=0), mesh.vertices.max(axis=0)),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-4)
    colors = np.concatenate([colors for _, _, colors in meshes]).astype(int)
    assert np.abs(colors.mean(axis=0) - mesh.colors.mean(axis=0)).max() < 20


def test_picture_of_scene_and_image_has_both(run: Path, tmp_path: Path) -> None:
    export(run, [ExportFormat.GLB], tmp_path)
    Image.new("RGB", (300, 240), (255, 0, 0)).save(tmp_path / "red.png")
    out = tmp_path / "out.webp"
    script.main(str(out), str(tmp_path / "scene.glb"), str(tmp_path / "red.png"))
    image = np.asarray(Image.open(out).convert("RGB")).astype(int)
    assert image.shape == (480, 1200, 3)
    assert image[:, :600].std() > 5
    assert np.abs(image[:, 610:] - (255, 0, 0)).max() < 30
