"""Tests for renamed config keys.

Old keys are rejected with the name of the new key, and no config contains old keys.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from framework.config.composition import composed
from framework.config.renamed_keys import RENAMED, new_name
from framework.errors import ConfigError
from framework.interfaces import MapFuser
from framework.registry import build

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    "override", ["map=outputs/demo", "fuser.on_top=0.5", "refiner.links.plane_removal.max_own=0.1"]
)
def test_renamed_key_override_error_names_new_key(override: str) -> None:
    key = override.partition("=")[0]
    with pytest.raises(ConfigError, match=str(new_name(key))):
        composed(override)


def test_renamed_key_stored_config_error_names_new_key() -> None:
    fuser = composed("dataset=desk").fuser
    stored = OmegaConf.create({**OmegaConf.to_container(fuser), "lying_on": 0.6})
    with pytest.raises(ConfigError, match=r"fuser\.support_overlap"):
        build(MapFuser, stored)


def test_configs_contain_no_renamed_key() -> None:
    config = OmegaConf.to_container(composed("dataset=desk"))
    assert isinstance(config, dict)
    groups = {group: node for group, node in config.items() if isinstance(node, dict)}
    flat = {*config, *(f"{group}.{key}" for group, node in groups.items() for key in node)}
    assert not flat & RENAMED.keys()


def test_docs_contain_no_renamed_key() -> None:
    pages = [CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"]
    pages += [path for folder in ("docs", "examples", "conf") for path in (CHECKOUT / folder).rglob("*.md")]
    pages += [path for folder in ("examples", "conf") for path in (CHECKOUT / folder).rglob("*.yaml")]
    names = [re.escape(key) if "." in key else f"{key}=" for key in RENAMED]
    old = re.compile(rf"(?<![\w.])(?:{'|'.join(names)})(?![\w./-])")
    found = [f"{path.relative_to(CHECKOUT)}: {m.group()}" for path in pages for m in old.finditer(path.read_text())]
    assert not found
