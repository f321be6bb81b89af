import pytest

from framework.datasets.frame_selection import check_selection, choose_frames
from framework.errors import ConfigError


def test_chooses_as_a_slice_does():
    assert list(choose_frames(10, 0, -1, 1)) == list(range(10))
    assert list(choose_frames(10, 2, 9, 3)) == [2, 5, 8]
    assert list(choose_frames(10, 8, 99, 1)) == [8, 9]


@pytest.mark.parametrize(
    ("start", "stop", "stride", "name"),
    [(-1, -1, 1, "start"), (0, -2, 1, "stop"), (5, 5, 1, "stop"), (0, -1, 0, "stride")],
)
def test_impossible_choices_name_their_parameter(start, stop, stride, name):
    with pytest.raises(ConfigError, match=f"dataset.{name}"):
        check_selection(start, stop, stride)


def test_a_start_behind_the_end_says_how_many_frames_there_are():
    with pytest.raises(ConfigError, match="only 3 frames"):
        choose_frames(3, 3, -1, 1)
