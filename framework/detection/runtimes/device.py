"""Where a network runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

import torch

from framework.config.validation import require

_changing = Lock()
_before: list[int] = []  # torch's number of threads before, once for each thread that is within one_torch_thread()


def torch_device(device: str, name: str = "detector.device") -> torch.device:
    """What `device` (auto, cpu or cuda) means here; auto = cuda where there is one.

    Raises ConfigError, naming the parameter, for another word and for cuda without a GPU.
    """
    require(device in ("auto", "cpu", "cuda"), name, device, "auto, cpu or cuda")
    there = torch.cuda.is_available()
    require(device != "cuda" or there, name, device, "cpu or auto without a GPU")
    return torch.device("cuda" if device != "cpu" and there else "cpu")


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Has torch compute in the calling thread alone: what is short is done before others have woken up.

    Several threads may be within at once. Torch keeps the number by thread, and a thread gets the one that was set last
    by any when it first asks: so each asks before it sets its own, and whoever leaves sets the one from before.
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
