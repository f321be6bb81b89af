"""Fixtures and settings of all tests."""

from __future__ import annotations

import functools
import os
import random
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest

import tests.support.cores  # isort: skip; sets variables that numba reads when it is loaded

pytest.register_assert_rewrite("framework.testing")  # before these modules are imported

import tests.support.cached_lights  # noqa: E402, F401
from framework.config import composition  # noqa: E402
from tests.support.scenes.corner_room import CornerRoom  # noqa: E402
from tests.support.small_overviews import use_small_overviews  # noqa: E402

os.environ.setdefault("INSTANCEMAP_OFFLINE", "1")  # tests never download weights, 180 MB
# with a deadline, tests would fail on a busy machine
hypothesis.settings.register_profile("tests", deadline=None, derandomize=True)
hypothesis.settings.load_profile("tests")
CHECKOUT = Path(__file__).resolve().parent.parent

# ignored signals are inherited, e.g. SIGINT in a background job and SIGHUP under nohup
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


MARKERS = ("unit", "integration", "acceptance")
INTEGRATION_FIXTURES = {"shared", "shared_data", "benchmark"}
SLOW_UNIT_TEST = 2.0  # s, minimum duration of a unit test that is listed as slow


@pytest.hookimpl(tryfirst=True)  # before -m deselects tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests without a marker as unit tests, or as integration tests if they use real data or are benchmarks."""
    for item in items:
        if not any(item.get_closest_marker(marker) for marker in MARKERS):
            fixtures = INTEGRATION_FIXTURES & set(getattr(item, "fixturenames", ()))
            item.add_marker("integration" if fixtures else "unit")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the unit tests that take longer than SLOW_UNIT_TEST."""
    reports = [report for report in terminalreporter.stats.get("passed", []) if "unit" in report.keywords]
    for report in sorted(reports, key=lambda report: -report.duration):
        if report.duration > SLOW_UNIT_TEST:
            terminalreporter.write_line(f"slow unit test: {report.duration:.1f} s {report.nodeid}")


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Seed the random numbers of every test."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the directory `shared` next to the checkout, which contains data and weights. Skip the test without it."""
    directory = CHECKOUT.parent / "shared"
    if not directory.is_dir():
        pytest.skip(f"{directory} with data and weights does not exist")
    return directory


@pytest.fixture(scope="session")
def shared_data(shared: Path) -> Path:
    """Return the directory `shared/data` with RGB-D folders."""
    if not (shared / "data").is_dir():
        pytest.skip(f"{shared / 'data'} does not exist")
    return shared / "data"


@pytest.fixture(scope="session")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Any]:
    """Return a function that builds a plugin with generated input files and skips the test if a package is missing."""
    from tests.support import option_files, registered

    made = functools.cache(lambda *option: option_files.overrides(*option, tmp_path_factory.mktemp(option[1])))

    def build(stage: str, name: str) -> Any:
        return registered.built(stage, name, *made(stage, name))

    return build


@pytest.fixture
def room() -> CornerRoom:
    """Return a sequence of six frames with exact ground truth."""
    return CornerRoom()


@pytest.fixture
def small_overviews(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write smaller overview images, which saves about 0.3 s of each run or edit."""
    use_small_overviews(monkeypatch)


@pytest.fixture
def fakes_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Register the stages of tests/support/fake_conf, like the option --config-dir."""
    monkeypatch.setattr(composition, "_added", [CHECKOUT / "tests" / "support" / "fake_conf"])
