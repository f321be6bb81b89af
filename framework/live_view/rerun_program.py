"""rerun's own program (rerun-sdk 0.41), made to listen to this machine alone: by itself it listens to the network."""

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
PATIENCE_S = 60.0  # until it listens, on a machine that has much else to do
BETWEEN_S = 0.05  # looking whether it does


def program() -> str:
    """The path of rerun's program. Raises OSError where it is not there.

    The `rerun` that pip puts beside Python only starts this one, which would go on when the other is ended.
    """
    found = importlib.util.find_spec("rerun_cli")
    places = [Path(place) for place in (found and found.submodule_search_locations) or ()]
    places += [place / "Rerun.app" / "Contents" / "MacOS" for place in places]
    path = shutil.which("rerun", path=os.pathsep.join(map(str, places)))
    if path is None:
        raise OSError("rerun's program is not there: pip install --force-reinstall rerun-sdk")
    return path


def open_window(port: int, memory_limit: str) -> None:
    """Opens rerun's viewer, unless something listens on `port` already. It sends no statistics of its use.

    Raises OSError or SubprocessError where it cannot.
    """
    subprocess.run([program(), "analytics", "disable"], check=True, capture_output=True, timeout=PATIENCE_S)
    if listens(port):
        return
    limits = ["--memory-limit", memory_limit, "--hide-welcome-screen", "--expect-data-soon"]
    viewer = subprocess.Popen(
        [program(), "--bind", HERE, "--port", str(port), *limits],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"RUST_LOG": "error"},
        start_new_session=True,  # it stays when the run ends, by Ctrl-C too
    )
    _wait_for(viewer, port)


@contextmanager
def page_server() -> Iterator[str]:
    """The address of rerun's server of its page. Raises OSError where there is none.

    It sends no statistics: it does from a user's second time on, and finds a new home each time.
    """
    port = free_port()
    ports = ["--port", str(free_port()), "--web-viewer-port", str(port)]
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
    """Whether anybody listens on a port of this machine."""
    with socket.socket() as probe:
        return probe.connect_ex((HERE, port)) == 0


def free_port() -> int:
    """A port that nobody has."""
    with socket.socket() as probe:
        probe.bind((HERE, 0))
        port: int = probe.getsockname()[1]
    return port


def _wait_for(process: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not listens(port):
        if process.poll() is not None:
            raise OSError(f"it ended with status {process.returncode}")
        if time.monotonic() > deadline:
            raise OSError(f"it does not answer within {PATIENCE_S:g} s")
        time.sleep(BETWEEN_S)
