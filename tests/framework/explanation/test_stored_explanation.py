"""Tests for explanation.json, its report section and the figure of the contributions."""

from __future__ import annotations

from pathlib import Path

import pytest

from framework.errors import DataError
from framework.explanation.causes import Cause, FalseInstance
from framework.explanation.contributions import STAGES, Contributions, losses_of
from framework.explanation.replay import Explanation
from framework.explanation.stored_explanation import EXPLANATION, StoredExplanation, write_explanation
from framework.figures.contribution_figure import COLORS, contribution_figure
from framework.reporting.charts import contribution_bar
from framework.runs.stored_runs import INSTANCES
from tests.framework.explanation.test_causes import FRAME, SECOND, explained
from tests.framework.explanation.test_contributions import additive

CONTRIBUTIONS = Contributions.of("instances.ap50", losses_of(additive))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Return a folder with the instances and the explanation of a run."""
    (tmp_path / INSTANCES).write_text("[]")
    objects, _ = explained(FRAME, SECOND)
    false = FalseInstance(9, "tv", Cause.DETECTION, "3 of its 3 masks are on no object", 3, {0: 100})
    write_explanation(tmp_path, Explanation(tuple(objects.values()), (false,), CONTRIBUTIONS))
    return tmp_path


def test_stored_explanation_is_read_unchanged(run: Path) -> None:
    stored = StoredExplanation.read(run)
    assert stored is not None
    assert stored.is_current
    assert [(one.id, one.state, one.cause) for one in stored.lost] == [(1, "missed", "fusion")]
    assert [(one.id, one.state, one.cause, one.frame) for one in stored.false] == [(9, "false", "detection", -1)]
    assert stored.contributions == CONTRIBUTIONS


def test_stored_explanation_of_earlier_run_is_not_current(run: Path) -> None:
    (run / INSTANCES).write_text("[ ]")
    stored = StoredExplanation.read(run)
    assert stored is not None
    assert not stored.is_current


def test_stored_explanation_missing_or_invalid(run: Path) -> None:
    assert StoredExplanation.read(run.parent) is None
    (run / EXPLANATION).write_text('{"objects": [{}]}')
    with pytest.raises(DataError, match="expected the file of `instancemap explain`"):
        StoredExplanation.read(run)


def test_contribution_figure_has_bars_of_runs_and_mean(tmp_path: Path) -> None:
    page = contribution_figure({"a": CONTRIBUTIONS, "b": CONTRIBUTIONS})
    bars = page.figure.axes[0].containers
    assert len(bars) == 3 * len(COLORS)
    assert {path.suffix for path in page.write(tmp_path / "bars")} == {".png", ".pdf"}


def test_contribution_bar_has_one_part_per_stage() -> None:
    bar = contribution_bar(CONTRIBUTIONS)
    assert all(f'id="contribution-{stage.value[:4]}"' in bar for stage in STAGES)
