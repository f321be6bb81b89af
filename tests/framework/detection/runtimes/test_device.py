"""Tests for the thread counts of torch in several threads."""

import threading

import torch

from framework.detection.runtimes.device import one_torch_thread

PATIENCE_S = 10.0


def test_one_torch_thread_in_two_threads_restores_thread_count():
    """When a new thread uses torch for the first time, it gets the count that was last set in any thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    first_is_in, second_is_in = threading.Event(), threading.Event()
    seen = []

    def use_first() -> None:
        with one_torch_thread():
            seen.append(torch.get_num_threads())
            first_is_in.set()
            assert second_is_in.wait(PATIENCE_S)

    def use_second() -> None:
        assert first_is_in.wait(PATIENCE_S)
        with one_torch_thread():
            second_is_in.set()
            first.join(PATIENCE_S)
            seen.append(torch.get_num_threads())

    first, second = (threading.Thread(target=work) for work in (use_first, use_second))
    new = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    try:
        for thread in (first, second):
            thread.start()
        second.join(2 * PATIENCE_S)
        new.start()
        new.join()
        assert (seen, torch.get_num_threads()) == ([1, 1, 2], 2)
    finally:
        torch.set_num_threads(before)
