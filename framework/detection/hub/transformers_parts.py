"""What all models of Hugging Face transformers take: reading their parts from a folder, and the pixels of an image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from framework.data import UInt8
from framework.errors import ConfigError, DataError, in_one_line


def network_pixels(image: UInt8, mean: Sequence[float], std: Sequence[float], device: torch.device) -> torch.Tensor:
    """The input (1, 3, H, W) of an image (H, W, 3) RGB: shares of 255, less the mean, by the standard deviation."""
    pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255
    return (pixels - torch.tensor(mean, device=device)[:, None, None]) / torch.tensor(std, device=device)[:, None, None]


def imported_transformers() -> Any:
    """The library. Raises ConfigError, naming the extra, where it is not installed."""
    try:
        import transformers
    except ImportError as error:
        raise ConfigError("the package transformers is not installed: pip install instancemap[transformers]") from error
    return transformers


def read_part(parameter: str, folder: Path, what: str, auto_class: Any) -> Any:
    """A part of a model in a folder. Raises DataError, naming the parameter, for one that cannot be read."""
    try:
        return auto_class.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # whatever transformers, tokenizers and safetensors raise on foreign files
        raise DataError(f"{parameter}: {what} could not be read from {folder}: {in_one_line(error)}") from error
