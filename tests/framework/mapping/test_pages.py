"""Pages that are asked for ahead: one at a time, and nothing that is in use is written."""

from __future__ import annotations

import numpy as np

from framework.mapping.pages import PAGE, SMALL, PagesAhead

ROWS = 6 * PAGE // 1024


def growing() -> list[np.ndarray]:
    """Two arrays that grow at the same pace and one at half of it, of bytes that are 1."""
    return [np.ones((ROWS, width), np.uint8) for width in (1024, 1024, 512)]


def address(array: np.ndarray) -> int:
    return array.ctypes.data


def test_each_array_has_its_next_page_before_it_comes_there() -> None:
    arrays, pages = growing(), PagesAhead()
    for count in range(SMALL // 1024 + 1, ROWS, 100):
        before = [array.copy() for array in arrays]
        for _ in arrays:
            pages.ask_for_one(arrays, count)
        for array, old in zip(arrays, before, strict=True):
            np.testing.assert_array_equal(array[:count], old[:count], err_msg="what is in use")
            in_use = count * array.shape[1]
            changed = np.flatnonzero(array.ravel() != old.ravel())
            assert ((changed + address(array)) % PAGE == 0).all()
            if SMALL < in_use < array.nbytes - PAGE:
                next_page = -(-(address(array) + in_use) // PAGE) * PAGE - address(array)
                assert array.ravel()[next_page] == 0
            assert in_use > SMALL or (array == 1).all()


def test_one_page_is_asked_for_at_a_time() -> None:
    arrays, pages = growing(), PagesAhead()
    asked = []
    for _ in range(4):
        before = [array.copy() for array in arrays]
        pages.ask_for_one(arrays, SMALL // 1024 + 100)
        asked.append([k for k, array in enumerate(arrays) if (array != before[k]).any()])
    assert sorted(asked) == [[], [], [0], [1]], "the third is still small"
    assert asked[2:] == [[], []], "each once"


def test_nothing_is_written_beyond_the_end() -> None:
    memory = np.ones(SMALL + 3 * PAGE, np.uint8)
    array, pages = memory[: SMALL + PAGE // 2], PagesAhead()
    for count in range(SMALL + 1, len(array), 1000):
        pages.ask_for_one([array], count)
    assert (array == 0).sum() <= 1
    assert (memory[len(array) :] == 1).all()
