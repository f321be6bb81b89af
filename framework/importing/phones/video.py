"""The frames of an MP4 file, in their order."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from framework.data import MOST_PIXELS, UInt8
from framework.errors import DataError, FrameError
from framework.files.atomic_write import check_regular

KIND_AT, KIND = 4, b"ftyp"  # of an MP4 or QuickTime file; other kinds may name files that FFmpeg would open
QUIET = "-8"  # FFmpeg's AV_LOG_QUIET: what is damaged is said by us


class Video:
    """Reads frames as they are stored: a phone's note to turn them is not followed, as depth has none."""

    def __init__(self, path: Path) -> None:
        """Raises DataError, naming the file, when it is no video that can be decoded."""
        check_regular(path)
        with path.open("rb") as file:
            if not file.read(KIND_AT + len(KIND)).endswith(KIND):
                raise DataError(f"{path} is no MP4 or QuickTime file")
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", QUIET)
        self.path = path
        before = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            self._capture = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(before)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))  # px
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))  # px
        if not self._capture.isOpened() or not 0 < self.width * self.height <= MOST_PIXELS:
            raise DataError(f"{path} could not be decoded: it is damaged, or of a kind that OpenCV does not know")
        self._next = 0

    def frame(self, number: int) -> UInt8:
        """(H, W, 3) RGB of a frame, counted from 0 and asked for in order. Raises FrameError when there is none."""
        if number < self._next - 1:
            raise FrameError(f"{self.path}: frame {number} comes after frame {self._next - 1}")
        while self._next <= number:
            if not self._capture.grab():
                raise FrameError(f"{self.path} ends, or is damaged, before frame {number}")
            self._next += 1
        decoded, image = self._capture.retrieve()
        if not decoded:
            raise FrameError(f"{self.path}: frame {number} could not be decoded")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
