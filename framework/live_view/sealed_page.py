"""Server of the web viewer of rerun that blocks requests to other hosts.

In rerun-sdk 0.41, `rr.serve_web_viewer` has no bind option and listens on 0.0.0.0. `rerun --serve-web --bind` listens
on 127.0.0.1, but its page sends usage statistics and requests news, examples and fonts. This module therefore downloads
the files of the page from the server of rerun. It serves them on 127.0.0.1 with a Content-Security-Policy.
"""

from __future__ import annotations

from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import quote
from urllib.request import ProxyHandler, build_opener

from framework.live_view.rerun_program import HERE, page_server

FILES = ("/", "/re_viewer.js", "/re_viewer_bg.wasm", "/sw.js")  # paths of the files of the page, 43 MB in total
SOURCES = "'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob: data:"
SOURCE_TIMEOUT_S = 30.0  # s, maximum wait for a file from rerun's server


class SealedPage:
    """HTTP server of the web page of rerun on 127.0.0.1.

    The page may connect only to `data_port` of this machine. `close` stops the server.

    Raises:
        OSError: The port is in use or the page is not available.
    """

    def __init__(self, port: int, data_port: int) -> None:
        data = f"http://{HERE}:{data_port} http://localhost:{data_port}"
        policy = f"default-src {SOURCES}; connect-src 'self' blob: data: {data}"
        files: dict[str, tuple[bytes, str]] = {}

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                if path not in files:
                    self.send_error(404)
                    return
                content, content_type = files[path]
                self.send_response(200)
                self.send_header("Content-Type", content_type)
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Content-Security-Policy", policy)
                self.end_headers()
                try:
                    self.wfile.write(content)
                except ConnectionError:  # the browser was closed
                    self.close_connection = True

            def log_message(self, format: str, *args: object) -> None:
                """Suppress the request log."""

        self._server = ThreadingHTTPServer((HERE, port), Handler)  # before the download, because the port may be in use
        try:
            files |= page_files()
        except BaseException:
            self._server.server_close()
            raise
        Thread(target=self._server.serve_forever, name="viewer-page", daemon=True).start()
        self.url = f"http://{HERE}:{port}/?url={quote(f'rerun+http://{HERE}:{data_port}/proxy', safe='')}"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


def page_files() -> dict[str, tuple[bytes, str]]:
    """Return the content and content type of each file of the page, by path.

    Raises:
        OSError: The server of rerun failed.
    """
    opener = build_opener(ProxyHandler({}))  # no proxy for 127.0.0.1
    files = {}
    with page_server() as address:
        for path in FILES:
            with opener.open(address + path, timeout=SOURCE_TIMEOUT_S) as answer:
                files[path] = answer.read(), answer.headers["Content-Type"]
    return files
