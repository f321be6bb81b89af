"""Tests for the settings of comparison tables."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.tables.table_choice import TableChoice


@pytest.mark.parametrize(
    ("node", "message"),
    [
        ({"columns": []}, r"table\.columns: expected at least one key, got none"),
        ({"average_over": [], "columns": ["fps"]}, r"table\.average_over: expected at least one key, got none"),
        (
            {"columns_by": "dataset.scene", "group_by": "dataset.scene", "columns": ["fps"]},
            "table.columns_by, table.group_by: expected at most one key, got dataset.scene and dataset.scene",
        ),
        (
            {"columns_by": "seed", "columns": ["fps"]},
            "table.average_over: .*table.columns_by, got seed",
        ),
        (
            {"group_by": "seed", "columns": ["fps"]},
            "table.average_over: .*table.group_by, got seed",
        ),
        (
            {"columns_by": "dataset.scene", "columns": ["fps", "frames"]},
            r"table\.columns: expected one metric with table\.columns_by, got 2; set table\.columns_by=null and",
        ),
        ({"published": "table4", "columns": ["fps"]}, r"table\.published: expected null or one"),
        (
            {"published": "table3", "columns": ["fps"]},
            r"table\.published: expected a section for the layout rows, got table3 for the layout columns_by",
        ),
        (
            {"published": "table1", "group_by": "dataset.scene", "columns": ["fps"]},
            r"table\.published: expected a section for the layout group_by, got table1 for the layout rows",
        ),
        (
            {"names": ["ours"], "columns": ["fps"]},
            r"table\.names: expected a mapping from names to strings, got \['ours'\]",
        ),
        ({"colums": ["fps"]}, "table: expected one of .*, got 'colums'"),
        ({"columns": "fps"}, r"table\.columns: expected a list of strings, got 'fps'"),
        ([], "table: expected keys and values"),
        ("fps", "table: expected keys and values"),
    ],
)
def test_table_choice_invalid_settings_raise(node: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        TableChoice.of(node)
    assert "\n" not in str(caught.value)
