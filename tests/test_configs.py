"""Every option of every config group composes and builds."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from framework.commands.plugins import registered as options_of
from framework.errors import ConfigError, DataError
from framework.files.search_paths import CONF
from framework.registry import STAGES
from tests import registered


@pytest.mark.parametrize(("stage", "name"), registered.OPTIONS)
def test_every_option_composes_and_builds(stage: str, name: str) -> None:
    """What needs data that are absent says so, naming the path; a path that only the user knows must be asked for."""
    try:
        plugin = registered.built(stage, name)
    except DataError as absent:
        assert "/" in str(absent)
        pytest.skip(f"needs data: {absent}")
    except ConfigError as missing:
        assert f"{stage}." in str(missing)
        assert "must be given" in str(missing)
        pytest.skip(f"needs a value that only the user knows: {missing}")
    assert isinstance(plugin, STAGES[stage])


@pytest.mark.parametrize(("stage", "name"), registered.OPTIONS)
def test_every_parameter_is_in_the_yaml_with_a_comment(stage: str, name: str) -> None:
    [option] = [option for option in options_of(stage) if option.name == name]
    assert option.documentation
    assert not option.documentation.startswith("cannot be used"), option.documentation
    node = registered.composed(stage, name)[stage]
    assert {parameter.name for parameter in option.parameters} == set(node) - {"_target_"}
    assert not [parameter.name for parameter in option.parameters if not parameter.comment]


@pytest.mark.parametrize("name", registered.names("dataset"))
def test_every_dataset_can_be_cut(name: str) -> None:
    assert {"start", "stop", "stride", "share"} <= set(registered.composed("dataset", name).dataset)


def test_the_main_config_reads_its_groups_in_the_order_that_lets_an_experiment_win() -> None:
    defaults = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").defaults)
    assert isinstance(defaults, list)
    assert defaults[0] == "_self_"
    assert [next(iter(entry)) for entry in defaults[1:]] == [*STAGES, "launcher", "experiment"]
    assert defaults[-1] == {"experiment": None}
