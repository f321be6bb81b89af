"""What a table shows, and what it refuses to."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.tables.comparison import TableChoice


@pytest.mark.parametrize(
    ("node", "said"),
    [
        ({"columns": []}, "table.columns must name at least one key"),
        ({"over": [], "columns": ["fps"]}, "table.over must name at least one key"),
        (
            {"across": "dataset.scene", "by": "dataset.scene", "columns": ["fps"]},
            "two layouts: one of them must be null",
        ),
        ({"across": "seed", "columns": ["fps"]}, "table.over has seed, whose values table.across shows one by one"),
        ({"by": "seed", "columns": ["fps"]}, "table.over has seed, whose values table.by shows one by one"),
        ({"across": "dataset.scene", "columns": ["fps", "frames"]}, "must name one figure, .* found 2; table.by="),
        ({"published": "table4", "columns": ["fps"]}, "table.published must be null or one of table1, table2, table3"),
        ({"published": "table3", "columns": ["fps"]}, "a table with another layout: across, found rows"),
        ({"published": "table1", "by": "dataset.scene", "columns": ["fps"]}, "another layout: rows, found by"),
        ({"names": ["ours"], "columns": ["fps"]}, "table: "),
        ({"colums": ["fps"]}, "colums"),
        ({"columns": "fps"}, "table: "),
        ([], "table must have keys and values"),
        ("fps", "table must have keys and values"),
    ],
)
def test_a_choice_checks_itself(node: object, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        TableChoice.of(node)
    assert "\n" not in str(caught.value)
