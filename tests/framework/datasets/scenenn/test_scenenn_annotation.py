"""Tests for the annotation file NNN.xml, including missing, invalid and malicious content."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from framework.data import Box
from framework.datasets.scenenn import scenenn_annotation
from framework.datasets.scenenn.scenenn_annotation import NO_COLOR, Annotated, read_annotation, write_annotation
from framework.errors import DataError

TURN = Rotation.from_euler("xyz", (0.1, 0.5, -2)).as_matrix()
BOX = Box(np.array([0.5, 0.25, -1.5]), np.array([1.0, 0.5, 2.0]), np.eye(3))
GOLDEN = """<?xml version="1.0" encoding="utf-8"?>
<annotation>
  <label id="934338" color="255 0 7" text="chair" nyu_class="chair" aabbox="0.0 0.0 -2.5 1.0 0.5 -0.5" obbox="0.5 0.25 \
-1.5 1.0 0.5 2.0 0.0 0.0 0.0 1.0"/>
  <label id="0" color="0 0 0" text="" nyu_class=""/>
</annotation>
"""
OBJECTS = (
    Annotated(934338, "chair", "chair", (255, 0, 7), np.array([[0, 0, -2.5], [1, 0.5, -0.5]]), BOX),
    Annotated(0, "", ""),
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "011.xml"


def read_label(path, attributes):
    path.write_text(f"<annotation><label {attributes}/></annotation>")
    (label,) = read_annotation(path)
    return label


def assert_same(a, b):
    assert (a.id, a.text, a.nyu_class, a.color) == (b.id, b.text, b.nyu_class, b.color)
    np.testing.assert_array_equal(a.aabb, b.aabb)
    assert (a.obb is None) == (b.obb is None)
    if a.obb is not None:
        np.testing.assert_array_equal(a.obb.center, b.obb.center)
        np.testing.assert_array_equal(a.obb.extent, b.obb.extent)
        np.testing.assert_allclose(a.obb.rotation, b.obb.rotation, atol=1e-15)


def test_scenenn_annotation_writer_matches_reference_text(path):
    write_annotation(path, OBJECTS)
    assert path.read_text() == GOLDEN


def test_scenenn_annotation_round_trip_preserves_labels(path):
    odd = Annotated(3, 'a <b> & "c\'s"\n\tKüche', "sofa", (1, 2, 3), None, dataclasses.replace(BOX, rotation=TURN))
    write_annotation(path, (*OBJECTS, odd))
    for read, written in zip(read_annotation(path), (*OBJECTS, odd), strict=True):
        assert_same(read, written)


def test_scenenn_annotation_box_is_rotated_by_quaternion(path):
    """The quaternion is a rotation by 90 degrees about z, which maps x to y."""
    half = np.sqrt(0.5)
    box = read_label(path, f'id="1" obbox="1 2 3 4 5 6 0 0 {half} {half}"').obb
    np.testing.assert_allclose(box.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert (box.center.tolist(), box.extent.tolist()) == ([1, 2, 3], [4, 5, 6])


def test_scenenn_annotation_unknown_xml_content_is_ignored(path):
    path.write_text('<scene v="2"><!-- x --><camera id="x"/>text<label id=" 7 " z="1"><part id="8"/></label></scene>')
    (label,) = read_annotation(path)
    assert_same(label, Annotated(7, "", "", NO_COLOR, None, None))


def test_scenenn_annotation_xml_namespace_is_ignored(path):
    path.write_text('<annotation xmlns="http://a.b/c"><label id="7" text="chair"/></annotation>')
    assert [(label.id, label.text) for label in read_annotation(path)] == [(7, "chair")]
    path.write_text('<n:annotation xmlns:n="http://a.b/c"><n:label id="7" text="chair"/></n:annotation>')
    assert [(label.id, label.text) for label in read_annotation(path)] == [(7, "chair")]


def test_scenenn_annotation_duplicate_labels_count_once(path):
    path.write_text('<a><label id="5" text="chair"/><label id="6"/><label id="5" text="chair"/></a>')
    assert [label.id for label in read_annotation(path)] == [5, 6]


@pytest.mark.parametrize("text", ["<annotation/>", "<annotation><labels/></annotation>", "<a><b id='1'/></a>"])
def test_scenenn_annotation_without_labels_raises(path, text):
    path.write_text(text)
    with pytest.raises(DataError, match=r"011.xml: expected <label> elements"):
        read_annotation(path)


@pytest.mark.parametrize("text", ["", "1 2", "1 2 3 4", "1 2 256", "1 2 -1", "1 2 x", "1 2 nan", "1 2 2.5"])
def test_scenenn_annotation_invalid_color_is_none(path, text):
    assert read_label(path, f'id="1" color="{text}"').color == NO_COLOR


@pytest.mark.parametrize("text", ["", "0 0 0 1 1", "0 0 0 1 1 1 1", "0 0 0 1 1 inf", "0 0 0 1 1 x", "0 0 2 1 1 1"])
def test_scenenn_annotation_invalid_aligned_box_is_none(path, text):
    assert read_label(path, f'id="1" aabbox="{text}"').aabb is None


@pytest.mark.parametrize("text", ["0 0 0 1 1 1", "0 0 0 1 1 -1 0 0 0 1", "0 0 0 1 1 1 0 0 0 0", "0 0 0 1 1 1 0 0 0 9"])
def test_scenenn_annotation_invalid_oriented_box_is_none(path, text):
    assert read_label(path, f'id="1" obbox="{text}"').obb is None


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ("<label/>", "line 3: label: expected an id from 0 to 2147483647, got none"),
        ('<label id=""/>', "line 3: label: expected an id .* got ''"),
        ('<label id="chair"/>', "line 3: .* got 'chair'"),
        ('<label id="-1"/>', "line 3: .* got '-1'"),
        ('<label id="1.0"/>', "line 3: .* got '1.0'"),
        ('<label id="2147483648"/>', "line 3: .* got '2147483648'"),
        ('<label id="5" text="a"/>', "line 3: label 5: expected text=None as on line 2, got 'a'"),
        ("<label id=5/>", r"line 3: expected valid XML, got an error \(not well-formed \(invalid token\)\)"),
        ('<label id="6">', r"line 4: expected valid XML, got an error \(mismatched tag\)"),
        ('<label id="&a;"/>', r"line 3: expected valid XML, got an error \(undefined entity\)"),
    ],
)
def test_scenenn_annotation_malformed_error_gives_line(path, label, message):
    path.write_text(f'<annotation>\n<label id="5"/>\n{label}\n</annotation>')
    with pytest.raises(DataError, match=f"011.xml, {message}"):
        read_annotation(path)


BOMB = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10 if k else "ha"}">' for k in range(12))


@pytest.mark.parametrize(
    "prologue",
    [
        f"<!DOCTYPE l [{BOMB}]>",
        '<!DOCTYPE l [<!ENTITY a11 SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE l [<!ENTITY % a11 SYSTEM "http://127.0.0.1/a.dtd"> %a11;]>',
        '<!DOCTYPE l SYSTEM "file:///etc/passwd">',
        f'<!DOCTYPE l [<!ATTLIST label text CDATA "{"x" * 100000}">]>',  # each label would have this value
    ],
)
def test_scenenn_annotation_entities_and_doctypes_raise(path, prologue):
    path.write_text(f'<?xml version="1.0"?>\n{prologue}\n<l><label id="1" text="&a11;"/></l>')
    began = time.process_time()
    with pytest.raises(DataError, match=r"011.xml, line 2: expected XML without a document type or entities") as caught:
        read_annotation(path)
    assert time.process_time() - began < 1
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["rot13", "hex", "shift_jis", "idna", "x" * 1000])
def test_scenenn_annotation_unknown_encoding_raises(path, encoding):
    path.write_text(f'<?xml version="1.0" encoding="{encoding}"?><l/>')
    with pytest.raises(DataError, match=r"011.xml, line 1: expected UTF-8, got an unknown encoding$"):
        read_annotation(path)


def test_scenenn_annotation_latin_1_and_utf_16_are_read(path):
    path.write_text('<?xml version="1.0" encoding="latin-1"?><l><label id="1" text="Küche"/></l>', encoding="latin-1")
    assert read_annotation(path)[0].text == "Küche"
    path.write_bytes('<?xml version="1.0" encoding="utf-16"?><l><label id="1" text="Küche"/></l>'.encode("utf-16"))
    assert read_annotation(path)[0].text == "Küche"


def test_scenenn_annotation_nested_xml_needs_no_recursion(path):
    path.write_text("<a>" * 50000 + '<label id="1"/>' + "</a>" * 50000)
    assert [label.id for label in read_annotation(path)] == [1]


def test_scenenn_annotation_missing_or_oversized_raises(path, monkeypatch):
    with pytest.raises(DataError, match=r"011.xml: expected a readable file, got an error \(No such file"):
        read_annotation(path)
    monkeypatch.setattr(scenenn_annotation, "LARGEST_FILE", 100)
    path.write_text("<a><label id='1'/>" + " " * 78 + "</a>")
    assert len(read_annotation(path)) == 1
    path.write_text("<a><label id='1'/>" + " " * 79 + "</a>")
    with pytest.raises(DataError, match=r"011.xml: expected at most 100 bytes, got 101"):
        read_annotation(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"id": -1}, "expected unique label ids from 0 .*, got -1"),
        ({"id": 0}, "expected unique label ids from 0 .*, got 0"),
        ({"color": (0, 0, 256)}, "label 5: color: expected 3 values"),
        ({"text": "a\0b"}, r"label 5: expected a name .*, got 'a\\x00b'"),
        ({"nyu_class": "\ud800"}, "label 5"),
        ({"aabb": np.full((2, 3), np.nan)}, "label 5: expected finite boxes with extent >= 0, got {'aabbox': 'nan nan"),
        ({"obb": dataclasses.replace(BOX, extent=np.array([1, 1, -1.0]))}, "label 5: expected finite boxes"),
    ],
)
def test_scenenn_annotation_invalid_label_leaves_no_file(path, change, message):
    with pytest.raises(DataError, match=message):
        write_annotation(path, (OBJECTS[1], dataclasses.replace(Annotated(5, "chair", "chair"), **change)))
    with pytest.raises(DataError, match="at least one label"):
        write_annotation(path, ())
    assert list(path.parent.iterdir()) == []
