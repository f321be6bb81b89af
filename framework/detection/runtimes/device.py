"""Device, precision and number of threads of torch networks."""

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
    """Return the torch device for `auto`, `cpu` or `cuda`.

    `auto` selects cuda if available.

    Raises:
        ConfigError: The device is unknown or not available. The message contains the config key `name`.
    """
    require(device in ("auto", "cpu", "cuda"), name, device, "auto, cpu or cuda")
    available = torch.cuda.is_available()
    require(device != "cuda" or available, name, device, "cpu or auto without a GPU")
    return torch.device("cuda" if device != "cpu" and available else "cpu")


def ready(network: Any, device: torch.device, half_precision: bool) -> Any:
    """Move a network to a device and set it to inference mode.

    Half precision is only used on CUDA.
    """
    dtype = torch.float16 if half_precision and device.type == "cuda" else torch.float32
    return network.to(device, dtype).eval()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to one thread within a context.

    Waking other threads takes longer than a short operation. Several threads can use this context at the same time.
    """
    # torch stores the number of threads per thread; a thread's first query returns the latest number set by any thread,
    # so each thread queries the number before setting it
    with _changing:
        count = torch.get_num_threads()
        _before.append(_before[0] if _before else count)
        torch.set_num_threads(1)
    try:
        yield
    finally:
        with _changing:
            torch.set_num_threads(_before.pop())
