"""Sparse image features with depth: RootSIFT at half resolution, and their matching.

Of what OpenCV 5 offers (AKAZE has left it), measured on 640x480 video of a kitchen with and without motion blur: SIFT
at 320x240 takes 15 to 20 ms and its matches still give a pose where ORB's (5 ms) no longer do, 50 frames away or under
a blur of 17 px; SIFT at full resolution takes three times as long and matches less, because blur and sensor noise live
in the finest scale.

Descriptors are whole numbers, as in COLMAP: a scalar product of two is then exact in float32 in whatever order it is
summed, so that matches do not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float32, Frame, Int32, UInt8

DESCRIPTOR_LENGTH = 128
DESCRIPTOR_NORM = 512.0  # of a RootSIFT descriptor before it is rounded: entries then fit into a byte
FINEST_WIDTH = 400  # px: the image is halved until it is no wider
PATCH_RADIUS = 2  # px around a feature that must lie on one surface
DEPTH_GAP = 0.05  # of the depth: readings in a patch farther apart than this are of two surfaces


@dataclass(frozen=True)
class Features:
    """F image features, strongest first."""

    pixels: Float32  # (F, 2) (u, v), of the full-resolution image
    depth: Float32  # (F,) m along z, 0 = no reading, or one at the edge of a surface
    descriptors: UInt8  # (F, 128) RootSIFT of length 512

    def __len__(self) -> int:
        return len(self.pixels)

    def with_depth(self) -> Features:
        """Those that have a depth."""
        found = self.depth > 0
        return Features(self.pixels[found], self.depth[found], self.descriptors[found])


@dataclass
class FeatureExtractor:
    """Finds `Features` in a frame; the same frame gives the same ones, whatever the number of threads."""

    max_features: int = 800  # >= 1
    contrast: float = 0.015  # in (0, 1], SIFT's threshold: less finds more, and weaker, features

    def __post_init__(self) -> None:
        check_bounds(self, max_features=(1, 100_000), contrast=(1e-6, 1.0))

    def extract(self, frame: Frame) -> Features:
        """The features of `frame`; none in an image without texture. Several threads may call it at once."""
        gray, scale = _reduced(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY))
        # without precise upscaling OpenCV's keypoints lie a quarter of a pixel beside the image's
        sift = cv2.SIFT.create(
            nfeatures=self.max_features, contrastThreshold=self.contrast, enable_precise_upscale=True
        )
        keypoints, descriptors = sift.detectAndCompute(gray, None)
        if not keypoints:
            return Features(
                np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, DESCRIPTOR_LENGTH), np.uint8)
            )
        # ties in strength are broken by place, not by the order in which threads finish
        found = np.array([(-p.response, *p.pt, p.size, p.angle) for p in keypoints], np.float64)
        order = np.lexsort(found.T[::-1])[: self.max_features]
        pixels = ((found[order, 1:3] + 0.5) * scale - 0.5).astype(np.float32)
        return Features(pixels, surface_depth(frame.depth, pixels), _root_sift(descriptors[order]))


@dataclass
class FrameFeatures:
    """The features of one frame, found when somebody first asks for them."""

    frame: Frame
    extractor: FeatureExtractor

    @cached_property
    def found(self) -> Features:
        return self.extractor.extract(self.frame)

    @property
    def known(self) -> bool:
        """Whether somebody has asked."""
        return "found" in self.__dict__


def match(query: UInt8, reference: UInt8, max_ratio: float) -> Int32:
    """The pairs (M, 2) of indices of `query` (Q, 128) and `reference` (R, 128) that are each other's nearest.

    A pair whose distance is above `max_ratio` of the query's distance to its second nearest is not trusted (Lowe 2004).
    """
    if len(query) == 0 or len(reference) < 2:
        return np.zeros((0, 2), np.int32)
    a, b = query.astype(np.float32), reference.astype(np.float32)
    # OpenCV's product runs in this thread: those of BLAS wait for each other for milliseconds when the cores are busy
    squared = cv2.gemm(a, b, -2, None, 0, flags=cv2.GEMM_2_T)
    squared += (a * a).sum(axis=1)[:, None]
    squared += (b * b).sum(axis=1)
    rows = np.arange(len(a))
    nearest = squared.argmin(axis=1)
    mutual = squared.argmin(axis=0)[nearest] == rows
    first = squared[rows, nearest]
    squared[rows, nearest] = np.inf
    trusted = mutual & (first <= np.float32(max_ratio) ** 2 * squared.min(axis=1))
    return np.stack([rows[trusted], nearest[trusted]], axis=1).astype(np.int32)


def surface_depth(depth: Float32, pixels: Float32) -> Float32:
    """The depth (F,) at `pixels` (F, 2), 0 where a surface ends nearby or most readings around are missing.

    It is the median of a patch, because a single reading is noisy; on a slanted plane that is the patch's center.
    """
    height, width = depth.shape
    offsets = np.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    u, v = np.rint(pixels).astype(np.intp).T
    rows = np.clip(v[:, None, None] + offsets[:, None], 0, height - 1)
    columns = np.clip(u[:, None, None] + offsets, 0, width - 1)
    patches = depth[rows, columns].reshape(len(pixels), -1)
    known = patches > 0
    readings = known.sum(axis=1)
    nearest = np.where(known, patches, np.inf).min(axis=1, initial=np.inf)
    farthest = patches.max(axis=1, initial=0)
    sound = (2 * readings > patches.shape[1]) & (farthest - nearest <= DEPTH_GAP * nearest)
    ordered = np.sort(np.where(known, patches, np.inf), axis=1)
    middle = ordered[np.arange(len(patches)), readings // 2]
    return np.where(sound, middle, 0).astype(np.float32)


def _reduced(gray: UInt8) -> tuple[UInt8, int]:
    """The image halved until it is at most FINEST_WIDTH wide, and by what its pixels have grown."""
    scale = 1
    while gray.shape[1] > FINEST_WIDTH:
        height, width = gray.shape[0] // 2, gray.shape[1] // 2
        gray = cv2.resize(gray[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        scale *= 2
    return gray, scale


def _root_sift(descriptors: Float32) -> UInt8:
    """Arandjelovic and Zisserman 2012: the Euclidean distance of square roots is the Hellinger distance."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1)
    rooted: UInt8 = np.minimum(np.rint(DESCRIPTOR_NORM * np.sqrt(descriptors / total)), 255).astype(np.uint8)
    return rooted
