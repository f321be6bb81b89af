"""Old config keys are rejected with the new key, and the configs do not contain any."""

from __future__ import annotations

import pytest
from omegaconf import OmegaConf

from framework.config.composition import composed
from framework.config.renamed_keys import RENAMED, new_name
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner, MapFuser
from framework.registry import build


@pytest.mark.parametrize(
    "override", ["map=outputs/demo", "fuser.on_top=0.5", "refiner.links.plane_removal.max_own=0.1"]
)
def test_override_old_key_names_new_key(override: str) -> None:
    key = override.partition("=")[0]
    with pytest.raises(ConfigError, match=str(new_name(key))):
        composed(override)


def test_stored_config_old_parameter_names_new_key() -> None:
    fuser = composed("dataset=desk").fuser
    stored = OmegaConf.create({**OmegaConf.to_container(fuser), "lying_on": 0.6})
    with pytest.raises(ConfigError, match=r"fuser\.support_overlap"):
        build(MapFuser, stored)


def test_renamed_keys_are_unknown_and_new_keys_exist() -> None:
    for stage, interface in (("fuser", MapFuser), ("refiner", ClusterRefiner)):
        assert interface
        config = composed(f"{stage}={'object_volumes' if stage == 'fuser' else 'connected'}")[stage]
        old = {key.partition(".")[2] for key in RENAMED if key.startswith(f"{stage}.")}
        assert not old & set(config)
