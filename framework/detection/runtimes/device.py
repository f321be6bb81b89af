"""Device, precision and threads of a torch network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import torch

from framework.config.validation import require

_changing = Lock()
_before: list[int] = []  # torch's number of threads before, once for each thread inside one_torch_thread()


def torch_device(device: str, name: str = "detector.device") -> torch.device:
    """Return the device for auto, cpu or cuda; auto = cuda if available.

    Raises ConfigError, naming the parameter, for other words and for cuda without a GPU.
    """
    require(device in ("auto", "cpu", "cuda"), name, device, "auto, cpu or cuda")
    available = torch.cuda.is_available()
    require(device != "cuda" or available, name, device, "cpu or auto without a GPU")
    return torch.device("cuda" if device != "cpu" and available else "cpu")


def ready(network: Any, device: torch.device, half_precision: bool) -> Any:
    """Return the network in inference mode on the device, in half precision only on CUDA."""
    dtype = torch.float16 if half_precision and device.type == "cuda" else torch.float32
    return network.to(device, dtype).eval()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute in the calling thread alone: short operations end before other threads wake up.

    Several threads may be inside at once. Torch stores the number per thread, and a thread gets the number that any
    thread set last when it first asks. So each thread asks before it sets its own, and restores the number on exit.
    """
    with _changing:
        asked = torch.get_num_threads()
        _before.append(_before[0] if _before else asked)
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _changing:
            torch.set_num_threads(_before.pop())
