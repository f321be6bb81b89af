"""Tests for the classes of flat objects."""

from __future__ import annotations

import pytest

from framework.vocabulary.flat_objects import is_flat


@pytest.mark.parametrize("name", ["tv", "Picture", "office_door", "floor mat", "books", "wall art", "refrigerator"])
def test_is_flat_of_flat_object_is_true(name: str) -> None:
    assert is_flat(name)


@pytest.mark.parametrize("name", ["chair", "couch", "book holder", "oven", ""])
def test_is_flat_of_other_object_is_false(name: str) -> None:
    assert not is_flat(name)
