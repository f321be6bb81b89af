"""Tests for the checks of environment variables and of the limit of threads."""

from __future__ import annotations

import threading

import pytest

from framework.errors import ConfigError
from framework.runtime import environment_checks
from framework.runtime.environment_checks import check_thread_limit, environment_errors

VARIABLES = ("NUM_THREADS", "DISABLE_JIT", "THREADING_LAYER", "THREADING_LAYER_PRIORITY")


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(f"NUMBA_{name}", raising=False)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *(("NUM_THREADS", wrong, "expected an integer in [1, 4096]") for wrong in ("0", "-1", "x", "", "1.5", "9999")),
        *(("DISABLE_JIT", wrong, "expected 0") for wrong in ("1", "true", "")),
        ("THREADING_LAYER", "foo", "expected one of default, omp, workqueue"),
        ("THREADING_LAYER", "TBB", "expected an installed TBB"),
        ("THREADING_LAYER_PRIORITY", "omp", "expected the words omp, tbb and workqueue"),
    ],
)
def test_environment_invalid_variable_is_one_error(
    name: str, value: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environment_checks, "_has_tbb", lambda: False)
    monkeypatch.setenv(f"NUMBA_{name}", value)
    [error] = environment_errors()
    assert error.startswith(f"NUMBA_{name}: {message}")
    assert f"got {'none' if value == 'TBB' else repr(value)}; " in error


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("NUM_THREADS", "64"),
        ("DISABLE_JIT", "0"),
        ("THREADING_LAYER", "workqueue"),
        ("THREADING_LAYER", "tbb"),
        ("THREADING_LAYER_PRIORITY", "omp tbb workqueue"),
    ],
)
def test_environment_valid_variable_is_accepted(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment_checks, "_has_tbb", lambda: True)
    assert environment_errors() == []
    monkeypatch.setenv(f"NUMBA_{name}", value)
    assert environment_errors() == []


@pytest.mark.parametrize(("limit", "cores"), [(3, 1), (7, 2)])
def test_thread_limit_too_low_raises(limit: int, cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[threading.Thread] = []
    start = threading.Thread.start

    def start_below_limit(thread: threading.Thread) -> None:
        if 1 + len(started) == limit:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(environment_checks, "available_cores", lambda: cores)
    check_thread_limit()
    monkeypatch.setattr(threading.Thread, "start", start_below_limit)
    with pytest.raises(ConfigError, match=rf"^process limit: expected .* for {cores} cores, got {limit}; raise the"):
        check_thread_limit()
    assert not any(thread.is_alive() for thread in started)
