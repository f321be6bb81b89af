"""What a PNG or JPEG file says before it is decoded: whether it is whole, and how large its picture is.

Pillow reads the headers and a PNG's checksums. It accepts a JPEG that was cut off, and a PNG without its last bytes:
the end is looked for here.
"""

from __future__ import annotations

import io
from pathlib import Path

from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from framework.errors import FrameError

MOST_PIXELS = 2**25  # 8K video; decoders allocate what a header claims, and a damaged one can claim 10^10
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
JPEG_PADDING = b"\0\r\n"  # some cameras fill their files up with zeros, and some programs add a line end


def check_image(name: Path | str, data: bytes) -> None:
    """Raises FrameError unless `data` is a whole PNG or JPEG file with a picture of a usual size.

    OpenCV decodes a JPEG that ends too early without a word (seen in 4.x) and allocates whatever a header claims.
    """
    if not data:
        raise FrameError(f"{name} is empty")
    kind: type[ImageFile]
    if data.startswith(PNG_START):
        kind, ended = PngImageFile, data.rfind(PNG_END) >= 0
    elif data.startswith(JPEG_START):
        kind, ended = JpegImageFile, data.rstrip(JPEG_PADDING).endswith(JPEG_END)
    else:
        raise FrameError(f"{name} is neither a JPEG nor a PNG file")
    if not ended:
        raise FrameError(f"{name} is truncated: it ends after {len(data)} bytes without its end marker")
    try:
        image = kind(io.BytesIO(data))  # not Image.open, which warns of large pictures and has its own limit
        width, height = image.size
        image.verify()
    except Exception as error:  # Pillow has no base of its own
        raise FrameError(f"{name} is damaged: {' '.join(str(error).split())}") from error
    if not 0 < width * height <= MOST_PIXELS:
        raise FrameError(f"{name} claims to be {width}x{height} px; it is damaged, or larger than {MOST_PIXELS} px")
