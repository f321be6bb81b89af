"""Tests for renamed config keys.

Removed names are rejected with the name of the new key. Deprecated names work and log a warning. No config contains
either.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.config import renamed_keys
from framework.config.composition import composed
from framework.config.renamed_keys import DEPRECATED, RENAMED, new_name, replace_in_config
from framework.config.text_values import literal
from framework.config.validation import checked_rows
from framework.errors import ConfigError
from framework.interfaces import ClusterRefiner, MapFuser
from framework.registry import build, text_kind
from framework.tables.table_choice import TableChoice

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
    assert not flat & (RENAMED | DEPRECATED).keys()


def test_docs_contain_no_renamed_key() -> None:
    pages = [CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md"]
    pages += [path for folder in ("docs", "examples", "conf") for path in (CHECKOUT / folder).rglob("*.md")]
    pages += [path for folder in ("examples", "conf") for path in (CHECKOUT / folder).rglob("*.yaml")]
    names = [re.escape(key) if "." in key else f"{key}=" for key in RENAMED | DEPRECATED]
    old = re.compile(rf"(?<![\w.])(?:{'|'.join(names)})(?![\w./-])")
    found = [f"{path.relative_to(CHECKOUT)}: {m.group()}" for path in pages for m in old.finditer(path.read_text())]
    assert not found


@pytest.fixture
def deprecated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Deprecate names that never existed."""
    for old, new in {
        "early_frames": "prefetch",
        "fuser.grid": "fuser.voxel_size",
        "refiner.floor_share": "refiner.max_cluster_fraction",
        "table.averaged": "table.average_over",
    }.items():
        monkeypatch.setitem(DEPRECATED, old, new)
    renamed_keys._warn.cache_clear()


@pytest.mark.usefixtures("deprecated")
def test_deprecated_key_override_works_and_warns_once(caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(2):
        config = composed("fuser.grid=0.03", "early_frames=2")
        assert (config.fuser.voxel_size, config.prefetch) == (0.03, 2)
    [of_fuser, of_run] = [record.getMessage() for record in caplog.records]
    assert of_fuser.startswith("fuser.grid: ")
    assert "fuser.voxel_size" in of_fuser
    assert of_run.startswith("early_frames: ")


@pytest.mark.usefixtures("deprecated")
def test_deprecated_key_on_command_line_and_in_row_is_replaced() -> None:
    words = ["fuser.grid=0.03", "+refiner.links.plane_removal.floor_share=0.1", "seed=1"]
    expected = ["fuser.voxel_size=0.03", "+refiner.links.plane_removal.max_cluster_fraction=0.1", "seed=1"]
    assert literal(words, text_kind) == expected
    assert checked_rows({"mine": words}) == {"mine": expected}


@pytest.mark.usefixtures("deprecated")
def test_deprecated_key_of_option_sets_parameter(caplog: pytest.LogCaptureFixture) -> None:
    """As in a config file of the user."""
    refiner: Any = OmegaConf.to_container(composed("dataset=desk").refiner)
    refiner["links"]["plane_removal"]["floor_share"] = 0.125
    chain: Any = build(ClusterRefiner, OmegaConf.create(refiner))
    assert chain.links["plane_removal"].max_cluster_fraction == 0.125
    assert "refiner.max_cluster_fraction" in caplog.text


@pytest.mark.usefixtures("deprecated")
def test_deprecated_key_of_table_is_accepted() -> None:
    found = TableChoice.of({"averaged": ["seed"], "columns": ["fps"]})
    assert found.average_over == ["seed"]


@pytest.mark.usefixtures("deprecated")
def test_deprecated_key_of_stored_config_is_replaced(caplog: pytest.LogCaptureFixture) -> None:
    """Without a warning, because no setting of the user can avoid it."""
    stored = {"early_frames": 2, "fuser": {"grid": 0.03}, "refiner": {"links": {"plane_removal": {"floor_share": 1}}}}
    assert replace_in_config(stored) == {
        "prefetch": 2,
        "fuser": {"voxel_size": 0.03},
        "refiner": {"links": {"plane_removal": {"max_cluster_fraction": 1}}},
    }
    assert not caplog.records
