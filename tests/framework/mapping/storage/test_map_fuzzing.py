"""Fuzz tests for map files with valid checksums. A file must be usable or raise a one-line error."""

from __future__ import annotations

import io
import json
import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from framework.api import load_scene
from framework.data import Camera
from framework.errors import DataError
from framework.interfaces import MapFuser, SceneMap
from tests.support import registered
from tests.support.recordings.damaged_files import EXAMPLES, LARGE, changed_json
from tests.support.scenes.analytic_scene import room, walk
from tests.support.true_masks import fuse_masks, masks_of

pytestmark = pytest.mark.integration

SLOWEST = 5.0  # s, maximum CPU time; wall time would depend on other processes
CAMERA = Camera(24, 18, 20.0, 20.0, 11.5, 8.5)
KINDS = ("bayesian_tsdf", "words", "exact", "last_write", "object_volumes", "open3d_vbg", "class_only_fusion")


@dataclass(frozen=True)
class Saved:
    """Content of a map file."""

    path: Path  # path for changed copies
    arrays: dict[str, np.ndarray] = field(repr=False)


@pytest.fixture(scope="module", params=KINDS)
def saved(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Saved:
    """Return the map file of a fuser. There is one fuser for each kind of map."""
    name = request.param
    variants = {"exact": ["bayesian_tsdf", "fuser.storage=EXACT"], "words": ["bayesian_tsdf"]}
    chosen = variants.get(name, [name])
    fuser: MapFuser = registered.built("fuser", chosen[0], "fuser.voxel_size=0.08", *chosen[1:])
    for k, T in enumerate(walk(4)):
        frame = room().frame(T, k)
        fuse_masks(fuser, frame, masks_of(frame), [0.9] * 3, embeddings=np.eye(3, 5) if name == "words" else None)
    path = tmp_path_factory.mktemp(name) / "map.npz"
    fuser.scene.save(path)
    use(load_scene(path))  # compiles the needed kernels
    with np.load(path) as file:
        return Saved(path.with_name("changed.npz"), dict(file))


def use(scene: SceneMap) -> None:
    """Call all functions of a map."""
    instances = scene.instances()
    scene.mesh()
    for T in walk(4)[:2]:
        scene.render(CAMERA, T)
        scene.render_near(CAMERA, T, np.ones(CAMERA.shape, np.float32))
    assert scene.statistics.voxels >= 0
    assert scene.statistics.bytes >= 0
    assert scene.instance_ids() >= set()
    for instance in instances.values():
        assert instance.class_probabilities.shape == (len(scene.classes),)
        assert instance.class_probabilities.sum() == pytest.approx(1, abs=1e-3)
        assert 0 <= instance.confidence < 1.001
        if instance.embedding is not None:
            assert np.linalg.norm(instance.embedding) < 1.001
            assert 0 <= instance.embedding_spread <= 1


def load_and_use(path: Path, content: bytes) -> str:
    """Load and use a map file. Return the error line, or "" without an error."""
    path.write_bytes(content)
    began = time.process_time()
    try:
        scene = load_scene(path)
    except DataError as error:
        line = str(error)
    else:
        line = ""
        use(scene)
    assert time.process_time() - began < SLOWEST
    assert line.isprintable()
    assert len(line) < 1000
    assert not line or line.startswith(str(path))
    return line


def archive(arrays: dict[str, np.ndarray]) -> bytes:
    """Return the content of a map file with valid checksums."""
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def changed_array(draw: st.DrawFn, array: np.ndarray) -> np.ndarray:
    """Return the array with a random change of values, length, shape or type."""
    array = np.atleast_1d(array)
    match draw(st.sampled_from(("number", "number", "number", "all", "cut", "repeat", "type", "shape", "roll"))):
        case "number" if array.size:
            array = array.copy()
            for _ in range(draw(st.integers(1, 3))):
                array.flat[draw(st.integers(0, array.size - 1))] = odd_number(draw, array.dtype)
        case "all":
            array = np.full_like(array, odd_number(draw, array.dtype))
        case "cut":
            array = array[: draw(st.integers(0, len(array)))]
        case "repeat":
            array = np.concatenate([array, array[: draw(st.integers(0, 3))]])
        case "type":
            array = array.astype(draw(st.sampled_from(("u1", "i2", "i4", "i8", "f4", "f8", ">f4", "?", "c16", "S3"))))
        case "shape":
            array = draw(st.sampled_from((array[..., None], array[..., :1], array[None], array.ravel(), array.sum())))
        case "roll":
            array = np.roll(array, draw(st.integers(1, 1000)))
    return np.asarray(array)


def odd_number(draw: st.DrawFn, dtype: np.dtype[Any]) -> Any:
    if dtype.kind == "f":
        return draw(st.sampled_from((0.0, -1.0, 1e38, -1e38, 1e-40, np.nan, np.inf, -np.inf)))
    if dtype.kind not in "iu":  # the type was replaced by a previous change
        return np.ones(1, dtype)[0]
    low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    return draw(st.sampled_from([n for n in (*LARGE, low, high, low + 1) if low <= n <= high]))


@settings(
    max_examples=EXAMPLES // 3, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)
@given(data=st.data())
def test_map_fuzz_changed_content_loads_or_raises(saved: Saved, data: st.DataObject) -> None:
    arrays = dict(saved.arrays)
    for _ in range(data.draw(st.integers(1, 2))):
        if data.draw(st.booleans()):
            header = data.draw(changed_json(json.loads(saved.arrays["header"].tobytes())))
            arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        else:
            name = data.draw(st.sampled_from(sorted(arrays)))
            arrays[name] = changed_array(data.draw, arrays[name])
    load_and_use(saved.path, archive(arrays))


@settings(
    max_examples=EXAMPLES // 3, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
)
@given(data=st.data())
def test_map_fuzz_damaged_bytes_load_or_raise(saved: Saved, data: st.DataObject) -> None:
    """The changed bytes are in or after the headers of the archive and of its arrays."""
    content = bytearray(archive(saved.arrays))
    headers = [match.start() for match in re.finditer(rb"PK|\x93NUMPY", content)]
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.sampled_from(headers)) + data.draw(st.integers(0, 130))
        content[min(at, len(content) - 1)] = data.draw(st.integers(0, 255))
    load_and_use(saved.path, bytes(content))


def test_map_fuzz_unchanged_file_loads(saved: Saved) -> None:
    assert load_and_use(saved.path, archive(saved.arrays)) == ""
