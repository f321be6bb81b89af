"""Tests of the checks before the first run of a sweep."""

import pytest

from framework.commands.running.choices import GLOB_COUNT, checked_sweep, single_run
from framework.errors import ConfigError

pytestmark = pytest.mark.integration

ROWS = ("ours", "voxblox_pp", "label_count")


@pytest.mark.parametrize(
    ("overrides", "runs"),
    [
        ([], 1),
        (["row=ours"], 1),
        (["row=ours,label_count", "seed=0,1", "~detector", "+new=1"], 4),
        (["row=ours,label_count", "seed=0,1,2", "row=ours"], 3),
        (["seed=range(0,3)", "sequences='a,b'", "row=choice(ours,voxblox_pp)"], 6),
        (["seed=range(0,3)", "dataset=glob(*)"], 3 * GLOB_COUNT),
    ],
)
def test_checked_sweep_counts_runs(overrides: list[str], runs: int) -> None:
    assert checked_sweep(overrides, ROWS) == runs


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["row=ours,voxblx_pp"], "row: expected one of ours, vox"),
        (["row="], "row: expected one of ours"),
        (["row=12"], "row: expected one of ours"),
        (["seed=range(0,0)", "row=ours"], "seed=range(0,0): expected at least one value, got none"),
    ],
)
def test_checked_sweep_invalid_overrides_raise(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        checked_sweep(overrides, ROWS)
    assert str(caught.value).startswith(message)


def test_checked_sweep_without_rows_accepts_any_row() -> None:
    assert checked_sweep(["row=a,b"], ()) == 2


def test_single_run_takes_first_value_of_each_sweep() -> None:
    overrides = ["row=a,b", "+x@y=range(2,5)", "seed=3", "~tracker", "name='a,b'", "dataset=glob(*)"]
    assert single_run(overrides) == ["row=a", "+x@y=2", "seed=3", "~tracker", "name='a,b'", "dataset=glob(*)"]
