"""Camera path in the image of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from framework.data import Bool, Camera, Float64, UInt8
from framework.geometry import inverse, project, transform
from framework.rendering.palette import PAPER
from framework.rendering.surface import Hits

PATH_START, PATH_END = (40, 110, 220), (235, 90, 40)  # RGB at the ends of the path


@dataclass(frozen=True)
class ProjectedPath:
    """The camera positions of a path, projected into an image."""

    pixels: Float64  # (P, 2) u v, px
    hidden: Bool  # (P,) True for positions behind the surface

    @classmethod
    def of(cls, poses: Float64, camera: Camera, T_world_camera: Float64, hits: Hits) -> ProjectedPath:
        """Project the camera positions into an image.

        Positions behind the camera of the image are omitted.

        Args:
            poses: The camera poses (F, 4, 4) of the path.
            camera: The camera of the image.
            T_world_camera: The pose (4, 4) of this camera.
            hits: The visible surface of the image.
        """
        positions = poses[:, :3, 3]
        points = transform(inverse(T_world_camera), positions)
        points = points[points[:, 2] > 0.05]
        pixels = project(camera, points)
        u, v = np.rint(pixels).astype(int).T
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        depth = np.zeros(len(points))
        depth[inside] = hits.depth[v[inside], u[inside]]
        return cls(np.asarray(pixels, np.float64), (depth > 0) & (depth < points[:, 2]))

    def shades(self) -> UInt8:
        """Return the colors (P, 3), RGB, of the positions, from blue at the start to orange at the end."""
        fraction = np.linspace(0, 1, max(2, len(self.pixels)))[: len(self.pixels), None]
        mixed = (1 - fraction) * np.array(PATH_START) + fraction * np.array(PATH_END)
        return np.asarray(np.rint(mixed), np.uint8)

    def draw(self, image: Image.Image) -> None:
        """Draw the path as a line with a dot at each end.

        Hidden segments are thin.
        """
        canvas = ImageDraw.Draw(image)
        points = [tuple(pixel) for pixel in self.pixels.tolist()]
        shades = [tuple(shade) for shade in self.shades().tolist()]
        for k in range(len(points) - 1):
            canvas.line((points[k], points[k + 1]), shades[k], width=1 if self.hidden[k] else 3)
        for (u, v), color in zip(points[:1] + points[-1:], (PATH_START, PATH_END), strict=False):
            canvas.ellipse((u - 6, v - 6, u + 6, v + 6), fill=color, outline=PAPER, width=2)
