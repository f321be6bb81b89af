"""Tests for the acceptance page."""

from __future__ import annotations

from pathlib import Path

from tests.acceptance.runner import is_current, read_rows, write_rows

ROW = ["kitchen_ate", "12.1", "ATE <= 15 mm", "abc1234, 2026-01-01", "AMD EPYC"]


def test_acceptance_page_round_trip_keeps_rows(tmp_path: Path) -> None:
    write_rows({"kitchen_ate": ROW}, tmp_path / "page.md")
    assert read_rows(tmp_path / "page.md") == {"kitchen_ate": ROW}


def test_acceptance_row_of_unknown_or_dirty_commit_is_outdated() -> None:
    assert not is_current(ROW, ["framework"])
    assert not is_current([*ROW[:3], "abc1234+, 2026-01-01", "AMD EPYC"], ["framework"])
