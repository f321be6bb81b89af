"""Tests for error messages. A message must be one printable line, whatever the file contains."""

from __future__ import annotations

import pickle

import pytest

from framework.config.composition import one_line
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, ParameterError, printable, reason_of


def test_error_message_of_usual_text_is_unchanged() -> None:
    message = "/data/scene 1/camera.json: fx must be a number of pixels, found 'näh'"
    assert str(DataError(message)) == message
    assert str(InstanceMapError()) == ""


@pytest.mark.parametrize(
    "given", ["x" * 100_000, "x y " * 30_000, "\udcff" * 1000, "\x1b[2J" * 1000, "\n" * 5000, "a\u2028b" * 1000, "\0"]
)
def test_error_message_is_shortened_and_escaped(given: str) -> None:
    message = str(ConfigError(f"detector.label_space: there is no {given}; did you mean 'coco'?"))
    assert message.isprintable()
    assert len(message) <= 1000
    assert message.startswith("detector.label_space: there is no ")
    assert str(ConfigError(message)) == message, "expected no change by a second escape"
    assert one_line(ValueError(given)).isprintable()
    assert message.encode()


def test_printable_long_word_is_shortened() -> None:
    message = printable(f"there is no {'x' * 5000}; did you mean 'coco'?")
    assert "(5001 characters)" in message
    assert message.endswith("did you mean 'coco'?")
    assert message.count("x") <= 200


def test_reason_of_quoted_file_is_short_line() -> None:
    reason = reason_of(ValueError("header\n" + "b'x' " * 1000))
    assert reason.startswith("header b'x'")
    assert len(reason) < 250
    assert reason_of(KeyError()) == "KeyError"


def test_frame_error_pickle_round_trip_keeps_message() -> None:
    error = pickle.loads(pickle.dumps(FrameError("frame 3 is damaged")))
    assert (type(error), str(error)) == (FrameError, "frame 3 is damaged")


def test_parameter_error_survives_other_process() -> None:
    error = pickle.loads(pickle.dumps(ParameterError("Dbscan", "eps", "expected at least 0.001, got 0")))
    assert (str(error), error.name) == ("Dbscan.eps: expected at least 0.001, got 0", "eps")
