"""Tests for the report section about lost objects and false instances."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from framework.explanation.stored_explanation import EXPLANATION, StoredExplanation
from framework.files.json_file import read_json, write_json
from framework.reporting.explanation_section import OUTDATED, explanation_section
from framework.runs.stored_runs import INSTANCES
from tests.framework.explanation.test_stored_explanation import CONTRIBUTIONS, run

__all__ = ["run"]  # fixture


def section_of(directory: Path, shown: int) -> dict[str, Any] | None:
    """Return the section of a run whose tracked frames 0 to 9 show the true object `shown`."""
    contents: Any = SimpleNamespace(record=SimpleNamespace(directory=directory), tracked_frames=tuple(range(10)))
    instance_ids = np.zeros((48, 64), np.int32)
    instance_ids[10:30, 20:40] = shown
    frame = SimpleNamespace(color=np.zeros((48, 64, 3), np.uint8), truth=SimpleNamespace(instance_ids=instance_ids))
    source: Any = SimpleNamespace(frame=lambda _: frame)
    return explanation_section(contents, source)


def test_explanation_section_without_file_is_none(tmp_path: Path) -> None:
    assert section_of(tmp_path, 1) is None


def test_explanation_section_lists_causes_and_stages(run: Path) -> None:
    section = section_of(run, 1)
    assert section is not None
    assert section["outdated"] == ""
    assert [(one.state, one.id) for one, _ in section["rows"]] == [("missed", 1), ("false", 9)]
    assert section["contributions"] == list(CONTRIBUTIONS.named().items())
    assert section["metric"] == "instances.ap50"
    assert section["bar"].startswith("<svg")


@pytest.mark.parametrize(("shown", "pictured"), [(1, True), (2, False)])
def test_explanation_section_pictures_visible_objects(run: Path, shown: int, pictured: bool) -> None:
    stored = StoredExplanation.read(run)
    section = section_of(run, shown)
    assert stored is not None
    assert section is not None
    (_, picture), (_, of_false) = section["rows"]
    assert (picture is not None) == pictured
    assert of_false is None
    if picture is not None:
        assert picture.url.startswith("data:image/webp")
        assert picture.source == f"frame {stored.lost[0].frame}"


def test_explanation_section_omits_missing_contributions(run: Path) -> None:
    content = read_json(run / EXPLANATION)
    write_json(run / EXPLANATION, content | {"contributions": None})
    section = section_of(run, 1)
    assert section is not None
    assert (section["bar"], section["contributions"]) == ("", [])


def test_explanation_section_of_earlier_run_has_notice(run: Path) -> None:
    (run / INSTANCES).write_text("[ ]")
    section = section_of(run, 1)
    assert section is not None
    assert (section["outdated"], section["rows"]) == (OUTDATED, [])
