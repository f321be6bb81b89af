"""Sparse RootSIFT features with depth, and their matching.

SIFT at half resolution matches more distant and more blurred views than ORB. At full resolution, SIFT is three times
slower and finds fewer matches. Descriptors are integers, as in COLMAP. Therefore, scalar products are exact, and
matches do not depend on the number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from framework.config.validation import check_bounds
from framework.data import Float32, Frame, Int32, UInt8

DESCRIPTOR_LENGTH = 128
DESCRIPTOR_NORM = 512.0  # norm of a RootSIFT descriptor before rounding, so that entries fit into a byte
FINEST_WIDTH = 400  # maximum image width, px; wider images are halved repeatedly
PATCH_RADIUS = 2  # radius of the patch around a feature that must lie on one surface, px
DEPTH_GAP = 0.05  # minimum depth difference between surfaces in a patch, fraction of the depth


@dataclass(frozen=True)
class Features:
    """The features of an image, strongest first."""

    pixels: Float32  # (F, 2) (u, v) in the full-resolution image
    depth: Float32  # (F,) m along z, 0 = no reading or at the edge of a surface
    descriptors: UInt8  # (F, 128) RootSIFT with norm 512

    def __len__(self) -> int:
        return len(self.pixels)

    def with_depth(self) -> Features:
        """Return the features that have depth."""
        found = self.depth > 0
        return Features(self.pixels[found], self.depth[found], self.descriptors[found])


@dataclass
class FeatureExtractor:
    """Extractor of features, independent of the number of threads."""

    max_features: int = 800  # maximum number of features, >= 1
    contrast: float = 0.015  # contrast threshold of SIFT, in (0, 1]; a lower value finds more and weaker features

    def __post_init__(self) -> None:
        check_bounds(self, max_features=(1, 100_000), contrast=(1e-6, 1.0))

    def extract(self, frame: Frame) -> Features:
        """Return the features of a color image.

        This method is thread-safe.
        """
        gray, scale = _reduced(cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY))
        # without precise upscaling, keypoints of OpenCV are off by a quarter of a pixel
        sift = cv2.SIFT.create(self.max_features, contrastThreshold=self.contrast, enable_precise_upscale=True)
        keypoints, descriptors = sift.detectAndCompute(gray, None)
        if not keypoints:
            no_descriptors = np.zeros((0, DESCRIPTOR_LENGTH), np.uint8)
            return Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), no_descriptors)
        # ties in strength are broken by position, not by thread timing
        found = np.array([(-p.response, *p.pt, p.size, p.angle) for p in keypoints], np.float64)
        order = np.lexsort(found.T[::-1])[: self.max_features]
        pixels = ((found[order, 1:3] + 0.5) * scale - 0.5).astype(np.float32)
        return Features(pixels, surface_depth(frame.depth, pixels), _root_sift(descriptors[order]))


@dataclass
class FrameFeatures:
    """The features of one frame, extracted on first use."""

    frame: Frame
    extractor: FeatureExtractor

    @cached_property
    def found(self) -> Features:
        return self.extractor.extract(self.frame)

    @property
    def known(self) -> bool:
        """True if the features have been extracted."""
        return "found" in self.__dict__


def match(query: UInt8, reference: UInt8, max_ratio: float) -> Int32:
    """Return the index pairs (M, 2) of descriptors that are mutual nearest neighbors.

    Args:
        query: The first descriptors (Q, 128).
        reference: The second descriptors (R, 128).
        max_ratio: The maximum ratio of the distances to the nearest and the second-nearest reference descriptor (Lowe,
            2004).
    """
    if len(query) == 0 or len(reference) < 2:
        return np.zeros((0, 2), np.int32)
    a, b = query.astype(np.float32), reference.astype(np.float32)
    # the product of OpenCV runs in this thread; BLAS threads wait for each other on busy cores
    squared = cv2.gemm(a, b, -2, None, 0, flags=cv2.GEMM_2_T)
    squared += (a * a).sum(axis=1)[:, None]
    squared += (b * b).sum(axis=1)
    rows = np.arange(len(a))
    nearest = squared.argmin(axis=1)
    mutual = squared.argmin(axis=0)[nearest] == rows
    smallest = squared[rows, nearest]
    squared[rows, nearest] = np.inf
    distinct = mutual & (smallest <= np.float32(max_ratio) ** 2 * squared.min(axis=1))
    return np.stack([rows[distinct], nearest[distinct]], axis=1).astype(np.int32)


def surface_depth(depth: Float32, pixels: Float32) -> Float32:
    """Return the median depth (F,) of the patch around each pixel, m.

    The depth is 0 at surface edges and in holes.

    Args:
        depth: The depth image (H, W), m, 0 = no reading.
        pixels: The pixels (F, 2), u and v.
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
    """Return the image, halved until its width is at most FINEST_WIDTH, and the reduction factor."""
    scale = 1
    while gray.shape[1] > FINEST_WIDTH:
        height, width = gray.shape[0] // 2, gray.shape[1] // 2
        gray = cv2.resize(gray[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        scale *= 2
    return gray, scale


def _root_sift(descriptors: Float32) -> UInt8:
    """Return the RootSIFT descriptors (Arandjelovic and Zisserman, 2012)."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1)
    rooted: UInt8 = np.minimum(np.rint(DESCRIPTOR_NORM * np.sqrt(descriptors / total)), 255).astype(np.uint8)
    return rooted
