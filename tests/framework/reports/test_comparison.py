"""What a table shows, and what it refuses to."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.reports.comparison import TableChoice


@pytest.mark.parametrize(
    ("node", "said"),
    [
        ({"columns": []}, "table.columns must name at least one key"),
        ({"over": [], "columns": ["fps"]}, "table.over must name at least one key"),
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
