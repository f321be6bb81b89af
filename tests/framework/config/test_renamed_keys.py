"""Tests for renamed config keys, which work and log a warning."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.config import renamed_keys
from framework.config.composition import composed
from framework.config.renamed_keys import DEPRECATED, replace_in_config
from framework.config.text_values import literal
from framework.config.validation import checked_rows
from framework.interfaces import ClusterRefiner
from framework.registry import build, text_kind
from framework.tables.table_choice import TableChoice

CHECKOUT = Path(__file__).resolve().parents[3]


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
