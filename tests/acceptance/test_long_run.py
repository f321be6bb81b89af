"""Tests for the growth of a long run."""

import numpy as np
import pytest

from tests.acceptance.long_run import FRAMES, Growth, growth_of


def test_growth_with_outliers_is_exact() -> None:
    frames = np.arange(100) * FRAMES / 100
    size, relative_ms = 1e9 + 42 * frames, np.full(100, 3.0)
    relative_ms[75:] = 3.3
    relative_ms[::9] = 50
    found = growth_of(size, relative_ms)
    assert found == pytest.approx(Growth(42.0, 1.1))
