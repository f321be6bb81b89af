"""Tests for JPEG and PNG files, including damaged files."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from framework.errors import FrameError
from framework.files.image_files import decode_color, read_uint16

RNG = np.random.default_rng(0)
PICTURE = cv2.GaussianBlur(RNG.integers(0, 256, (96, 128, 3), np.uint8), (0, 0), 2)
JPEG = cv2.imencode(".jpg", PICTURE)[1].tobytes()
START_OF_SCAN, END = b"\xff\xda", b"\xff\xd9"


def message(data: bytes) -> str:
    with pytest.raises(FrameError) as caught:
        decode_color("picture.jpg", data)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "parameters",
    [
        (cv2.IMWRITE_JPEG_QUALITY, 30),
        (cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
        (cv2.IMWRITE_JPEG_RST_INTERVAL, 4),
        (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    ],
)
def test_jpeg_pixels_match_opencv(parameters: tuple[int, int]) -> None:
    data = cv2.imencode(".jpg", PICTURE, parameters)[1]
    np.testing.assert_array_equal(decode_color("x", data.tobytes()), cv2.imdecode(data, cv2.IMREAD_COLOR_RGB))


def test_jpeg_gray_has_three_equal_channels() -> None:
    gray = cv2.imencode(".jpg", PICTURE[..., 0])[1]
    np.testing.assert_array_equal(decode_color("x", gray.tobytes()), cv2.imdecode(gray, cv2.IMREAD_COLOR_RGB))


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.99])
def test_jpeg_truncated_with_end_marker_raises(share: float) -> None:
    """OpenCV returns an image whose missing part is gray."""
    data = JPEG[: int(share * len(JPEG))] + END
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    assert message(data).startswith("picture.jpg: expected a ")


def test_jpeg_with_corrupt_block_raises() -> None:
    """The corrupt data contain invalid codes or markers, or are too long."""
    first = JPEG.index(START_OF_SCAN) + 14
    seen = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        at = int(rng.integers(first, len(JPEG) - 102))
        data = JPEG[:at] + rng.bytes(100) + JPEG[at + 100 :]
        try:
            decode_color("picture.jpg", data)
        except FrameError:
            seen += 1
    assert seen >= 36, "expected at least 36 errors: without checksums, noise may be valid code by chance"


def test_png_animated_raises() -> None:
    """OpenCV and Pillow would read different images of the animation."""
    pictures = [Image.new("RGB", (8, 6), color) for color in ("red", "lime", "blue")]
    written = io.BytesIO()
    pictures[0].save(written, "PNG", save_all=True, append_images=pictures[1:], default_image=True)
    assert "expected a single image, got an animation of 3" in message(written.getvalue())


def test_jpeg_as_depth_raises(tmp_path) -> None:
    path = tmp_path / "depth.png"
    path.write_bytes(JPEG)
    with pytest.raises(FrameError, match="expected a PNG with 1 channel of uint16"):
        read_uint16(path)
