"""Tests for the validation of experiment rows."""

from __future__ import annotations

from typing import Any

import pytest
from omegaconf import OmegaConf

from framework.config.validation import checked_rows
from framework.errors import ConfigError


def test_experiment_rows_give_overrides() -> None:
    config = OmegaConf.create("{kind: gmm_em, rows: {ours: [], 2: ['refiner=${kind}', fuser.min_overlap=0.1]}}")
    found = checked_rows(config.rows)
    assert found == {"ours": [], "2": ["refiner=gmm_em", "fuser.min_overlap=0.1"]}
    assert checked_rows(None) == checked_rows({}) == {}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ({"mine": None}, r"rows\.mine: expected a list of overrides, got None"),
        ({"mine": "refiner=kmeans"}, r"rows\.mine: expected a list of overrides, got 'refiner=kmeans'"),
        ({"mine": {"refiner": "kmeans"}}, r"rows\.mine: expected a list of overrides"),
        ({"mine": [{"refiner": "kmeans"}]}, r"rows\.mine: expected a list of overrides"),
        (["refiner=kmeans"], "rows: expected a mapping of names to overrides"),
        ("mine", "rows: expected a mapping of names to overrides"),
    ],
)
def test_experiment_rows_invalid_raise_one_line_error(rows: Any, message: str) -> None:
    for node in (rows, OmegaConf.create({"rows": rows}).rows):
        with pytest.raises(ConfigError, match=message) as caught:
            checked_rows(node)
        assert "\n" not in str(caught.value)
