"""Device, precision and threads of a torch network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import torch

from framework.config.validation import require

_changing = Lock()
_before: list[int] = []  # previous number of torch threads, once for each thread inside one_torch_thread()


def torch_device(device: str, name: str = "detector.device") -> torch.device:
    """Return the torch device for `device` auto, cpu or cuda; auto = cuda if available.

    Raises ConfigError with the key `name` for other values, and for cuda without a GPU.
    """
    require(device in ("auto", "cpu", "cuda"), name, device, "auto, cpu or cuda")
    available = torch.cuda.is_available()
    require(device != "cuda" or available, name, device, "cpu or auto without a GPU")
    return torch.device("cuda" if device != "cpu" and available else "cpu")


def ready(network: Any, device: torch.device, half_precision: bool) -> Any:
    """Move the network to the device and set it to inference mode; half precision is used only on CUDA."""
    dtype = torch.float16 if half_precision and device.type == "cuda" else torch.float32
    return network.to(device, dtype).eval()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to the calling thread, because short operations end before other threads wake up.

    Several threads may use this context at once. Torch stores the number of threads per thread. At its first query, a
    thread gets the latest number set by any thread. So each thread queries the number before setting it, and restores
    it on exit.
    """
    with _changing:
        count = torch.get_num_threads()
        _before.append(_before[0] if _before else count)
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _changing:
            torch.set_num_threads(_before.pop())
