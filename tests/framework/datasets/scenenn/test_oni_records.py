"""Tests for the records of .oni files, including truncated files."""

import os
import struct
from dataclasses import replace

import numpy as np
import pytest

from framework.datasets.scenenn.oni_records import Stream, playable, read_contents
from framework.errors import DataError
from tests.support.recordings.oni_file import COLOR, DEPTH, OPENNI_1_END_NODE, Node, OniFile

TIMES = [33_000, 66_000, 99_000]


def recording(wide=True):
    depths = [np.full((2, 4), k, np.uint16) for k in range(3)]
    colors = [np.full((2, 4, 3), k, np.uint8) for k in range(3)]
    return OniFile([Node(DEPTH, depths, TIMES), Node(COLOR, colors[:2], TIMES[:2])], wide)


@pytest.mark.parametrize("wide", [True, False])
def test_oni_records_count_images_of_both_streams(tmp_path, wide):
    path = recording(wide).write(tmp_path / "a.oni")
    contents = read_contents(path)
    counted = {stream: (images.node, images.count, images.last) for stream, images in contents.streams.items()}
    assert counted == {Stream.DEPTH: (1, 3, 3), Stream.COLOR: (2, 2, 2)}
    assert not contents.cut_off
    assert contents.end == path.stat().st_size
    with playable(contents, tmp_path) as played:
        assert played == path


def test_oni_records_ignore_data_after_end(tmp_path):
    path = recording().write(tmp_path / "a.oni")
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(b"rest of an older file")
    contents = read_contents(path)
    assert not contents.cut_off
    assert contents.end == size


def test_oni_records_openni_1_end_is_valid(tmp_path):
    path = replace(recording(), end_node=OPENNI_1_END_NODE).write(tmp_path / "a.oni")
    contents = read_contents(path)
    assert (contents.cut_off, contents.end, contents.largest_node) == (False, path.stat().st_size, 2)


def test_oni_records_end_node_id_in_image_record_truncates(tmp_path):
    content = bytearray(recording().write(tmp_path / "a.oni").read_bytes())
    second = recording()
    second.write(tmp_path / "b.oni")
    at = second.nodes[0].positions[1]
    content[at + 8 : at + 12] = struct.pack("<I", OPENNI_1_END_NODE)
    (tmp_path / "a.oni").write_bytes(content)
    contents = read_contents(tmp_path / "a.oni")
    assert (contents.cut_off, contents.end) == (True, at)


@pytest.mark.parametrize("end_node", [0, OPENNI_1_END_NODE])
@pytest.mark.parametrize("wide", [True, False])
def test_oni_records_truncated_file_is_repaired(tmp_path, wide, end_node):
    content = replace(recording(wide), end_node=end_node).write(tmp_path / "a.oni").read_bytes()
    path, scratch = tmp_path / "cut.oni", tmp_path / "scratch"
    scratch.mkdir()
    counts = set()
    for size in range(0, len(content), 11):
        path.write_bytes(content[:size])
        try:
            contents = read_contents(path)
        except DataError as error:
            assert "\n" not in str(error)
            continue
        assert contents.cut_off
        counts.add(sum(images.count for images in contents.streams.values()))
        with playable(contents, scratch) as played:
            fixed = read_contents(played)
            assert not fixed.cut_off
            assert fixed.streams == contents.streams
            positions = [struct.unpack_from("<Q", played.read_bytes(), at)[0] for at in fixed.table_notes]
            assert positions == [0, 0] if wide else positions == []
        assert not any(scratch.iterdir())
    assert counts == {2, 3, 4, 5}
    assert path.read_bytes() == content[:size]  # the recording itself is unchanged


def test_oni_records_missing_largest_node_is_repaired(tmp_path):
    content = bytearray(recording().write(tmp_path / "a.oni").read_bytes()[:-28])
    content[20:24] = bytes(4)
    (tmp_path / "a.oni").write_bytes(content)
    with playable(read_contents(tmp_path / "a.oni"), tmp_path) as played:
        assert struct.unpack_from("<I", played.read_bytes(), 20) == (2,)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (b"", ": expected an OpenNI recording beginning with b'NI10', got b''"),
        (b"NI10" + bytes(8), ": expected an OpenNI recording"),
        (b"RIFF" + bytes(40), ": expected an OpenNI recording beginning with b'NI10', got b'RIFF'"),
        (
            struct.pack("<4sBBHIQI", b"NI10", 1, 0, 2, 0, 0, 2),
            "expected format version 1.0.0.4 to 1.0.1.0, got 1.0.2.0",
        ),
        (
            struct.pack("<4sBBHIQI", b"NI10", 1, 0, 1, 0, 0, 2**32 - 1),
            "header: expected at most 255 nodes, got 4294967295",
        ),
        (
            struct.pack("<4sBBHIQI", b"NI10", 1, 0, 1, 0, 0, 2),
            "expected depth and color images, got no depth and no color before the truncation or damage at byte 24",
        ),
        (None, "expected a readable file, got an error (No such file"),
    ],
)
def test_oni_records_invalid_file_raises_one_line_error(tmp_path, content, fault):
    path = tmp_path / "a.oni"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_contents(path)
    assert str(path) in str(caught.value)
    assert fault in str(caught.value)


def test_oni_records_named_pipe_raises_without_blocking(tmp_path):
    os.mkfifo(tmp_path / "a.oni")
    with pytest.raises(DataError, match=r"a\.oni: expected a regular file, got a device, a pipe"):
        read_contents(tmp_path / "a.oni")


@pytest.mark.parametrize(("kept", "missing"), [(0, "color"), (1, "depth")])
def test_oni_records_without_color_or_depth_raise(tmp_path, kept, missing):
    path = OniFile([recording().nodes[kept]]).write(tmp_path / "a.oni")
    with pytest.raises(DataError, match=f"expected depth and color images, got no {missing}$"):
        read_contents(path)
