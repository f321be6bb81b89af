"""Tests for PLY files. All encodings must give the same mesh, and errors must name the line or byte."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from framework.errors import DataError
from framework.files.ply import PlyMesh, read_ply, write_ply

VERTICES = np.array([[0, 0, 0], [1, 0, 0.1], [0, 1, 1e-7], [1, 1, -3e38], [2, 2, 2]], np.float32)
LABELS = np.array([7, -1, 934338, 0, 2147483647], np.int32)
POLYGONS = [[0, 1, 2], [4, 3, 2, 1, 0], [1, 2, 3, 4]]
FANS = [[0, 1, 2], [4, 3, 2], [4, 2, 1], [4, 1, 0], [1, 2, 3], [1, 3, 4]]
TRIANGLES = [[0, 1, 2], [2, 1, 4]]
ENCODINGS = ["ascii", "binary_little_endian", "binary_big_endian"]
TRIANGLE = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property uchar label
element face 1
property list uchar int vertex_indices
end_header
0 0 0 1
1 0 0 2
0 1 0 3
3 0 1 2
"""


def encoded(encoding: str, coordinate: str, count: str, index: str, polygons: list[list[int]]) -> bytes:
    """Return a PLY file with VERTICES, LABELS, `polygons` and some unused elements and properties."""
    codes = {"float": "f", "float64": "d", "uchar": "B", "int32": "i", "int": "i", "short": "h", "uint": "I"}
    order = ">" if encoding == "binary_big_endian" else "<"
    header = f"""ply
format {encoding} 1.0
comment end_header
obj_info made by a test
element camera 2
property list {count} float pose
property uchar id
element vertex {len(VERTICES)}
property {coordinate} x
property int label
property {coordinate} y
property {coordinate} z
property list {count} uchar seen_by
element face {len(polygons)}
property uchar flags
property list {count} {index} vertex_index
property list {count} float texcoord
element edge 1
property short a
property double b
end_header
"""
    seen_by = [[1, 2], [], [3], [4, 5, 6], []]
    x = codes[coordinate]
    rows: list[list[tuple[str, list[float]]]] = [
        [(codes[count], [2]), ("f", [0.5, 1]), ("B", [1])],
        [(codes[count], [0]), ("B", [2])],
        *(
            [(x, [v[0]]), ("i", [label]), (x, [v[1]]), (x, [v[2]]), (codes[count], [len(seen)]), ("B", seen)]
            for v, label, seen in zip(VERTICES.tolist(), LABELS.tolist(), seen_by, strict=True)
        ),
        *(
            [("B", [9]), (codes[count], [len(p)]), (codes[index], p), (codes[count], [2]), ("f", [0, 1])]
            for p in polygons
        ),
        [("h", [-5]), ("d", [1e300])],
    ]
    if encoding == "ascii":
        lines = [" ".join(f"{n!r}" for _, numbers in row for n in numbers) for row in rows]
        return (header + "\n".join(lines)).encode()
    packed = (struct.pack(f"{order}{len(numbers)}{code}", *numbers) for row in rows for code, numbers in row)
    return header.encode() + b"".join(packed)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("polygons", [POLYGONS, POLYGONS[::-1], TRIANGLES, []])
@pytest.mark.parametrize(("coordinate", "count", "index"), [("float", "uchar", "int"), ("float64", "int32", "uint")])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_ply_encodings_give_same_mesh(tmp_path, encoding, coordinate, count, index, polygons):
    mesh = read_ply(written(tmp_path / "a.ply", encoded(encoding, coordinate, count, index, polygons)))
    np.testing.assert_array_equal(mesh.vertices, VERTICES)
    fans = [[p[0], *p[k : k + 2]] for p in polygons for k in range(1, len(p) - 1)]
    np.testing.assert_array_equal(mesh.triangles, np.array(fans).reshape(-1, 3))
    assert (mesh.vertices.dtype, mesh.triangles.dtype) == (np.float32, np.int32)
    assert list(mesh.properties) == ["label"]
    np.testing.assert_array_equal(mesh.properties["label"], LABELS)
    assert mesh.properties["label"].dtype == np.int32


def test_ply_without_faces_is_read(tmp_path):
    content = TRIANGLE.replace(b"element face 1\nproperty list uchar int vertex_indices\n", b"").replace(
        b"3 0 1 2\n", b""
    )
    mesh = read_ply(written(tmp_path / "a.ply", content))
    assert (len(mesh.vertices), mesh.triangles.shape) == (3, (0, 3))


def test_ply_with_crlf_and_empty_lines_is_read(tmp_path):
    content = TRIANGLE.replace(b"1 0 0 2\n", b"\n  \n1\t0 0   2 \n").replace(b"\n", b"\r\n")
    mesh = read_ply(written(tmp_path / "a.ply", content))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    binary = encoded("binary_little_endian", "float", "uchar", "int", POLYGONS)
    end = binary.rindex(b"end_header\n") + len(b"end_header\n")
    mesh = read_ply(written(tmp_path / "b.ply", binary[:end].replace(b"\n", b"\r\n") + binary[end:]))
    assert mesh.triangles.tolist() == FANS


NUMBERS = st.sampled_from([np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.float32, np.float64])


@settings(max_examples=50, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), count=st.integers(0, 9), types=st.dictionaries(st.sampled_from(["a", "label", "nx"]), NUMBERS))
def test_ply_round_trip_is_exact(tmp_path, data, count, types):
    finite = st.floats(width=32, allow_nan=False, allow_infinity=False)
    vertices = data.draw(hnp.arrays(np.float32, (count, 3), elements=finite))
    faces = st.tuples(st.integers(0, 5 if count else 0), st.just(3))
    triangles = data.draw(hnp.arrays(np.int32, faces, elements=st.integers(0, max(count - 1, 0))))
    properties = {name: data.draw(hnp.arrays(dtype, count)) for name, dtype in types.items()}
    write_ply(tmp_path / "a.ply", vertices, triangles, properties, ["a comment", ""])
    mesh = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.vertices, vertices)
    np.testing.assert_array_equal(mesh.triangles, triangles)
    assert list(mesh.properties) == list(properties)
    for name, values in properties.items():
        assert mesh.properties[name].dtype == values.dtype
        assert mesh.properties[name].tobytes() == values.tobytes()  # NaN included


def test_ply_writer_matches_reference_bytes(tmp_path):
    write_ply(tmp_path / "a.ply", VERTICES[:3], np.array([[0, 1, 2]], np.int32), {"label": LABELS[:3]}, ["meters"])
    expected = (
        b"ply\nformat binary_little_endian 1.0\ncomment meters\nelement vertex 3\nproperty float x\nproperty float y\n"
    )
    expected += (
        b"property float z\nproperty int label\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    expected += b"".join(
        struct.pack("<fffi", *v, n) for v, n in zip(VERTICES[:3].tolist(), LABELS.tolist(), strict=False)
    )
    assert (tmp_path / "a.ply").read_bytes() == expected + struct.pack("<Biii", 3, 0, 1, 2)


def test_ply_written_file_is_read_by_open3d(tmp_path):
    import open3d as o3d

    write_ply(tmp_path / "a.ply", VERTICES, np.array(FANS, np.int32), {"label": LABELS})
    mesh = o3d.io.read_triangle_mesh(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(np.asarray(mesh.vertices).astype(np.float32), VERTICES)
    np.testing.assert_array_equal(np.asarray(mesh.triangles), FANS)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ply\n", b"plyx\n", r"line 1: expected a PLY file, got 'plyx\\nformat asci'"),
        (b"format ascii 1.0\n", b"", "line 9: expected a header line 'format'"),
        (b"ascii 1.0", b"ascii 2.0", "line 2: .*'format ascii 2.0'"),
        (b"vertex 3", b"vertex -3", "line 3: .*'vertex'.*'-3'"),
        (
            b"vertex 3",
            b"vertex 1000000000000",
            "byte [0-9]+: .*1000000000000 'vertex'.* truncated",
        ),
        (b"vertex 3", b"vertex " + b"9" * 5000, "line 3: .*'vertex'.*'9999.*[.][.][.]'"),
        (b"vertex 3", b"point 3", "line 10: expected an element 'vertex' in the header, got none"),
        (b"float x", b"half x", "line 4: expected a type in char, uchar, .*, got 'half'"),
        (b"float x", b"float", "line 4: .*'property TYPE NAME'.*'property float'"),
        (b"float y", b"float x", "line 5: .*'vertex'.*unique.*'x'"),
        (b"element face", b"element vertex", "line 8: .*unique.*'vertex'"),
        (b"list uchar int", b"list float int", "line 9: .*'vertex_indices'.*integer"),
        (b"uchar int vertex", b"uchar float vertex", "vertex_indices: .*integer type.*float32"),
        (b"vertex_indices", b"corners", "'face'.*vertex_indices or vertex_index"),
        (b"end_header", b"end", "line 14: .*'end_header'.* 200 bytes"),
        (b"end_header", b"comment " + b"x" * 2**24, "line 10: .*'end_header'.* 16777216 bytes"),
        (b"1 0 0 2", b"1 0 0", "line 12: 'vertex' 1: .*4 numbers.* 3"),
        (b"1 0 0 2", b"1 0 0 2 5", "line 12: 'vertex' 1: .*4 numbers.* 5"),
        (b"1 0 0 2", b"1 0 0 256", "line 12: label: .*uint8.* 256"),
        (b"1 0 0 2", b"1 0 0 2.5", "line 12: label: .*uint8.* 2.5"),
        (b"1 0 0 2", b"1 0 x 2", "line 12: expected numbers, got '1 0 x 2'"),
        (b"1 0 0 2", b"1 nan 0 2", "line 12: vertex 1: expected finite coordinates, got 1 nan 0"),
        (b"1 0 0 2", b"\n1 1e39 0 2", "line 13: vertex 1: expected finite coordinates, got 1 inf 0"),
        (b"1 0 0 2", b"1" * 2**20 + b"0 0 0 2", "line 12: .*1048576 bytes"),
        (b"3 0 1 2", b"3 0 1 3", r"line 14: face 0: expected vertex indices in \[0, 3\), got 3"),
        (b"3 0 1 2", b"3 0 -1 2", r"line 14: face 0: expected vertex indices in \[0, 3\), got -1"),
        (b"3 0 1 2", b"2 0 1", "line 14: face 0: .*3 vertices.* 2"),
        (b"3 0 1 2", b"4 0 1 2", "line 14: 'face' 0: .*5 numbers.* 4"),
        (b"3 0 1 2\n", b"\n\n", "line 15: expected 1 rows .* end of the file in 'face' 0"),
        (b"face 1", b"face 2", "line 14: expected 2 rows .* end of the file in 'face' 1"),
        (
            b"3 0 1 2",
            b"3 0 1 2\n\n3 0 1 2",
            "line 16: expected the end of the file after the last row, got 4 more numbers",
        ),
        (
            b"element vertex",
            b"element v\x9a\x00 1\nproperty int a\nelement vertex",
            r"line 13: 'v.x9a.x00' 0: .*1 numbers",
        ),
    ],
)
def test_ply_invalid_ascii_error_reports_location(tmp_path, old, new, message):
    path = written(tmp_path / "a.ply", TRIANGLE.replace(old, new, 1))
    with pytest.raises(DataError, match=f"a.ply(, |: the header's |: ).*({message})") as caught:
        read_ply(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 400


def binary(vertices: bytes, faces: bytes) -> bytes:
    header = TRIANGLE[: TRIANGLE.index(b"0 0 0 1\n")].replace(b"ascii", b"binary_big_endian")
    return header.replace(b"list uchar", b"list short").replace(b"face 1", b"face 2") + vertices + faces


def face(*corners: int, length: int | None = None) -> bytes:
    return struct.pack(f">h{len(corners)}i", len(corners) if length is None else length, *corners)


THREE = b"".join(struct.pack(">fffB", *v, 1) for v in VERTICES[:3].tolist())
GOOD = face(0, 1, 2)
START = len(binary(b"", b""))
FACES = START + len(THREE)
SECOND = FACES + len(GOOD)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (THREE, GOOD + GOOD[:-1], f"byte {SECOND + 13}: expected 2 rows .* end of the file in 'face' 1"),
        (THREE, GOOD[:5], f"byte {FACES + 5}: expected 2 rows .* end of the file in 'face' 0"),
        (THREE[:30], b"", f"byte {START}: .*43 bytes.*3 'vertex', 2 'face'.* 30"),
        (
            THREE,
            GOOD * 2 + b"\x05",
            f"byte {SECOND + 14}: expected the end of the file after the last row, got 1 more bytes",
        ),
        (THREE, GOOD + face(0, 1, 3), rf"byte {SECOND}: face 1: expected vertex indices in \[0, 3\), got 3"),
        (THREE, GOOD + face(0, 1), f"byte {SECOND}: face 1: .*3 vertices.* 2"),
        (THREE, face() + GOOD, f"byte {FACES}: face 0: .*3 vertices.* 0"),
        (THREE, GOOD + face(0, 1, 2, 9), f"byte {SECOND}: face 1: expected vertex indices .*, got 9"),
        (THREE, face(0, 1, 2, length=-1) + GOOD, f"byte {FACES}: 'face' 0: expected a list length >= 0, got -1"),
        (
            THREE,
            face(0, 1, 2, length=32767) + GOOD,
            f"byte {FACES + 28}: expected 2 rows .* end of the file in 'face' 0",
        ),
        (
            THREE[:26] + b"\x7f\xc0\0\0" + THREE[30:],
            GOOD * 2,
            f"byte {START + 26}: vertex 2: expected finite coordinates, got nan 1 1e-07",
        ),
    ],
)
def test_ply_invalid_binary_error_gives_byte_offset(tmp_path, vertices, faces, message):
    with pytest.raises(DataError, match=f"a.ply, {message}"):
        read_ply(written(tmp_path / "a.ply", binary(vertices, faces)))


def test_ply_line_end_after_last_row_is_accepted(tmp_path):
    assert len(read_ply(written(tmp_path / "a.ply", binary(THREE, GOOD * 2 + b"\r\n"))).triangles) == 2


def test_ply_missing_file_raises(tmp_path):
    with pytest.raises(DataError, match=r"a.ply: expected a readable file, got an error \(No such file"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"vertices": VERTICES.astype(np.float64)},
            r"vertices: expected .*\(N, 3\) and type float32, got \(5, 3\) and float64",
        ),
        ({"vertices": VERTICES * np.float32(np.nan)}, "vertices: expected finite coordinates"),
        ({"triangles": np.array([[0, 1, 5]], np.int32)}, r"triangles: expected vertex indices in \[0, 5\), got 0 to 5"),
        ({"triangles": np.array([[0, 1, -1]], np.int32)}, "got -1 to 1"),
        ({"properties": {"x": LABELS}}, "expected a property name .*, got 'x'"),
        ({"properties": {"a b": LABELS}}, "expected a property name .*, got 'a b'"),
        ({"properties": {"label": LABELS[:4]}}, r"label: expected shape \(5,\) and a PLY type, got \(4,\) and int32"),
        ({"properties": {"label": LABELS.astype(np.int64)}}, r"got \(5,\) and int64"),
        ({"comments": ["a\nend_header"]}, "comment"),
    ],
)
def test_ply_writing_invalid_mesh_leaves_no_file(tmp_path, change, message):
    mesh = {"vertices": VERTICES, "triangles": np.array(FANS, np.int32), "properties": {}} | change
    with pytest.raises(DataError, match=f"a.ply: .*{message}"):
        write_ply(tmp_path / "a.ply", **mesh)
    assert list(tmp_path.iterdir()) == []


def test_ply_arrays_do_not_reference_file_buffer(tmp_path):
    """A reference would keep the whole file in memory."""
    write_ply(tmp_path / "a.ply", VERTICES, np.array(FANS, np.int32), {"label": LABELS})
    mesh = read_ply(tmp_path / "a.ply")
    assert isinstance(mesh, PlyMesh)
    for array in (mesh.vertices, mesh.properties["label"]):
        assert array.flags.owndata
        assert array.flags.writeable


def test_face_properties_belong_to_all_triangles_of_a_face(tmp_path: Path) -> None:
    header = TRIANGLE[: TRIANGLE.index(b"end_header")].replace(b"vertex 3", b"vertex 4").replace(b"face 1", b"face 2")
    rows = b"0 0 0 1\n1 0 0 2\n0 1 0 3\n1 1 0 4\n4 0 1 3 2 7\n3 0 1 2 9\n"
    (tmp_path / "mesh.ply").write_bytes(header + b"property int object_id\nend_header\n" + rows)
    mesh = read_ply(tmp_path / "mesh.ply")
    assert mesh.triangles.tolist() == [[0, 1, 3], [0, 3, 2], [0, 1, 2]]
    assert mesh.triangle_properties["object_id"].tolist() == [7, 7, 9]
    assert mesh.properties.keys() == {"label"}


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit of the file size")
def test_write_ply_cut_file_raises(tmp_path: Path) -> None:
    """The limit of the file size cuts the last bytes, as a full disk does."""
    import resource

    vertices, triangles = np.zeros((500, 3), np.float32), np.zeros((100, 3), np.int32)
    write_ply(tmp_path / "whole.ply", vertices, triangles, {})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "whole.ply").stat().st_size - 10, limits[1]))
    try:
        with pytest.raises(DataError, match=r"cut\.ply: expected a writable file, got an error"):
            write_ply(tmp_path / "cut.ply", vertices, triangles, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.ply"]
