"""What a table shows, and what it refuses to."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.tables.comparison import TableChoice


@pytest.mark.parametrize(
    ("node", "said"),
    [
        ({"columns": []}, "table.columns must name at least one key"),
        ({"average_over": [], "columns": ["fps"]}, "table.average_over must name at least one key"),
        (
            {"columns_by": "dataset.scene", "group_by": "dataset.scene", "columns": ["fps"]},
            "columns_by=dataset.scene, table.group_by=dataset.scene",
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
            "must name one figure, .* found 2; table.group_by=",
        ),
        ({"published": "table4", "columns": ["fps"]}, "table.published must be null or one of table1, table2, table3"),
        ({"published": "table3", "columns": ["fps"]}, "a table with another layout: columns_by, found rows"),
        (
            {"published": "table1", "group_by": "dataset.scene", "columns": ["fps"]},
            "another layout: rows, found group_by",
        ),
        ({"names": ["ours"], "columns": ["fps"]}, "table: "),
        ({"colums": ["fps"]}, "colums"),
        ({"columns": "fps"}, "table: "),
        ([], "table must have keys and values"),
        ("fps", "table must have keys and values"),
    ],
)
def test_table_choice_invalid_settings_raise(node: object, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        TableChoice.of(node)
    assert "\n" not in str(caught.value)
