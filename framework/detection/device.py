"""Where a network runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from framework.parameters import require


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
    """Has torch compute in the calling thread alone: what is short is done before others have woken up."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
