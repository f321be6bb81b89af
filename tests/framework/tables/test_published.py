"""What others have published: what is known, and that nothing is a guess."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.tables.published import read_published
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

SEQUENCES = ("011", "016", "030", "061", "078", "086", "096", "206", "223", "255")


def test_the_one_verified_row_is_in_our_unit() -> None:
    """The publication has these numbers in percent."""
    percent = {"011": 65.5, "016": 3.3, "030": 67.6, "061": 26.9, "078": 51.7, "086": 32.5, "096": 29.9, "223": 19.0}
    [known] = [row for row in read_published("table3").rows if row.values is not None]
    assert known.values == pytest.approx({(sequence,): value / 100 for sequence, value in percent.items()})
    assert "Han et al., ICRA 2021" in known.source
    assert "other classes" in known.remark
    assert known.poses == "ground truth"


def test_the_papers_own_run_time() -> None:
    [known] = [row for row in read_published("table1").rows if row.values is not None]
    assert known.values is not None
    assert (known.system, known.values["fps",], known.decimals) == ("the paper", 10.8, 1)
    assert known.values["stage_ms.integration.median",] is None


@pytest.mark.parametrize("table", ["table2", "table3"])
def test_sequences_are_the_papers_and_numbers_are_of_these(table: str) -> None:
    published = read_published(table)
    assert published.sequences == SEQUENCES
    assert {key[0] for row in published.rows for key in row.values or ()} < set(SEQUENCES)
    assert all(row.source for row in published.rows)
    assert all(0 <= value <= 1 for row in published.rows for value in (row.values or {}).values() if value is not None)


def test_classes_are_those_of_the_tables_columns() -> None:
    columns = {"instances.ap50", *(f"instances.ap50.{name}" for name in SCENENN_TO_COCO.values())}
    assert {key[1] for row in read_published("table2").rows for key in row.values or ()} < columns


def test_both_tables_agree_on_the_average_of_a_sequence() -> None:
    [by_class] = [row.values for row in read_published("table2").rows if row.values is not None]
    [by_sequence] = [row.values for row in read_published("table3").rows if row.values is not None]
    assert {key[0]: value for key, value in by_class.items() if key[1] == "instances.ap50"} == {
        key[0]: value for key, value in by_sequence.items()
    }


def test_a_section_that_is_not_there_is_told() -> None:
    with pytest.raises(ConfigError, match="one of table1, table2, table3, found table4"):
        read_published("table4")
