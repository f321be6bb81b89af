"""Tests for models that are selected by hub id, with a local server."""

import hashlib
import json
import shutil
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from framework.detection.hub.hub_model import TOKENIZER, find_model
from framework.errors import DataError

constants = pytest.importorskip("huggingface_hub.constants")

COMMIT = "0123456789abcdef0123456789abcdef01234567"
WEIGHTS = bytes(range(256)) * 5000
FILES = {
    "config.json": b"{}",
    "preprocessor_config.json": b"{ }",
    "model.safetensors": WEIGHTS,
    "README.md": b"read me",
}


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Serve the model somebody/something like huggingface.co, and record the requests."""

    class Handler(BaseHTTPRequestHandler):
        def do_HEAD(self):
            self.answer(send=False)

        def do_GET(self):
            self.answer(send=True)

        def answer(self, send):
            path = self.path.partition("?")[0]
            name = path.removeprefix("/somebody/something/resolve/main/")
            if path == "/api/models/somebody/something/revision/main":
                self.reply(json.dumps(listing(http.files)).encode(), send)
            elif name in http.files:
                http.sent += [name] * send
                served = http.served.get(name, http.files[name])
                self.reply(served, send, ETag=digest(http.files[name]), **{"X-Repo-Commit": COMMIT})
            else:
                self.send_error(404)

        def reply(self, content, send, **headers):
            self.send_response(200)
            for key, value in {"Content-Length": str(len(content)), **headers}.items():
                self.send_header(key, value)
            self.end_headers()
            if send:
                self.wfile.write(content)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        http.files, http.served, http.sent = dict(FILES), {}, []
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        http.address = f"http://127.0.0.1:{http.server_port}"
        monkeypatch.setattr(constants, "ENDPOINT", http.address)
        template = http.address + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        for name in ("INSTANCEMAP_OFFLINE", "HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        yield http
        http.shutdown()
        thread.join()


def digest(content):
    return hashlib.sha256(content).hexdigest()


def listing(files):
    """Return the description of a model with these files. Only large files have a SHA-256."""
    siblings = []
    for name, content in files.items():
        large = (
            {"lfs": {"sha256": digest(content), "size": len(content), "pointerSize": 130}}
            if len(content) > 1000
            else {}
        )
        siblings.append({"rfilename": name, "size": len(content), "blobId": "0" * 40, **large})
    return {"id": "somebody/something", "sha": COMMIT, "tags": ["license:apache-2.0"], "siblings": siblings}


def fault(model="somebody/something"):
    with pytest.raises(DataError) as caught:
        find_model(model, "main")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_hub_model_is_downloaded_once_and_logged(hub, caplog):
    with caplog.at_level("INFO", "framework"):
        folder = find_model("somebody/something", "main")
    assert f"downloading somebody/something, 1 MB, license apache-2.0, from {hub.address} into" in caplog.text
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS
    assert folder.name == COMMIT
    wanted = ["config.json", "preprocessor_config.json", "model.safetensors"]
    assert hub.sent == wanted
    hub.server_close()  # later calls use only the downloaded files
    assert find_model("somebody/something", "main") == folder
    assert hub.sent == wanted


def test_hub_model_sharded_weights_download_missing_shard(hub):
    hub.files["model-00001-of-00002.safetensors"] = hub.files.pop("model.safetensors")
    hub.files["model-00002-of-00002.safetensors"] = b"more"
    names = {"a": "model-00001-of-00002.safetensors", "b": "model-00002-of-00002.safetensors"}
    hub.files["model.safetensors.index.json"] = json.dumps({"weight_map": names}).encode()
    folder = find_model("somebody/something", "main")
    assert {file.name for file in folder.iterdir()} == {*hub.files} - {"README.md"}
    (folder / "model-00002-of-00002.safetensors").resolve().unlink()  # like after an interrupted download
    hub.sent.clear()
    assert find_model("somebody/something", "main") == folder
    assert hub.sent == ["model-00002-of-00002.safetensors"]
    (folder / "model.safetensors.index.json").write_text("[]")
    assert "detector.model: expected an index of weight files, got a damaged" in fault()


def test_hub_tokenizer_in_one_or_two_files_is_found(hub):
    with pytest.raises(DataError, match=r"expected tokenizer\.json and tokenizer_config\.json in"):
        find_model("somebody/something", "main", TOKENIZER)
    hub.files |= dict.fromkeys(("vocab.json", "merges.txt", "tokenizer_config.json"), b"{}")
    folder = find_model("somebody/something", "main", TOKENIZER)
    assert {file.name for file in folder.iterdir()} == {*hub.files} - {"README.md"}
    hub.sent.clear()
    assert find_model("somebody/something", "main", TOKENIZER) == folder
    assert not hub.sent
    shutil.rmtree(folder.parents[1])
    hub.files["tokenizer.json"] = b"{}"
    names = {file.name for file in find_model("somebody/something", "main", TOKENIZER).iterdir()}
    assert names == {*hub.files} - {"README.md", "vocab.json", "merges.txt"}


def test_hub_model_with_wrong_hash_is_discarded(hub):
    hub.served["model.safetensors"] = bytes(len(WEIGHTS))
    assert "for model.safetensors, got " in fault()
    hub.served.clear()
    assert (find_model("somebody/something", "main") / "model.safetensors").read_bytes() == WEIGHTS


@pytest.mark.parametrize("value", ["1", "true"])
def test_hub_model_offline_makes_no_requests(hub, monkeypatch, value):
    monkeypatch.setenv("HF_HUB_OFFLINE", value)
    assert "unset HF_HUB_OFFLINE or set a folder" in fault()
    assert not hub.sent
    monkeypatch.setenv("HF_HUB_OFFLINE", "0")
    folder = find_model("somebody/something", "main")
    monkeypatch.setenv("HF_HUB_OFFLINE", value)
    assert find_model("somebody/something", "main") == folder


def test_hub_model_errors_are_one_line(hub):
    assert "check the name and the network" in fault("somebody/else")
    assert "detector.model: expected a folder or a model id, got" in fault("no//such")
    del hub.files["preprocessor_config.json"]
    assert "expected preprocessor_config.json in" in fault()
    del hub.files["model.safetensors"]
    assert "expected preprocessor_config.json and model.safetensors in" in fault()


def test_hub_model_local_folder_is_returned_unchanged(tmp_path):
    assert find_model(str(tmp_path), "main") == tmp_path
