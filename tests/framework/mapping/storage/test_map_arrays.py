"""Tests for map files with invalid arrays. The error must be raised before a kernel reads the arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from framework.errors import DataError
from framework.interfaces import MapFuser, SceneMap
from tests.support import registered
from tests.support.scenes.analytic_scene import room, walk
from tests.support.true_masks import fuse_masks, masks_of

FAR = 100_000_000


@pytest.fixture(scope="module", params=registered.names("fuser"))
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[type[SceneMap], Path]:
    """Return the type of a map and the path of its file."""
    fuser: MapFuser = registered.built("fuser", request.param, "fuser.voxel_size=0.04")
    for k, T in enumerate(walk(2)):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3)
    path = tmp_path_factory.mktemp(request.param) / "map.npz"
    fuser.scene.save(path)
    return type(fuser.scene), path


def content(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return dict(file)


def refused(kind: type[SceneMap], path: Path, changes: dict[str, np.ndarray]) -> str:
    """Return the error that is raised if some arrays of the file are replaced."""
    np.savez(path.with_name("changed.npz"), **(content(path) | changes))
    with pytest.raises(DataError) as caught:
        kind.load(path.with_name("changed.npz"))
    message = str(caught.value)
    assert "\n" not in message
    assert "changed.npz" in message
    return message


def test_map_arrays_of_wrong_type_or_shape_raise(saved: tuple[type[SceneMap], Path]) -> None:
    kind, path = saved
    for name, array in content(path).items():
        if name != "header":
            other = np.float64 if array.dtype != np.float64 else np.float32
            assert name in refused(kind, path, {name: array.astype(other)})
            assert name in refused(kind, path, {name: array[..., None]})
            assert array.ndim == 1 or name in refused(kind, path, {name: array[..., :-1]})
            refused(kind, path, {name: array[:-1]})  # another array of the same length may be named


def test_map_arrays_with_invalid_ids_raise(
    saved: tuple[type[SceneMap], Path],
) -> None:
    kind, path = saved
    arrays = content(path)
    for name, wrong in [
        ("label_row", FAR),
        ("label_row", -2),
        ("instance_ids", FAR),
        ("instance_ids", -1),
        ("instance", FAR),
        ("class_ids", 200),
        ("class_evidence", 1e13),
        ("states", 511),
        ("instance_slots", 1000),
        ("class_slots", 0),
        ("block_coords", FAR),
    ]:
        if name in arrays:
            changed = arrays[name].copy()
            changed.flat[len(changed) // 2] = wrong
            assert name in refused(kind, path, {name: changed})
    twice = arrays["block_coords"].copy()
    twice[1] = twice[0]
    assert "block_coords" in refused(kind, path, {"block_coords": twice})


def test_map_header_with_invalid_values_raises(saved: tuple[type[SceneMap], Path]) -> None:
    kind, path = saved
    header: dict[str, Any] = json.loads(content(path)["header"].tobytes())
    others: dict[str, Any] = {"sensor": [1], "settings": [1], "voxel_size": 0, "classes": 3}
    if "table" in header:
        others["table"] = header["table"] | {"instances": []}
    for key in header.keys() & others.keys():
        changed = json.dumps(header | {key: others[key]}).encode()
        refused(kind, path, {"header": np.frombuffer(changed, np.uint8)})


def test_map_header_with_missing_key_raises(saved: tuple[type[SceneMap], Path]) -> None:
    kind, path = saved
    header: dict[str, Any] = json.loads(content(path)["header"].tobytes())
    for key in header.keys() - {"format"}:
        less = json.dumps({name: value for name, value in header.items() if name != key})
        assert key in refused(kind, path, {"header": np.frombuffer(less.encode(), np.uint8)})
