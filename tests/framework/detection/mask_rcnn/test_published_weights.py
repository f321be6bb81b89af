"""Tests for downloaded weights, with a local web server."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from framework.detection.mask_rcnn import published_weights
from framework.detection.mask_rcnn.published_weights import PUBLISHED, PublishedNetwork, find_network, networks_folder
from framework.errors import DataError
from framework.files.search_paths import PROJECT_ROOT

CONTENT = bytes(range(256)) * 20_000  # larger than one download block
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def server():
    """Serve CONTENT as /network.pth and a truncated copy as /cut.pth, and record the requested paths."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            if self.path not in ("/network.pth", "/cut.pth"):
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(CONTENT)))
            self.end_headers()
            self.wfile.write(CONTENT if self.path == "/network.pth" else CONTENT[:-1000])

        def log_message(self, *_):
            pass

    asked: list[str] = []
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        http.asked, http.address = asked, f"http://127.0.0.1:{http.server_port}"
        yield http
        http.shutdown()
        thread.join()


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Set an empty cache folder, allow downloads and return the folder."""
    monkeypatch.setattr(published_weights.platformdirs, "user_cache_path", lambda *_, **__: tmp_path / "cache")
    monkeypatch.delenv("INSTANCEMAP_OFFLINE")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    return networks_folder()


def offer(monkeypatch, url, digest=SHA256[:8], algorithm="sha256"):
    monkeypatch.setitem(PUBLISHED, "offered", PublishedNetwork(url, algorithm, digest, "MIT"))


def fault(name="offered"):
    with pytest.raises(DataError) as caught:
        find_network(Path(name))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_published_network_is_downloaded_once_and_logged(server, cache, monkeypatch, caplog):
    offer(monkeypatch, f"{server.address}/network.pth")
    with caplog.at_level("INFO"):
        path = find_network(Path("offered"))
    assert f"downloading {server.address}/network.pth, 5 MB, license MIT, into {cache}" in caplog.text
    assert path == cache / "network.pth"
    assert path.read_bytes() == CONTENT
    assert find_network(Path("offered")) == path
    assert server.asked == ["/network.pth"]
    assert [file.name for file in cache.iterdir()] == ["network.pth"]


def test_published_network_md5_hash_is_accepted(server, monkeypatch):
    offer(monkeypatch, f"{server.address}/network.pth", hashlib.md5(CONTENT).hexdigest()[:6], "md5")
    assert find_network(Path("offered")).read_bytes() == CONTENT


def test_published_network_with_wrong_hash_is_discarded(server, cache, monkeypatch):
    offer(monkeypatch, f"{server.address}/network.pth", "00000000")
    assert f"expected sha256 00000000, got {SHA256[:8]}" in fault()
    assert not list(cache.iterdir())


def test_published_network_truncated_download_is_restarted(server, cache, monkeypatch):
    offer(monkeypatch, f"{server.address}/cut.pth")
    fault()
    offer(monkeypatch, f"{server.address}/network.pth")
    assert find_network(Path("offered")).read_bytes() == CONTENT
    assert [file.name for file in cache.iterdir()] == ["network.pth"]


def test_published_network_truncated_download_is_discarded(server, cache, monkeypatch):
    offer(monkeypatch, f"{server.address}/cut.pth")
    message = fault()
    assert f"expected {len(CONTENT)} bytes, got {len(CONTENT) - 1000}" in message
    assert str(cache / "cut.pth") in message
    assert not list(cache.iterdir())


def test_published_network_download_error_names_url_and_path(server, cache, monkeypatch):
    offer(monkeypatch, f"{server.address}/absent.pth")
    message = fault()
    assert "Not Found" in message
    assert f"download {server.address}/absent.pth and put it at {cache / 'absent.pth'}" in message
    offer(monkeypatch, "http://127.0.0.1:9/network.pth")  # no server
    assert f"download http://127.0.0.1:9/network.pth and put it at {cache / 'network.pth'}" in fault()
    assert not list(cache.iterdir())


def test_published_network_offline_makes_no_requests(server, cache, monkeypatch):
    monkeypatch.setenv("INSTANCEMAP_OFFLINE", "1")
    offer(monkeypatch, f"{server.address}/network.pth")
    assert f"put it at {cache / 'network.pth'}" in fault()
    assert not server.asked
    cache.mkdir(parents=True)
    (cache / "network.pth").write_bytes(CONTENT)  # the error message contains this path
    assert find_network(Path("offered")).read_bytes() == CONTENT


def test_published_network_damaged_cache_file_raises(server, cache, monkeypatch):
    offer(monkeypatch, f"{server.address}/network.pth")
    path = find_network(Path("offered"))
    path.write_bytes(CONTENT[:-1])
    assert "expected sha256 13fbe33c" in fault()
    assert "delete it" in fault()


def test_published_network_unwritable_cache_raises(server, tmp_path, monkeypatch):
    (tmp_path / "cache").write_text("a file, where a folder should be")
    offer(monkeypatch, f"{server.address}/network.pth")
    assert "expected a writable folder" in fault()


def test_network_path_is_searched_in_working_then_project_dir(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.pth").write_bytes(b"")
    assert find_network(Path("own.pth")) == (tmp_path / "own.pth").resolve()
    assert find_network(Path("conf/config.yaml")) == PROJECT_ROOT / "conf" / "config.yaml"
    message = fault("no/such.pth")
    assert str(tmp_path / "no/such.pth") in message
    assert str(PROJECT_ROOT / "no/such.pth") in message
    assert "resnet50_fpn_coco" in message
