"""Images of objects, cropped from the best frame or from a rendering of the map."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO

import cv2
import numpy as np
from PIL import Image

from framework.data import Bool, Float64, InstanceMesh, Int32, UInt8
from framework.rendering.lit_view import LitView
from framework.rendering.rasterizer import Rasterizer
from framework.rendering.surface import Surface
from framework.reporting.run_source import Footage

WIDTH, HEIGHT = 264, 198  # px
MAX_LARGE_PICTURES = 120  # maximum number of objects with full-size images; with more objects, all images are smaller
QUALITY = 78  # WebP quality, 0 to 100
MARGIN = 0.25  # margin on each side of an object, relative to its size
MIN_CROP = 0.12  # minimum width of the crop, relative to the width of the image
OUTLINE = (255, 255, 255)  # RGB of the lines on both sides of the colored outline


@dataclass(frozen=True)
class Picture:
    """An image in the page."""

    url: str  # `data:` URL
    source: str  # "frame 12" or "map"


class Photographer:
    """Renderer of images of the objects in a map."""

    def __init__(self, mesh: InstanceMesh, surface: Surface, poses: Float64, footage: Footage) -> None:
        self._mesh, self._surface, self._poses, self._footage = mesh, surface, poses, footage
        self._camera = footage.camera
        self._rasterizer = Rasterizer(mesh.vertices, mesh.triangles)

    def pictures(self, labels: Int32, best: Mapping[int, int], colors: Mapping[int, UInt8]) -> dict[int, Picture]:
        """Return an image of each visible object by label.

        Each image shows the best view of the object, with an outline in its color.

        Args:
            labels: Object labels (V,) of the vertices, 0 = none.
            best: Index of the pose with the best view, by label.
            colors: RGB color (3,) by label.
        """
        taken: dict[int, Picture] = {}
        scale = 1.0 if len(best) <= MAX_LARGE_PICTURES else 0.6
        for k in sorted(set(best.values())):
            image, source = self._seen_from(k)
            ids = self._rasterizer.draw(self._camera, self._poses[k]).nearest(self._mesh.triangles, labels)
            for key in sorted(key for key, pose in best.items() if pose == k):
                if (mask := ids == key).any():
                    crop = cropped(image, mask, colors[key], scale)
                    taken[key] = Picture(webp_url(Image.fromarray(crop), QUALITY), source)
        return taken

    def _seen_from(self, k: int) -> tuple[UInt8, str]:
        """Return the RGB image (H, W, 3) at pose `k`, and its source ("frame N" or "map").

        Unreadable frames are replaced by a rendering of the map.
        """
        if k in self._footage.images:
            return self._footage.images[k], f"frame {self._footage.frames[k]}"
        return LitView(self._surface, self._camera, self._poses[k]).in_colors(self._mesh.colors), "map"


def cropped(image: UInt8, mask: Bool, color: UInt8, scale: float) -> UInt8:
    """Return the part of an image around an object, with the outline of the object.

    Args:
        image: RGB image (H, W, 3).
        mask: Mask (H, W) of the object.
        color: RGB color (3,) of the outline.
        scale: Size of the result, relative to WIDTH x HEIGHT px.
    """
    height, width = mask.shape
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    center_u, center_v = (columns[0] + columns[-1] + 1) / 2, (rows[0] + rows[-1] + 1) / 2
    wide, high = (1 + 2 * MARGIN) * (columns[-1] - columns[0] + 1), (1 + 2 * MARGIN) * (rows[-1] - rows[0] + 1)
    cut_width = round(min(max(wide, high * WIDTH / HEIGHT, MIN_CROP * width), width, height * WIDTH / HEIGHT))
    cut_height = min(round(cut_width * HEIGHT / WIDTH), height)
    left = round(min(max(center_u - cut_width / 2, 0), width - cut_width))
    top = round(min(max(center_v - cut_height / 2, 0), height - cut_height))
    window = slice(top, top + cut_height), slice(left, left + cut_width)
    size = round(WIDTH * scale), round(HEIGHT * scale)
    cut = cv2.resize(image[window], size, interpolation=cv2.INTER_AREA if cut_width > size[0] else cv2.INTER_CUBIC)
    outlined = cv2.resize(mask[window].astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    smooth = cv2.GaussianBlur(outlined, (0, 0), 1.5) > 0.5
    contours, _ = cv2.findContours(smooth.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(cut, contours, -1, OUTLINE, 4, cv2.LINE_AA)
    cv2.drawContours(cut, contours, -1, tuple(color.tolist()), 2, cv2.LINE_AA)
    return np.asarray(cut)


def webp_url(image: Image.Image, quality: int) -> str:
    """Return an image as a `data:` URL in WebP format, with a quality of 0 to 100."""
    file = BytesIO()
    image.save(file, "WEBP", quality=quality, method=4)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
