"""Cache of renderings, so that each frame is rendered once for all sensors and runs."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import framework.rendering
import framework.synthetic
from framework.data import UInt8, UInt16
from framework.errors import FrameError
from framework.files.atomic_write import make_folder
from framework.files.image_files import read_color, read_ids, read_uint8, read_uint16, write_image
from framework.synthetic.renderer import Rendering

DEPTH_STEP = 1e-4  # m, resolution of the stored depth
FRACTIONS = 255  # resolution of the stored incidence and of the fraction of lost readings
PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)
SUFFIXES = ("color", "depth", "ids", "surface")  # files of a frame; surface = incidence above lost readings


class RenderingCache:
    """Renderings of one scene, in a folder that several processes can share.

    Renderings are rounded to the resolution of the files, so that they do not depend on the state of the cache. A
    damaged file is replaced.
    """

    def __init__(self, folder: Path, *key: object) -> None:
        """Open the cache.

        Args:
            folder: The folder of all caches.
            key: The parameters that determine the renderings. The code of the renderer is part of the key.
        """
        self.folder = folder / hashlib.sha256(f"{key} {_code_hash()}".encode()).hexdigest()[:16]

    def get(self, index: int, render: Callable[[int], Rendering]) -> Rendering:
        """Return the rendering of a frame. It is rendered if it is not in the cache."""
        color, depth, ids, surface = (self.folder / f"{index:06d}_{suffix}.png" for suffix in SUFFIXES)
        if surface.exists():  # written last
            try:
                return _rendering(read_color(color), read_uint16(depth), read_ids(ids), read_uint8(surface))
            except FrameError:
                pass  # rendered again
        exact = render(index)
        stored = (
            exact.color,
            np.rint(exact.depth / DEPTH_STEP).clip(0, 2**16 - 1).astype(np.uint16),
            exact.instance_ids.astype(np.uint16),
            np.rint(FRACTIONS * np.concatenate([exact.incidence, exact.unread])).astype(np.uint8),
        )
        make_folder(self.folder)
        write_image(color, cv2.cvtColor(exact.color, cv2.COLOR_RGB2BGR), *PNG)
        for path, image in zip((depth, ids, surface), stored[1:], strict=True):
            write_image(path, image, *PNG)
        return _rendering(*stored)


def _rendering(color: UInt8, depth: UInt16, ids: UInt16, surface: UInt8) -> Rendering:
    incidence, unread = np.split(surface.astype(np.float32) / np.float32(FRACTIONS), 2)
    return Rendering(color, depth * np.float32(DEPTH_STEP), ids.astype(np.int32), incidence, unread)


@cache
def _code_hash() -> str:
    """Return the hash of the code that may determine the renderings."""
    digest = hashlib.sha256()
    for package in (framework.synthetic, framework.rendering):
        folder = Path(package.__path__[0])
        for path in sorted(folder.rglob("*.py")):
            if path.stem in ("rgbd_camera", "rgbd_camera_kernels"):  # applied to cached images
                continue
            digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
