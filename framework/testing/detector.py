"""The contract of a detector."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from framework.data import Detections, Frame, FrameTruth
from framework.errors import DataError
from framework.interfaces import Detector
from framework.testing.assertions import same
from framework.testing.corner_room import CAMERA, frame_at


class DetectorContract:
    """What every detector keeps."""

    stage = "detector"

    def plugin(self) -> Detector:
        raise NotImplementedError("the detector that is tested")

    def test_detector_returns_distributions_and_masks_in_the_image(self) -> None:
        detector = self.plugin()
        frame = frame_at(0)
        assert_keeps_the_contract(detector.detect(frame), detector, frame)

    def test_detector_gives_the_same_for_the_same_frame_in_any_order(self) -> None:
        detector = self.plugin()
        forwards = [detector.detect(frame_at(k)) for k in (0, 1)]
        backwards = [detector.detect(frame_at(k)) for k in (1, 0)]
        assert same(forwards[0], backwards[1])
        assert same(forwards[1], backwards[0])

    def test_detector_gives_the_same_in_another_thread_and_in_several_where_it_says_so(self) -> None:
        detector = self.plugin()
        frames = [frame_at(k) for k in (0, 1, 0, 1)]
        with ThreadPoolExecutor(3 if detector.concurrent else 1) as threads:
            found = list(threads.map(detector.detect, frames))
        for k in (0, 1):
            expected = detector.detect(frames[k])
            assert same(found[k], expected)
            assert same(found[k + 2], expected)

    def test_detector_takes_a_blank_image(self) -> None:
        detector = self.plugin()
        color, depth = np.zeros((*CAMERA.shape, 3), np.uint8), np.zeros(CAMERA.shape, np.float32)
        blank = Frame(0, 0.0, color, depth, CAMERA, truth=FrameTruth(np.zeros(CAMERA.shape, np.int32), {}))
        assert_keeps_the_contract(detector.detect(blank), detector, blank)

    def test_detector_needs_no_truth_or_says_so(self) -> None:
        detector = self.plugin()
        frame = frame_at(0, truth=False)
        try:
            assert_keeps_the_contract(detector.detect(frame), detector, frame)
        except DataError as error:
            assert "\n" not in str(error)


def assert_keeps_the_contract(found: Detections, detector: Detector, frame: Frame) -> None:
    assert found.classes == detector.classes
    assert found.masks.shape == (len(found), *frame.camera.shape)
    assert found.class_probabilities.shape == (len(found), len(detector.classes))
    np.testing.assert_allclose(found.class_probabilities.sum(axis=1), 1, atol=1e-4)
    assert (np.diff(found.scores) <= 0).all(), "best first"
    for mask, (x1, y1, x2, y2) in zip(found.masks, found.boxes, strict=True):
        assert -1 <= x1 <= x2 <= frame.camera.width + 1
        assert -1 <= y1 <= y2 <= frame.camera.height + 1
        v, u = np.nonzero(mask)
        if len(u):
            slack = 2  # px: boxes are regressed, masks are resampled
            assert u.min() >= x1 - slack
            assert u.max() <= x2 + slack
            assert v.min() >= y1 - slack
            assert v.max() <= y2 + slack
