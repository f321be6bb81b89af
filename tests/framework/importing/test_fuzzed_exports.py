"""Fuzz tests for exports. A damaged file must be skipped or raise a one-line error."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.datasets.rgbd_folder import RgbdFolder
from framework.errors import DataError
from framework.importing.folder_writer import Writing, write_folder
from framework.importing.formats import open_source
from tests.support.recordings.arkit_scenes_files import write_arkit_scenes
from tests.support.recordings.colmap_files import write_colmap
from tests.support.recordings.damaged_files import EXAMPLES, damaged
from tests.support.recordings.phone_exports import (
    room_frames,
    write_polycam,
    write_r3d,
    write_record3d_exr,
    write_scanner_app,
    write_stray_scanner,
)
from tests.support.recordings.rtabmap_files import write_rtabmap
from tests.support.recordings.scannetpp_files import write_scannetpp, zlib_blocks
from tests.support.recordings.transforms_files import write_nerfcapture

pytestmark = pytest.mark.integration

FRAMES = room_frames(2)
TOKENS = (b", nan", b"null", b"\0", b"1e999", b"[", b"}", b"-1")
WRITERS: dict[str, tuple[str, Callable[..., None]]] = {
    "stray": ("", write_stray_scanner),
    "exr": ("OpenEXR", write_record3d_exr),
    "room.r3d": ("lzfse", write_r3d),
    "app": ("", write_scanner_app),
    "polycam": ("", write_polycam),
    "arkit_scenes": ("", write_arkit_scenes),
    "transforms": ("", write_nerfcapture),
    "colmap": ("", partial(write_colmap, unit=2.0)),
    "colmap_text": ("", partial(write_colmap, unit=2.0, binary=False)),
    "room.db": ("", write_rtabmap),
    "scannetpp": ("", write_scannetpp),
    "scannetpp_binary": ("lz4", partial(write_scannetpp, step=1, write_depth=zlib_blocks)),
}


@pytest.fixture(scope="module", params=WRITERS)
def export(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    package, write = WRITERS[request.param]
    if package:
        pytest.importorskip(package)
    path = tmp_path_factory.mktemp("exports") / request.param
    write(path, FRAMES)
    return path


@settings(max_examples=EXAMPLES, deadline=None)
@given(data=st.data())
def test_import_fuzzed_export_is_read_or_raises_one_line_error(export: Path, data: st.DataObject) -> None:
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / export.name
        if export.is_dir():
            shutil.copytree(export, copy)
        else:
            shutil.copy(export, copy)
        files = sorted(path for path in [copy, *copy.rglob("*")] if path.is_file())
        path = data.draw(st.sampled_from(files))
        path.write_bytes(data.draw(damaged(path.read_bytes(), TOKENS)))
        out = Path(place) / "out"
        try:
            written = write_folder(open_source(copy), out, Writing(width=80))
        except DataError as error:
            lines = [str(error)]
            assert not (out / "camera.json").exists()
        else:
            lines = written.errors
            assert len(RgbdFolder(out)) == len(written.timestamps) > 0
        assert all(line.isprintable() and len(line) < 600 for line in lines), lines
