"""Tests for manifest.json."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.files import manifest
from framework.files.manifest import Manifest, RunStatus, verified

CHECKOUT = Path(__file__).resolve().parents[3]


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """Return a run directory with two files and a manifest."""
    (tmp_path / "config.yaml").write_text("seed: 0\n")
    (tmp_path / "metrics.json").write_text("{}\n")
    written = Manifest(RunStatus.COMPLETE, {}, {"detector.weights": "0f" * 32}, {"seed": "0"})
    written.with_files(tmp_path, ["config.yaml", "metrics.json", "map.npz"]).write(tmp_path)
    return tmp_path


def test_manifest_round_trip_keeps_contents(directory: Path) -> None:
    found = Manifest.read(directory)
    assert (found.status, dict(found.inputs)) == (RunStatus.COMPLETE, {"detector.weights": "0f" * 32})
    assert dict(found.parameters) == {"seed": "0"}
    assert {name: size for name, (size, _) in found.files.items()} == {"config.yaml": 8, "metrics.json": 3}
    assert found.changed_files(directory) == []


def test_manifest_changed_and_missing_files_are_named(directory: Path) -> None:
    (directory / "config.yaml").write_text("seed: 1\n")  # of the same size
    (directory / "metrics.json").unlink()
    first, second = Manifest.read(directory).changed_files(directory)
    assert first.startswith(f"{directory / 'config.yaml'}: expected the SHA-256 ")
    assert second == f"{directory / 'metrics.json'}: expected a file of 3 bytes, got none"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"status": "PARTIAL"}, "expected the digest"),
        ({"digest": "0" * 64}, "expected the digest"),
        ({"digest": None}, "expected the digest"),
    ],
)
def test_manifest_edited_raises(directory: Path, changes: dict[str, object], message: str) -> None:
    content = json.loads((directory / "manifest.json").read_text()) | changes
    (directory / "manifest.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match=message):
        Manifest.read(directory)


@pytest.mark.parametrize("name", ["../secret.txt", "/etc/hostname", "..", "", "a\\b", "a\0"])
def test_manifest_with_path_of_other_folder_raises(name: str, directory: Path) -> None:
    (directory.parent / "secret.txt").write_text("secret")
    Manifest(RunStatus.COMPLETE, {name: (6, "0" * 64)}, {}, {}).write(directory)
    with pytest.raises(DataError, match=r"manifest\.json: expected status, files, .*expected a file name, got "):
        Manifest.read(directory)


def test_manifest_of_huge_size_raises(directory: Path) -> None:
    path = directory / "manifest.json"
    path.write_bytes(path.read_bytes() + b" " * 2**24)
    with pytest.raises(DataError, match=r"manifest\.json: expected at most 16777216 bytes, got "):
        Manifest.read(directory)


def test_manifest_without_object_raises(directory: Path) -> None:
    (directory / "manifest.json").write_text("[]")
    with pytest.raises(DataError, match="expected a JSON object, got list"):
        Manifest.read(directory)


def read(path: Path) -> str:
    with verified(path):
        return path.read_text()


def test_verified_unchanged_file_is_read(directory: Path) -> None:
    assert read(directory / "config.yaml") == "seed: 0\n"


def test_verified_changed_file_raises(directory: Path) -> None:
    (directory / "config.yaml").write_text("seed: 1\n")
    with pytest.raises(DataError, match=r"config\.yaml: expected the SHA-256 .* --accept config\.yaml"):
        read(directory / "config.yaml")


def test_verified_unlisted_run_file_raises(directory: Path) -> None:
    (directory / "keyframes.npz").write_text("of another run")
    (directory / "before.ply").write_text("of the user")
    assert read(directory / "before.ply") == "of the user"
    with pytest.raises(DataError, match=r"keyframes\.npz: expected no file in this run"):
        read(directory / "keyframes.npz")


@pytest.mark.parametrize("content", ["{}", '{"name": "scene", "files": ["config.yaml"]}', "[]", "no JSON"])
def test_verified_manifest_of_other_program_is_ignored(content: str, directory: Path) -> None:
    (directory / "manifest.json").write_text(content)
    assert read(directory / "config.yaml") == "seed: 0\n"


@pytest.mark.parametrize("key", ["digest", "parameters", "files", "status"])
def test_verified_damaged_manifest_raises(key: str, directory: Path) -> None:
    path = directory / "manifest.json"
    path.write_text(path.read_text().replace(f'"{key}"', f'"{key.upper()}"'))
    with pytest.raises(DataError, match=r"manifest\.json: expected the digest"):
        read(directory / "config.yaml")


def test_verified_unfinished_folder_raises(directory: Path) -> None:
    (directory / ".unfinished").write_text("import-map\n")
    with pytest.raises(DataError, match="expected complete data, got an unfinished import-map; repeat"):
        read(directory / "config.yaml")


@pytest.mark.parametrize("size", [0, 5, 40])
@pytest.mark.parametrize("rest", [b"", bytes(64)])
def test_verified_truncated_manifest_raises(size: int, rest: bytes, directory: Path) -> None:
    path = directory / "manifest.json"
    path.write_bytes(path.read_bytes()[:size] + rest)
    with pytest.raises(DataError, match=r"manifest\.json: expected valid JSON"):
        read(directory / "config.yaml")


def test_verified_file_replaced_while_read_is_accepted(directory: Path) -> None:
    metrics = directory / "metrics.json"
    stored = Manifest.read(directory)
    with verified(metrics):
        metrics.write_text('{"fps": 1}\n')
        stored.with_files(directory, ["metrics.json"]).write(directory)


def test_verified_file_replaced_repeatedly_is_accepted(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both files are replaced after the manifest is read and before the file is read."""
    hashed, later = manifest.path_hash, [1, 2, 3]

    def replaced_hash(path: Path) -> str:
        if later:
            path.write_text(f"{later.pop()}\n")
            with monkeypatch.context() as unchanged:
                unchanged.setattr(manifest, "path_hash", hashed)
                Manifest.read(directory).with_files(directory, [path.name]).write(directory)
        return hashed(path)

    monkeypatch.setattr(manifest, "path_hash", replaced_hash)
    with verified(directory / "metrics.json"):
        pass
    assert not later


def test_verified_change_is_reported_instead_of_error_in_body(directory: Path) -> None:
    path = directory / "config.yaml"
    with pytest.raises(DataError, match=r"^expected a seed"), verified(path):
        raise DataError("expected a seed")
    path.write_text("seed: 1\n")
    with pytest.raises(DataError, match=r"config\.yaml: expected the SHA-256"), verified(path):
        raise DataError("expected a seed")


@pytest.mark.parametrize("name", ["config.yaml", "before.ply"])
def test_verified_value_is_true_for_files_in_manifest(name: str, directory: Path) -> None:
    (directory / "before.ply").write_text("of the user")
    with verified(directory / name) as is_hashed:
        assert is_hashed == (name == "config.yaml")


def test_verified_missing_file_is_left_to_reader(directory: Path) -> None:
    (directory / "metrics.json").unlink()
    with pytest.raises(FileNotFoundError):
        read(directory / "metrics.json")


WRITER = """
import sys
from pathlib import Path
from framework.files.folders.staged_files import staged_files
from framework.files.json_file import write_json
from framework.files.manifest import Manifest
directory = Path(sys.argv[1])
for k in range(100):
    with staged_files(directory) as folder:
        write_json(folder / "metrics.json", {"fps": k})
        Manifest.read(directory).with_files(folder, ["metrics.json"]).write(folder)
"""


@pytest.mark.integration
def test_verified_file_replaced_by_other_process_is_read(directory: Path) -> None:
    values = []
    with subprocess.Popen([sys.executable, "-c", WRITER, str(directory)], cwd=CHECKOUT) as writer:
        while writer.poll() is None:
            values.append(json.loads(read(directory / "metrics.json")).get("fps", -1))
    assert writer.returncode == 0
    assert values == sorted(values)
    assert Manifest.read(directory).changed_files(directory) == []
