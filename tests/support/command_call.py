"""Commands of InstanceMap, run in the process of the tests."""

from __future__ import annotations

from types import ModuleType

import pytest


def call_command(
    module: ModuleType,
    arguments: tuple[object, ...],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> tuple[int, str, str]:
    """Run the command of a module, and return the exit status, stdout and stderr."""
    monkeypatch.setattr("sys.argv", ["instancemap", *map(str, arguments)])
    status = 0
    try:
        module.main()
    except SystemExit as ended:
        status = int(ended.code or 0)
    written = capsys.readouterr()
    return status, written.out, written.err
