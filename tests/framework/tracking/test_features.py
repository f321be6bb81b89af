"""Tests for image features."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from framework.data import Camera, Frame
from framework.errors import ConfigError
from framework.tracking.features import DESCRIPTOR_LENGTH, FeatureExtractor, match, surface_depth

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def blobs(camera: Camera, centers: np.ndarray, sigma: float) -> Frame:
    """Return a frame of white Gaussian blobs on gray at a depth of 2 m."""
    v, u = np.mgrid[: camera.height, : camera.width]
    squared = (u - centers[:, 0, None, None]) ** 2 + (v - centers[:, 1, None, None]) ** 2
    gray = 60 + 160 * np.exp(-squared / (2 * sigma**2)).sum(axis=0)
    color = np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return Frame(0, 0.0, color, np.full(camera.shape, 2.0, np.float32), camera)


@pytest.mark.parametrize("camera", [CAMERA, CAMERA.scaled(0.5), CAMERA.scaled(2)], ids=["640", "320", "1280"])
def test_feature_positions_have_subpixel_accuracy(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(1, 6), np.arange(1, 5)), axis=-1).reshape(-1, 2)
    centers = grid * (camera.width / 6, camera.height / 5) + rng.uniform(-3, 3, grid.shape)
    features = FeatureExtractor().extract(blobs(camera, centers, sigma=camera.width / 100))
    distance = np.linalg.norm(features.pixels[:, None] - centers, axis=-1)
    found = distance.min(axis=0)
    assert found.max() < 0.1 * camera.width / 320, "expected errors below 0.1 px of the image used by SIFT"
    error = (features.pixels[distance.argmin(axis=0)] - centers).mean(axis=0)
    assert np.abs(error).max() < 0.03 * camera.width / 320, (
        "expected no bias; half-pixel errors would be at least 0.25 px"
    )
    assert (features.depth[distance.argmin(axis=0)] == 2).all()


def test_features_are_independent_of_thread_count() -> None:
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.integers(0, 255, CAMERA.shape).astype(np.uint8), (0, 0), 2)
    noise = cv2.equalizeHist(noise)
    depth = rng.uniform(1, 1.01, CAMERA.shape).astype(np.float32)
    frame = Frame(0, 0.0, np.repeat(noise[..., None], 3, axis=2), depth, CAMERA)
    before = cv2.getNumThreads()
    try:
        found = []
        for threads in (1, 2, 2, 1):
            cv2.setNumThreads(threads)
            found.append(FeatureExtractor().extract(frame))
    finally:
        cv2.setNumThreads(before)
    assert len(found[0]) == 800
    for features in found[1:]:
        for name in ("pixels", "depth", "descriptors"):
            np.testing.assert_array_equal(getattr(features, name), getattr(found[0], name))


def test_features_of_blank_image_are_empty() -> None:
    blank = Frame(0, 0.0, np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32), CAMERA)
    features = FeatureExtractor().extract(blank)
    assert (len(features), features.descriptors.shape) == (0, (0, DESCRIPTOR_LENGTH))
    assert match(features.descriptors, features.descriptors, 0.8).shape == (0, 2)


def test_surface_depth_is_zero_at_edges_and_holes() -> None:
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 30:] = 1.0  # a depth step
    depth[20:, :10] = 0  # a hole
    depth[5, 45] = 0  # a missing reading
    depth += np.where(depth > 0, 0.002 * np.arange(60, dtype=np.float32), 0)  # a slanted surface
    pixels = np.array([[20, 10], [28, 10], [31.4, 10], [33, 10], [3, 30], [45, 5], [0, 0]], np.float32)
    expected = [2.04, 0, 0, 1.066, 0, 1.09, 2.0]
    np.testing.assert_allclose(surface_depth(depth, pixels), expected, atol=0.0011)


def test_feature_matching_matches_brute_force_reference() -> None:
    rng = np.random.default_rng(2)
    reference = rng.integers(0, 120, (60, DESCRIPTOR_LENGTH)).astype(np.uint8)
    query = np.concatenate([reference[:40], rng.integers(0, 120, (20, DESCRIPTOR_LENGTH)).astype(np.uint8)])
    query = np.clip(query + rng.integers(-25, 26, query.shape), 0, 255).astype(np.uint8)
    for max_ratio in (0.5, 0.8, 1.0):
        D = np.linalg.norm(query.astype(float)[:, None] - reference.astype(float), axis=-1)
        expected = [
            (q, r)
            for q in range(len(query))
            for r in [int(D[q].argmin())]
            if D[:, r].argmin() == q and D[q, r] <= max_ratio * np.sort(D[q])[1]
        ]
        assert match(query, reference, max_ratio).tolist() == [list(pair) for pair in expected]
    assert len(match(query, reference, 0.8)) >= 30
    assert len(match(query, reference[:1], 0.8)) == 0, "expected no match: the ratio test needs two candidates"


def test_feature_extractor_parameter_out_of_range_raises() -> None:
    with pytest.raises(ConfigError, match=r"FeatureExtractor\.max_features"):
        FeatureExtractor(max_features=0)
