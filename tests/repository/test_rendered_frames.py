"""Tests for the cache of rendered frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import platformdirs
import pytest

from framework.synthetic.sequence import Synthetic
from tests.support.rendered_frames import rendered_frames

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def sequence() -> Synthetic:
    return Synthetic(frames=240, stop=2, width=32, height=24)


def test_rendered_frames_from_cache_are_identical(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sequence: Synthetic
) -> None:
    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda name: str(tmp_path))
    rendered, cached = rendered_frames(sequence), rendered_frames(sequence)
    assert len(list(tmp_path.rglob("*.pickle"))) == 1
    for one, other in zip(rendered, cached, strict=True):
        np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        assert one.truth is not None
        assert other.truth is not None
        np.testing.assert_array_equal(one.truth.instance_ids, other.truth.instance_ids)
        assert dict(one.truth.class_names) == dict(other.truth.class_names)


def test_rendered_frames_have_separate_cache_entries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sequence: Synthetic
) -> None:
    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda name: str(tmp_path))
    for index in (0, 1):
        rendered_frames(sequence, [index])
    assert len(list(tmp_path.rglob("*.pickle"))) == 2
