"""Messages are one line that a person reads, whatever a file or a name was made of."""

from __future__ import annotations

import pickle

import pytest

from framework.config.composition import one_line
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, printable


def test_error_message_of_usual_text_is_unchanged() -> None:
    said = "/data/scene 1/camera.json: fx must be a number of pixels, found 'näh'"
    assert str(DataError(said)) == said
    assert str(InstanceMapError()) == ""


@pytest.mark.parametrize(
    "given", ["x" * 100_000, "x y " * 30_000, "\udcff" * 1000, "\x1b[2J" * 1000, "\n" * 5000, "a\u2028b" * 1000, "\0"]
)
def test_error_message_is_shortened_and_escaped(given: str) -> None:
    said = str(ConfigError(f"detector.label_space: there is no {given}; did you mean 'coco'?"))
    assert said.isprintable()
    assert len(said) <= 1000
    assert said.startswith("detector.label_space: there is no ")
    assert str(ConfigError(said)) == said, "once is enough"
    assert one_line(ValueError(given)).isprintable()
    assert said.encode()


def test_printable_long_word_is_replaced_by_its_length() -> None:
    said = printable(f"there is no {'x' * 5000}; did you mean 'coco'?")
    assert "(5001 characters)" in said
    assert said.endswith("did you mean 'coco'?")
    assert said.count("x") <= 200


def test_frame_error_pickle_round_trip_keeps_message() -> None:
    error = pickle.loads(pickle.dumps(FrameError("frame 3 is damaged")))
    assert (type(error), str(error)) == (FrameError, "frame 3 is damaged")
