"""Commands in forked processes.

The parent process has imported the libraries, which saves more than 1 s per command.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]
FAKE_CONF = CHECKOUT / "tests" / "support" / "fake_conf"
LIBRARIES = [
    "framework.api",
    "framework.commands.running.run",
    "framework.commands.running.sweep",
    "framework.rendering.overview",
    "scipy.spatial.transform",
    "tests.support.cached_lights",
    "tests.support.preloaded",
    "matplotlib.font_manager",
    "pycolmap",
    "threadpoolctl",
]
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(LIBRARIES)


def clean_environment() -> dict[str, str]:
    """Return the environment without the variable that makes Hydra print tracebacks."""
    return {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}


class ForkedCommand:
    """`python -m framework ARGUMENTS` in a forked process, with the interface of `subprocess.Popen`.

    Args:
        before: Module-level function that the process calls before the command.
    """

    def __init__(
        self,
        directory: Path,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        before: Callable[[], object] | None = None,
    ) -> None:
        self.args = ["framework", *arguments]
        self._streams = tempfile.TemporaryDirectory()
        given = dict(environment or clean_environment())
        run = (str(directory), self.args, given, self._streams.name, before)
        self._process = _context.Process(target=_run, args=run)
        self._process.start()
        assert self._process.pid
        self.pid: int = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Return stdout and stderr of the finished process. Raise `subprocess.TimeoutExpired` after `timeout` s."""
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0)
        stdout, stderr = (
            (Path(self._streams.name) / name).read_text(errors="backslashreplace") for name in ("stdout", "stderr")
        )
        return stdout, stderr


def completed(directory: Path, *arguments: str, timeout: float = 120) -> subprocess.CompletedProcess[str]:
    """Run `python -m framework ARGUMENTS` in a directory, like `subprocess.run`."""
    process = ForkedCommand(directory, *arguments)
    try:
        stdout, stderr = process.communicate(timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return subprocess.CompletedProcess(process.args, process.returncode or 0, stdout, stderr)


def _run(
    directory: str,
    arguments: list[str],
    environment: dict[str, str],
    streams: str,
    before: Callable[[], object] | None,
) -> None:
    os.setsid()
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(f"{streams}/{name}", os.O_CREAT | os.O_WRONLY | os.O_APPEND), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(directory)
    sys.path[:0] = [directory, str(CHECKOUT)]  # like with `python -m` and PYTHONPATH
    sys.argv = [str(CHECKOUT / "framework" / "__main__.py"), *arguments[1:]]
    if before:
        before()
    from framework.__main__ import main

    try:
        main()
    finally:
        atexit._run_exitfuncs()
