"""Shared settings of the benchmarks.

Benchmarks run only on request. The tables are printed at the end.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.benchmarks.comparison import Table

HERE = Path(__file__).resolve().parent
TABLES = pytest.StashKey[list[Table]]()


@pytest.hookimpl(tryfirst=True)  # before pytest-benchmark reads its options
def pytest_configure(config: pytest.Config) -> None:
    """Enable the benchmarks if pytest is called on this folder. A plain `pytest` skips them."""
    config.stash.setdefault(TABLES, [])
    named = [Path(config.invocation_params.dir, argument.split("::")[0]).resolve() for argument in config.args]
    if named and all(path.is_relative_to(HERE) for path in named):
        config.option.benchmark_skip = False


@pytest.fixture(scope="session")
def tables(pytestconfig: pytest.Config) -> list[Table]:
    """Return the list of tables that are printed after all tests."""
    return pytestconfig.stash[TABLES]


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for table in config.stash[TABLES]:
        terminalreporter.write_line("")
        for line in table.lines():
            terminalreporter.write_line(line)
