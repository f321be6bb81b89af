"""Names of a sweep's directories."""

from __future__ import annotations

from framework.command_line import directory_name


def test_overrides_become_one_directory() -> None:
    assert directory_name("dataset.root=../a/b,seed=1") == "dataset.root=.._a_b,seed=1"
    assert directory_name("") == "defaults"


def test_long_overrides_stay_distinct_and_short() -> None:
    names = [directory_name("dataset.root=" + 300 * "x" + f",seed={seed}") for seed in range(2)]
    assert names[0] != names[1]
    assert all(len(name) <= 200 for name in names)
