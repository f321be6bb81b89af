"""Tests for the letterbox transform from the image to the network input."""

import numpy as np
import pytest

from framework.detection.masks.letterbox import Letterbox, Placement, network_input


@pytest.mark.parametrize(
    ("image", "placement", "resized", "top", "left"),
    [
        ((480, 640), Placement.top_left, (312, 416), 0, 0),
        ((480, 640), Placement.center, (312, 416), 52, 0),
        ((480, 640), Placement.stretch, (416, 416), 0, 0),
        ((640, 481), Placement.center, (416, 313), 0, 51),
        ((100, 100), Placement.center, (416, 416), 0, 0),
        ((2, 4000), Placement.top_left, (1, 416), 0, 0),
    ],
)
def test_letterbox_placement_sets_size_and_offsets(image, placement, resized, top, left):
    letterbox = Letterbox.fit(image, (416, 416), placement)
    assert (letterbox.resized, letterbox.top, letterbox.left) == (resized, top, left)


@pytest.mark.parametrize("placement", Placement)
def test_letterbox_image_borders_round_trip_exactly(placement):
    """The borders of an image are at -0.5 and W - 0.5 px, even if the size of the resized image is rounded."""
    letterbox = Letterbox.fit((333, 217), (416, 320), placement)
    height, width = letterbox.resized
    corners = [letterbox.left, letterbox.top, letterbox.left + width, letterbox.top + height]
    back = letterbox.to_image(np.array([corners], np.float32))
    np.testing.assert_allclose(back, [[-0.5, -0.5, 216.5, 332.5]], atol=1e-4)


@pytest.mark.parametrize("placement", Placement)
def test_letterbox_blob_position_round_trips(placement):
    """The center of a blob is resized by OpenCV and transformed back."""
    v, u = np.indices((120, 160))
    blob = 250 * np.exp(-((u - 101.0) ** 2 + (v - 37.0) ** 2) / (2 * 6.0**2))
    letterbox = Letterbox.fit((120, 160), (416, 416), placement)
    canvas = letterbox.fill(np.repeat(blob[..., None], 3, axis=2).astype(np.uint8), 0)[..., 0].astype(float)
    y, x = np.indices(canvas.shape) + 0.5
    center = np.array([(canvas * x).sum(), (canvas * y).sum()]) / canvas.sum()
    back = letterbox.to_image(np.array([[*center, *center]], np.float32))[0, :2]
    np.testing.assert_allclose(back, [101, 37], atol=0.05)


def test_letterbox_fill_centers_image_in_padding():
    letterbox = Letterbox.fit((10, 20), (40, 40), Placement.center)
    canvas = letterbox.fill(np.full((10, 20, 3), 200, np.uint8), 114)
    assert (canvas[10:30] == 200).all()
    assert (canvas[:10] == 114).all()
    assert (canvas[30:] == 114).all()


def test_network_input_values_match_type_and_range():
    canvas = np.array([[[0, 51, 255]]], np.uint8)
    as_is = network_input(canvas, "float32", bgr=False, black=0.0, white=255.0)
    assert as_is.dtype == np.float32
    np.testing.assert_array_equal(as_is, [[[0, 51, 255]]])
    np.testing.assert_allclose(network_input(canvas, "float32", True, 0.0, 1.0), [[[1, 0.2, 0]]], atol=1e-6)
    np.testing.assert_allclose(network_input(canvas, "float32", False, -1.0, 1.0), [[[-1, -0.6, 1]]], atol=1e-6)
    assert network_input(canvas, "float16", False, 0.0, 1.0).dtype == np.float16
    whole = network_input(canvas, "uint8", True, 0.0, 255.0)
    assert whole.dtype == np.uint8
    np.testing.assert_array_equal(whole, [[[255, 51, 0]]])
