"""A network that looks at images of any shape: the image is fitted into its input."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from framework.config.validation import LONGEST_SIDE, require
from framework.data import UInt8
from framework.detection.masks.letterbox import Letterbox, Placement, network_input
from framework.detection.runtimes.onnx_network import OnnxNetwork, Outputs


class ImageNetwork:
    """An ONNX network and how it wants its images; the arguments are parameters of the detectors that have one.

    Raises ConfigError for a parameter out of its bounds, and what `OnnxNetwork` raises.
    """

    def __init__(
        self,
        *,
        path: Path,
        sha256: str,
        device: str,
        input_size: int,
        placement: Placement,
        padding: int,
        bgr: bool,
        black: float,
        white: float,
    ) -> None:
        require(len(sha256) in (0, 64), "detector.sha256", sha256, "64 hexadecimal digits, or empty")
        allowed = f"0 (the network's own) or positive px, at most {LONGEST_SIDE}"
        require(0 <= input_size <= LONGEST_SIDE, "detector.input_size", input_size, allowed)
        require(0 <= padding <= 255, "detector.padding", padding, "in [0, 255]")
        require(
            bool(np.isfinite([black, white]).all()) and black != white, "detector.white_level", white, f"not {black}"
        )
        require(device in ("auto", "cpu", "cuda"), "detector.device", device, "auto, cpu or cuda")
        onnx = "an ONNX file; convert a .tflite file with tf2onnx (docs/guides/detectors.md)"
        require(path.suffix.lower() != ".tflite", "detector.weights", path, onnx)
        self._network = OnnxNetwork(path, sha256, device, input_size)
        whole = self._network.dtype != "uint8" or (black, white) == (0, 255)
        require(
            whole, "detector.black_level and white", f"{black} and {white}", "0 and 255 for a network of whole numbers"
        )
        self.shape = self._network.shape  # (height, width) px
        self.channels_last = self._network.channels_last  # the input is (1, H, W, 3)
        self.metadata = self._network.metadata
        self._placement, self._padding, self._bgr = placement, padding, bgr
        self._black, self._white = black, white

    def __call__(self, color: UInt8) -> tuple[Outputs, Letterbox]:
        """The network's outputs by name for an image (h, w, 3) RGB, and where the image lies in its input."""
        letterbox = Letterbox.fit(color.shape[:2], self.shape, self._placement)
        canvas = letterbox.fill(color, self._padding)
        return self._network(network_input(canvas, self._network.dtype, self._bgr, self._black, self._white)), letterbox

    def try_out(self) -> Outputs:
        """The outputs for a black image: a network of another form is found when the detector is built."""
        outputs, _ = self(np.zeros((*self.shape, 3), np.uint8))
        return outputs
