"""The page of rerun's viewer, sealed: what a browser shows there may talk to nobody but this machine.

As rerun serves it, the page sends statistics of its use to its makers, and asks several servers for news, examples and
fonts (0.41, seen in a browser). A Content-Security-Policy forbids that; rerun's own server cannot be told to send one.
"""

from __future__ import annotations

import socket
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import quote

HERE = "127.0.0.1"
PASSED_ON = ("Content-Type", "Content-Encoding", "Content-Length")
SOURCES = "'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:"
SOURCE_TIMEOUT_S = 30.0


class SealedPage:
    """Serves the page on `port` of this machine's own address, until it is closed. Raises OSError where it cannot.

    `data_port` is where the data are; the page may have them, under either name of this machine.
    """

    def __init__(self, port: int, data_port: int) -> None:
        import rerun

        source_port = free_port()
        data = f"http://{HERE}:{data_port} http://localhost:{data_port}"
        policy = f"default-src {SOURCES}; connect-src 'self' blob: data: {data}"

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                source = HTTPConnection(HERE, source_port, timeout=SOURCE_TIMEOUT_S)
                source.request("GET", self.path)
                answer = source.getresponse()
                content = answer.read()
                self.send_response(answer.status)
                for name in PASSED_ON:
                    if value := answer.getheader(name):
                        self.send_header(name, value)
                self.send_header("Content-Security-Policy", policy)
                self.end_headers()
                self.wfile.write(content)
                source.close()

            def log_message(self, format: str, *args: object) -> None:
                """Nobody asked."""

        self._server = ThreadingHTTPServer((HERE, port), Handler)
        rerun.serve_web_viewer(web_port=source_port, open_browser=False)
        Thread(target=self._server.serve_forever, name="viewer-page", daemon=True).start()
        self.url = f"http://{HERE}:{port}/?url={quote(f'rerun+http://{HERE}:{data_port}/proxy', safe='')}"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def free_port() -> int:
    """A port that nobody has."""
    with socket.socket() as probe:
        probe.bind((HERE, 0))
        port: int = probe.getsockname()[1]
    return port
