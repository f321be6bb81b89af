"""Draw scenes, images and reports in one picture: python docs/gallery/picture.py PICTURE SOURCE ...

A SOURCE is an exported scene (.glb, .usdc), an image (.png), or a report (.html). `report.html#section` is one section.
Reports need Chromium and Playwright (pip install --group test).
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from framework.data import Float32, Int32, UInt8
from framework.exporting.object_meshes import linear
from framework.rendering.lit_view import LitView
from framework.rendering.surface import Surface
from framework.rendering.viewpoint import best_view, surrounding_poses

WIDTH = 1200  # px, maximum width of the picture
SCENE_HEIGHT = 960  # px, height of a rendered scene, which is WIDTH wide
PANORAMA = 2.0  # minimum ratio of width to height of images that are stacked
LARGEST = 65535  # of the 16-bit colors in GLB files
QUALITY = 80  # of WebP, in [0, 100]
CHROMIUM = "/usr/bin/chromium"
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL on the CPU
PAGE_WIDTH, SECTION_WIDTH = 1200, 1500  # px, widths of the browser window
PAGE_HEIGHT = 1030  # px, maximum height of a screenshot
DRAWING_MS = 2000  # until a selection is drawn
CHOOSE_FIRST = (
    """window.report.choose(Number(document.querySelector("#objects-table tbody tr").dataset.id)); scrollTo(0, 0)"""
)

Mesh = tuple[Float32, Int32, UInt8]
"""Vertices (V, 3), m, z up, triangles (F, 3) and sRGB colors (V, 3)."""


def meshes_of_glb(path: Path) -> list[Mesh]:
    """Read the meshes of a glTF scene."""
    import trimesh

    scene: Any = trimesh.load(path, process=False)
    found: list[Mesh] = []
    for name in scene.graph.nodes_geometry:
        T_gltf_node, geometry = scene.graph[name]
        mesh = scene.geometry[geometry]
        x, y, z = (mesh.vertices @ T_gltf_node[:3, :3].T + T_gltf_node[:3, 3]).T
        colors = encoded(mesh.visual.vertex_attributes["color"][:, :3] / np.float32(LARGEST))
        found.append((np.stack([x, -z, y], axis=1).astype(np.float32), np.asarray(mesh.faces, np.int32), colors))
    return found


def meshes_of_usd(path: Path) -> list[Mesh]:
    """Read the visible meshes of a USD stage."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    found: list[Mesh] = []
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide:
            continue
        mesh = UsdGeom.Mesh(prim)
        T_prim_world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0))  # of row vectors
        vertices = np.array(mesh.GetPointsAttr().Get()) @ T_prim_world[:3, :3] + T_prim_world[3, :3]
        triangles = np.array(mesh.GetFaceVertexIndicesAttr().Get(), np.int32).reshape(-1, 3)
        found.append((vertices.astype(np.float32), triangles, encoded(np.array(mesh.GetDisplayColorAttr().Get()))))
    return found


def encoded(colors: Float32) -> UInt8:
    """Return the nearest 8-bit sRGB colors of linear colors in [0, 1]."""
    levels = linear(np.arange(256, dtype=np.uint8))
    return np.searchsorted((levels[1:] + levels[:-1]) / 2, colors).astype(np.uint8)


READERS = {".glb": meshes_of_glb, ".usdc": meshes_of_usd}


def rendered(meshes: list[Mesh]) -> UInt8:
    """Return an image (H, W, 3) of meshes from the direction that shows most objects."""
    vertices = np.concatenate([mesh[0] for mesh in meshes])
    starts = np.cumsum([0] + [len(mesh[0]) for mesh in meshes])
    triangles = np.concatenate([mesh[1] + start for mesh, start in zip(meshes, starts, strict=False)])
    ids = np.repeat(np.arange(1, len(meshes) + 1), np.diff(starts)).astype(np.int32)
    surface = Surface(vertices, triangles.astype(np.int32))
    view = LitView(surface, *best_view(surface, ids, surrounding_poses(vertices), WIDTH, SCENE_HEIGHT))
    return view.in_colors(np.concatenate([mesh[2] for mesh in meshes]))


def screenshot(page: Path, section: str) -> UInt8:
    """Return an image (H, W, 3) of a section of a report; "" = top, with the first object selected."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        opened = browser.new_page(viewport={"width": SECTION_WIDTH if section else PAGE_WIDTH, "height": PAGE_HEIGHT})
        opened.goto(page.resolve().as_uri())
        opened.wait_for_selector("body[data-ready]")
        if not section:
            opened.get_by_text("Instances", exact=True).click()
            opened.evaluate(CHOOSE_FIRST)
            opened.wait_for_timeout(DRAWING_MS)
        png = opened.locator(f"#{section}").screenshot() if section else opened.screenshot()
        browser.close()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[:PAGE_HEIGHT]


def image_of(source: str) -> UInt8:
    """Return an image (H, W, 3) of a source."""
    name, _, section = source.partition("#")
    path = Path(name)
    if path.suffix in READERS:
        return rendered(READERS[path.suffix](path))
    return screenshot(path, section) if path.suffix == ".html" else np.asarray(Image.open(path).convert("RGB"))


def resized(image: UInt8, width: int) -> UInt8:
    """Return an image (H, W, 3) with another width."""
    height = round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def main(picture: str, *sources: str) -> None:
    """Write the picture of the sources. Panoramas are stacked, other images are side by side."""
    images = [image_of(source) for source in sources]
    if all(image.shape[1] > PANORAMA * image.shape[0] for image in images):
        drawn = np.concatenate([resized(image, WIDTH) for image in images])
    else:
        columns = [resized(image, WIDTH // len(images)) for image in images]
        drawn = np.concatenate([column[: min(map(len, columns))] for column in columns], axis=1)
    Image.fromarray(drawn).save(picture, quality=QUALITY, method=6)


if __name__ == "__main__":
    main(*sys.argv[1:])
