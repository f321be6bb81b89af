"""Messages are one line that a person reads, whatever a file or a name was made of."""

from __future__ import annotations

import pickle

import pytest

from framework.config.composition import one_line
from framework.errors import ConfigError, DataError, FrameError, InstanceMapError, printable


def test_a_usual_message_is_left_as_it_is() -> None:
    said = "/data/scene 1/camera.json: fx must be a number of pixels, found 'näh'"
    assert str(DataError(said)) == said
    assert str(InstanceMapError()) == ""


@pytest.mark.parametrize(
    "given", ["x" * 100_000, "x y " * 30_000, "\udcff" * 1000, "\x1b[2J" * 1000, "\n" * 5000, "a\u2028b" * 1000, "\0"]
)
def test_a_long_or_unprintable_name_is_shortened_and_escaped(given: str) -> None:
    said = str(ConfigError(f"detector.label_space: there is no {given}; did you mean 'coco'?"))
    assert said.isprintable()
    assert len(said) <= 1000
    assert said.startswith("detector.label_space: there is no ")
    assert str(ConfigError(said)) == said, "once is enough"
    assert one_line(ValueError(given)).isprintable()
    assert said.encode()


def test_a_long_word_says_how_long_it_was_and_what_follows_stays() -> None:
    said = printable(f"there is no {'x' * 5000}; did you mean 'coco'?")
    assert "(5001 characters)" in said
    assert said.endswith("did you mean 'coco'?")
    assert said.count("x") <= 200


def test_an_error_crosses_processes() -> None:
    error = pickle.loads(pickle.dumps(FrameError("frame 3 is damaged")))
    assert (type(error), str(error)) == (FrameError, "frame 3 is damaged")
