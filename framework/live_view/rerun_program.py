"""Control of the rerun executable (rerun-sdk 0.41).

The executable listens on 127.0.0.1 instead of its default 0.0.0.0.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

HERE = "127.0.0.1"
TIMEOUT_S = 60.0  # s, maximum startup time, also on a busy machine
POLL_S = 0.05  # s, interval between connection attempts


def program() -> str:
    """Return the path of the rerun executable.

    The `rerun` script in the bin folder of Python is only a launcher. Stopping the script does not stop the executable.

    Raises:
        OSError: The executable is missing.
    """
    found = importlib.util.find_spec("rerun_cli")
    places = [Path(place) for place in (found and found.submodule_search_locations) or ()]
    places += [place / "Rerun.app" / "Contents" / "MacOS" for place in places]
    path = shutil.which("rerun", path=os.pathsep.join(map(str, places)))
    if path is None:
        raise OSError("rerun: expected an executable, got none; run pip install --force-reinstall rerun-sdk")
    return path


def open_window(port: int, memory_limit: str) -> None:
    """Open the viewer of rerun, unless a program already listens on the port.

    Usage statistics are disabled.

    Args:
        port: TCP port of the viewer.
        memory_limit: Maximum memory, such as 2GB or 25%.

    Raises:
        OSError: The viewer did not start.
        SubprocessError: The usage statistics could not be disabled.
    """
    subprocess.run([program(), "analytics", "disable"], check=True, capture_output=True, timeout=TIMEOUT_S)
    if listens(port):
        return
    limits = ["--memory-limit", memory_limit, "--hide-welcome-screen", "--expect-data-soon"]
    viewer = subprocess.Popen(
        [program(), "--bind", HERE, "--port", str(port), *limits],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"RUST_LOG": "error"},
        start_new_session=True,  # the viewer stays open after the run, also after Ctrl-C
    )
    _wait_for(viewer, port)


@contextmanager
def page_server() -> Iterator[str]:
    """Run the web server of rerun in the `with` body, and yield its address.

    Raises:
        OSError: The server did not start.
    """
    port = free_port()
    ports = ["--port", str(free_port()), "--web-viewer-port", str(port)]
    # rerun sends usage statistics from the second start in a home folder, so each start gets a new one
    with tempfile.TemporaryDirectory(prefix="instancemap-rerun-") as home:
        homes = dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"), home)
        with subprocess.Popen(
            [program(), "--serve-web", "--bind", HERE, *ports],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | homes,
        ) as server:
            try:
                _wait_for(server, port)
                yield f"http://{HERE}:{port}"
            finally:
                server.kill()


def listens(port: int) -> bool:
    """Return True if a program listens on a TCP port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((HERE, port)) == 0


def free_port() -> int:
    """Return an unused TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind((HERE, 0))
        port: int = probe.getsockname()[1]
    return port


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not listens(port):
        if process.poll() is not None:
            raise OSError(f"rerun: expected a server on port {port}, got exit status {process.returncode}")
        if time.monotonic() > deadline:
            raise OSError(f"rerun: expected a server on port {port} within {TIMEOUT_S:g} s, got a timeout")
        time.sleep(POLL_S)
