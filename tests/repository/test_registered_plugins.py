"""Contract tests for every registered plugin.

New plugins are included automatically. The contract tests are in framework/testing, which other packages can import.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import islice
from typing import Any

import pytest

from framework.data import Frame
from framework.interfaces import LiveVideo, RGBDSequence
from framework.testing.contracts import (
    BackEndContract,
    DetectorContract,
    FuserContract,
    MaskingContract,
    RefinerContract,
    SequenceContract,
    TrackerContract,
)
from framework.testing.viewer import ViewerContract
from tests.support import option_files, registered
from tests.support.cores import all_cores

pytestmark = pytest.mark.integration

Ready = Callable[[str, str], Any]


class TestDatasets(SequenceContract):
    @pytest.fixture(autouse=True, params=registered.names("dataset", RGBDSequence))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("dataset", request.param)


class TestDetectors(DetectorContract):
    @pytest.fixture(autouse=True, params=registered.names("detector"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("detector", request.param)


class TestMaskings(MaskingContract):
    @pytest.fixture(autouse=True, params=registered.names("masking"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("masking", request.param)


class TestTrackers(TrackerContract):
    @pytest.fixture(autouse=True, params=registered.names("tracker"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("tracker", request.param)


class TestRefiners(RefinerContract):
    @pytest.fixture(autouse=True, params=registered.names("refiner"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> Iterator[None]:
        self.plugin = lambda: ready("refiner", request.param)
        with all_cores():
            yield


class TestFusers(FuserContract):
    @pytest.fixture(autouse=True, params=registered.names("fuser"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("fuser", request.param)


class TestBackEnds(BackEndContract):
    @pytest.fixture(autouse=True, params=registered.names("backend"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("backend", request.param)


class TestViewers(ViewerContract):
    @pytest.fixture(autouse=True, params=registered.names("viewer"))
    def option(self, request: pytest.FixtureRequest, ready: Ready) -> None:
        self.plugin = lambda: ready("viewer", request.param)


# Live videos


@pytest.fixture(params=registered.names("dataset", LiveVideo))
def video(request: pytest.FixtureRequest, ready: Ready, monkeypatch: pytest.MonkeyPatch) -> LiveVideo:
    for name, module in option_files.modules("dataset", request.param).items():
        monkeypatch.setitem(sys.modules, name, module)
    video: LiveVideo = ready("dataset", request.param)
    return video


def come(video: LiveVideo) -> Iterator[Frame]:
    """Yield the frames of a live video after checking that the video yields None while waiting."""
    with closing(video.frames()) as readers:
        yielded = time.monotonic()
        for reader in readers:
            assert time.monotonic() - yielded < 1, "expected None about 10 times per second"
            if reader is not None:
                yield reader()
            yielded = time.monotonic()


def test_live_video_yields_current_frames_in_order(video: LiveVideo) -> None:
    began = time.time()
    frames = list(islice(come(video), 2))
    assert video.name
    assert len(frames) == 2
    assert all((frame.depth > 0).any() for frame in frames)
    assert frames[0].camera == frames[1].camera
    assert frames[0].index < frames[1].index
    assert began <= frames[0].timestamp < frames[1].timestamp <= time.time()


def test_live_video_can_be_reopened_after_close(video: LiveVideo) -> None:
    for _ in range(2):
        assert len(list(islice(come(video), 1))) == 1
