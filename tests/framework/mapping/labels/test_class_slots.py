"""Vectors of class slots against the loops that say the same."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit

from framework.mapping.labels import class_slots
from framework.mapping.labels.class_slots import CLASS_SLOTS, NEW_CLASSES, NO_CLASS
from framework.mapping.labels.label_evidence import MOST_GAIN, MOST_UNITS


@njit
def add_said(classes, units, said_by, most):
    return class_slots.add_said(classes, units, said_by, most)


@njit
def likeliest_slot(classes, units):
    return class_slots.likeliest_slot(classes, units)


@njit
def least_likely_slot(units):
    return class_slots.least_likely_slot(units)


def voxel(seed: int, largest: int) -> tuple[np.ndarray, np.ndarray]:
    """Classes and units of a voxel, some of its slots filled; with few different units there are ties."""
    rng = np.random.default_rng(seed)
    filled = rng.integers(0, CLASS_SLOTS + 1)
    classes = np.full(CLASS_SLOTS, NO_CLASS, np.uint8)
    classes[:filled] = rng.choice(NO_CLASS, filled, replace=False)
    units = np.zeros(CLASS_SLOTS, np.int16)
    units[:filled] = rng.integers(-largest, largest + 1, filled)
    return classes, units


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 100_000), st.sampled_from([1, 5, MOST_UNITS]))
def test_a_vector_says_what_the_loops_say(seed: int, largest: int) -> None:
    classes, units = voxel(seed, largest)
    rng = np.random.default_rng(seed)
    said_by = rng.integers(-MOST_GAIN, MOST_GAIN + 1, NO_CLASS + 1).astype(np.int32) << NEW_CLASSES
    said_by[:: rng.integers(2, 9)] |= 1 << rng.integers(0, NEW_CLASSES)
    said_by[NO_CLASS] = 0
    by_loop = units.astype(np.int64)

    assert likeliest_slot(classes, units) == class_slots._likeliest_slot(classes, by_loop)
    assert least_likely_slot(units) == class_slots._least_likely_slot(by_loop)
    assert add_said(classes, units, said_by, MOST_UNITS) == class_slots._add_said(
        classes, by_loop, said_by.astype(np.int64), MOST_UNITS
    )
    np.testing.assert_array_equal(units, by_loop)


def test_exact_storage_has_more_slots_than_a_vector() -> None:
    classes, units = np.arange(80, dtype=np.uint8), np.arange(80) ** 2
    said_by = np.full(NO_CLASS + 1, 3 << NEW_CLASSES)
    assert likeliest_slot(classes, units) == 79
    assert least_likely_slot(units) == 0
    assert add_said(classes, units, said_by, 1 << 62) == (0, 80, 79**2 + 3 - (1 << 62))
    np.testing.assert_array_equal(units, np.arange(80) ** 2 + 3)


def test_slots_need_not_be_aligned() -> None:
    """Those of all voxels lie in one array of records, between other fields."""
    record = np.dtype([("flag", np.uint8), ("classes", np.uint8, (CLASS_SLOTS,)), ("units", np.int16, (CLASS_SLOTS,))])
    records = np.zeros(3, record)
    for i, seed in enumerate((3, 4, 5)):
        records["classes"][i], records["units"][i] = voxel(seed, 5)
    said_by = (np.arange(NO_CLASS + 1, dtype=np.int32) % 7) << NEW_CLASSES
    before = records.copy()
    expected = records["units"][1].astype(np.int64)
    answer = class_slots._add_said(records["classes"][1], expected, said_by.astype(np.int64), MOST_UNITS)
    assert add_said(records["classes"][1], records["units"][1], said_by, MOST_UNITS) == answer
    np.testing.assert_array_equal(records["units"][1], expected)
    np.testing.assert_array_equal(records[[0, 2]], before[[0, 2]])
