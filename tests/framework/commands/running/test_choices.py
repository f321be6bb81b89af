"""Tests for the checks before the first run of a sweep."""

import pytest

from framework.commands.running.choices import GLOB_COUNT, check_outputs, checked_sweep, of_tables, single_run
from framework.config.composition import composed
from framework.config.validation import checked_rows
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


def check(*overrides: str, swept: tuple[str, ...] = ()) -> None:
    """Check the table and the figure of a sweep like `instancemap -m`."""
    config = composed(*overrides)
    check_outputs(config, [*overrides, *swept], checked_rows(config.get("rows")))


@pytest.mark.parametrize(
    "output",
    [
        "+table.average_over=[seed,dataset]",
        "+table.group_by=detector",
        "+table.columns_by=fuser.voxel_size",
        "+table.where.dataset.scene=[a,b]",
        "+table={where:{threads:1},group_by:preset}",
        "+table.base='refiner=identity, fuser.voxel_size=0.02'",
        "+figure={kind:bar,by:refiner,color_by:fuser.voxel_size}",
    ],
)
def test_check_outputs_accepts_options_and_parameters(output: str) -> None:
    check(output)


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (
            "+table.group_by=refner",
            "table.group_by: expected a group of options or a parameter, got refner; did you mean",
        ),
        ("+table.average_over=[seed,dataset.scenes]", "table.average_over: expected a group of options or a parameter"),
        ("+table.where.viewer=rerun", "table.where: expected a group of options or a parameter, got viewer"),
        ("+table.pair_by=[dataset]", "table.pair_by: expected one of seed, got dataset"),
        ("+table.base=identity", "table.base: expected KEY=VALUE, such as refiner=identity, got identity"),
        ("+table.base='refner=identity'", "table.base: expected a group of options or a parameter, got refner"),
        ("+table.colums=[fps]", "table: expected one of average_over, "),
        ("+table=rows", "table: expected keys and values, got 'rows'"),
        ("+figure={kind:bar,by:refner}", "figure.by: expected a group of options or a parameter, got refner; did you"),
        ("+figure={kind:curve,x:dataset.sotp}", "figure.x: expected a group of options or a parameter, got"),
        ("+figure.kind=pie", "figure.kind: expected one of stage_times, maps, bar, box, "),
    ],
)
def test_check_outputs_invalid_settings_raise(output: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        check(output)
    assert str(caught.value).startswith(message)


def test_check_outputs_finds_keys_of_swept_options_and_rows() -> None:
    check("+table.group_by=dataset.kind", swept=("dataset=desk,synthetic",))
    check("+table.group_by=detector.new", swept=("+detector.new=1,2",))
    with pytest.raises(ConfigError, match=r"table\.group_by: .*, got dataset\.kind"):
        check("+table.group_by=dataset.kind", swept=("dataset=desk,tum_rgbd",))
    check("experiment=ablation_refiner", "+table.where.refiner.object_centers=2", swept=("row=kmeans,gmm_em",))


def test_check_outputs_experiment_base_is_row() -> None:
    check("experiment=ablation_refiner", "table.base=kmeans")
    with pytest.raises(ConfigError, match=r"table\.base: expected one of chain, .*, got kmean"):
        check("experiment=ablation_refiner", "table.base=kmean")


def test_of_tables_lists_nested_keys() -> None:
    overrides = ["+table.where.dataset=desk", "dataset=desk", "table.columns=[fps]", "figure.names.a=b", "tablet=1"]
    assert of_tables(overrides) == ["table.where.dataset", "table.columns", "figure.names.a"]


@pytest.mark.parametrize(
    ("overrides", "fix"),
    [
        (["table.group_by=dataset"], "set +table.KEY=VALUE"),
        (["experiment=ablation_refiner", "table.where.dataset=desk"], "set +table.where.dataset=VALUE"),
    ],
)
def test_table_override_error_names_fix(overrides: list[str], fix: str) -> None:
    with pytest.raises(ConfigError) as caught:
        composed(*overrides)
    assert str(caught.value).endswith(fix)
