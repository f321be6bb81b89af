"""Tests for the published results."""

from __future__ import annotations

import pytest

from framework.errors import ConfigError
from framework.tables.published import read_published
from framework.vocabulary.label_spaces import SCENENN_TO_COCO

SEQUENCES = ("011", "016", "030", "061", "078", "086", "096", "206", "223", "255")


def test_published_ap_row_is_converted_from_percent() -> None:
    percent = {"011": 65.5, "016": 3.3, "030": 67.6, "061": 26.9, "078": 51.7, "086": 32.5, "096": 29.9, "223": 19.0}
    [known] = [row for row in read_published("table3").rows if row.values is not None]
    assert known.values == pytest.approx({(sequence,): value / 100 for sequence, value in percent.items()})
    assert "Han et al., ICRA 2021" in known.source
    assert "its classes differ" in known.remark
    assert known.poses == "ground truth"


def test_published_table1_contains_frame_rate_of_paper() -> None:
    [known] = [row for row in read_published("table1").rows if row.values is not None]
    assert known.values is not None
    assert (known.system, known.values["fps",], known.decimals) == ("the paper", 10.8, 1)
    assert known.values["stage_ms.integration.median",] is None


@pytest.mark.parametrize("table", ["table2", "table3"])
def test_published_values_belong_to_paper_sequences(table: str) -> None:
    published = read_published(table)
    assert published.sequences == SEQUENCES
    assert {key[0] for row in published.rows for key in row.values or ()} < set(SEQUENCES)
    assert all(row.source for row in published.rows)
    assert all(0 <= value <= 1 for row in published.rows for value in (row.values or {}).values() if value is not None)


def test_published_classes_are_table_columns() -> None:
    columns = {"instances.ap50", *(f"instances.ap50.{name}" for name in SCENENN_TO_COCO.values())}
    assert {key[1] for row in read_published("table2").rows for key in row.values or ()} < columns


def test_published_tables_agree_on_sequence_means() -> None:
    [by_class] = [row.values for row in read_published("table2").rows if row.values is not None]
    [by_sequence] = [row.values for row in read_published("table3").rows if row.values is not None]
    assert {key[0]: value for key, value in by_class.items() if key[1] == "instances.ap50"} == {
        key[0]: value for key, value in by_sequence.items()
    }


def test_read_published_unknown_table_raises() -> None:
    with pytest.raises(ConfigError, match="one of table1, table2, table3, got table4"):
        read_published("table4")
