"""Reader and writer of SceneNN annotations (NNN.xml)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError
from xml.parsers.expat import ErrorString
from xml.sax.saxutils import quoteattr

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser
from scipy.spatial.transform import Rotation

from framework.data import Box, Float64
from framework.errors import DataError
from framework.files.atomic_write import atomic_write, read_bytes

LARGEST_FILE = 2**24  # bytes; annotations have about 100 KB; 16 MiB of crafted XML take 9 s and 0.5 GB
LARGEST_ID = int(np.iinfo(np.int32).max)  # largest mesh label
QUATERNION_TOLERANCE = 1e-2  # maximum | |q| - 1 |, due to rounding of printed digits
NO_COLOR = (0, 0, 0)
NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Annotated:
    """The annotation of a mesh label.

    Missing or invalid values are "", NO_COLOR or None.
    """

    id: int  # the value of the mesh's vertex property `label`, 0 to LARGEST_ID
    text: str  # name given by the annotators
    nyu_class: str  # class name in the NYU label set
    color: tuple[int, int, int] = NO_COLOR  # RGB
    aabb: Float64 | None = None  # (2, 3) m, minimum and maximum corner of the axis-aligned box
    obb: Box | None = None  # oriented box


def read_annotation(path: Path) -> tuple[Annotated, ...]:
    """Read the labels of an annotation.

    Unknown elements and attributes are ignored.

    Raises:
        DataError: The file is not valid XML, declares a document type, or contains no labels or invalid ids.
    """
    content = read_bytes(path, LARGEST_FILE)
    labels = _Labels(path)
    parser = DefusedXMLParser(target=labels, forbid_dtd=True)
    labels.expat = parser.parser
    try:
        parser.feed(content)
        parser.close()
    except DefusedXmlException as error:
        raise labels.error("expected XML without a document type or entities, got a declaration; remove it") from error
    except ParseError as error:
        raise DataError(
            f"{path}, line {error.position[0]}: expected valid XML, got an error ({ErrorString(error.code)})"
        ) from error
    except (ValueError, LookupError) as error:
        raise labels.error("expected UTF-8, got an unknown encoding") from error
    if not labels.found:
        raise DataError(f"{path}: expected <label> elements of a SceneNN annotation, got none")
    return tuple(
        Annotated(
            id_,
            attributes.get("text", ""),
            attributes.get("nyu_class", ""),
            _color(attributes.get("color", "")),
            _aabb(attributes.get("aabbox", "")),
            _obb(attributes.get("obbox", "")),
        )
        for id_, (attributes, _) in labels.found.items()
    )


def write_annotation(path: Path, objects: Sequence[Annotated]) -> None:
    """Write an annotation.

    Raises:
        DataError: A value cannot be represented in the file, or the file cannot be written.
    """
    if not objects:
        raise DataError(f"{path}: expected at least one label, got none")
    lines = ['<?xml version="1.0" encoding="utf-8"?>', "<annotation>"]
    ids = set()
    for label in objects:
        attributes = _attributes(label)
        if _id(attributes["id"]) is None or label.id in ids:
            raise DataError(f"{path}: expected unique label ids from 0 to {LARGEST_ID}, got {label.id}")
        ids.add(label.id)
        if _color(attributes["color"]) != label.color:
            raise DataError(f"{path}: label {label.id}: color: expected 3 values from 0 to 255, got {label.color}")
        if NOT_IN_XML.search(label.text + label.nyu_class):
            expected = "expected a name without characters that are invalid in XML"
            raise DataError(f"{path}: label {label.id}: {expected}, got {label.text!r}")
        if (label.aabb is not None and _aabb(attributes["aabbox"]) is None) or (
            label.obb is not None and _obb(attributes["obbox"]) is None
        ):
            boxes = {name: attributes[name] for name in ("aabbox", "obbox") if name in attributes}
            raise DataError(f"{path}: label {label.id}: expected finite boxes with extent >= 0, got {boxes}")
        lines.append(f"  <label {' '.join(f'{name}={quoteattr(value)}' for name, value in attributes.items())}/>")
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join([*lines, "</annotation>\n"]), encoding="utf-8")


class _Labels:
    """XML parser target that collects the labels without a tree."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.expat: Any = None  # provides the line of an error
        self.found: dict[int, tuple[dict[str, str], int]] = {}  # by id: attributes and line of the label

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag.rpartition("}")[2] != "label":  # without a namespace
            return
        id_ = _id(attributes.get("id", ""))
        if id_ is None:
            found = repr(attributes["id"][:40]) if "id" in attributes else "none"
            raise self.error(f"label: expected an id from 0 to {LARGEST_ID}, got {found}")
        before, line = self.found.setdefault(id_, (attributes, self.expat.CurrentLineNumber))
        if attributes != before:
            name = min(key for key, _ in attributes.items() ^ before.items())
            expected = f"expected {name:.40}={before.get(name)!r:.40} as on line {line}"
            raise self.error(f"label {id_}: {expected}, got {attributes.get(name)!r:.40}")

    def error(self, message: str) -> DataError:
        return DataError(f"{self._path}, line {self.expat.CurrentLineNumber}: {message}")


def _attributes(label: Annotated) -> dict[str, str]:
    color = " ".join(map(str, label.color))
    attributes = {"id": str(label.id), "color": color, "text": label.text, "nyu_class": label.nyu_class}
    if label.aabb is not None:
        attributes["aabbox"] = _written(label.aabb.ravel())
    if label.obb is not None:
        quat_xyzw = Rotation.from_matrix(label.obb.rotation).as_quat(canonical=True)
        attributes["obbox"] = _written(np.concatenate([label.obb.center, label.obb.extent, quat_xyzw]))
    return attributes


def _written(numbers: Float64) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def _id(text: str) -> int | None:
    text = text.strip()
    valid = text.isascii() and text.isdigit() and len(text) <= 10 and int(text) <= LARGEST_ID
    return int(text) if valid else None


def _color(text: str) -> tuple[int, int, int]:
    numbers = _numbers(text, 3)
    if numbers is None or not np.isin(numbers, np.arange(256)).all():
        return NO_COLOR
    red, green, blue = map(int, numbers)
    return red, green, blue


def _aabb(text: str) -> Float64 | None:
    """Parse an axis-aligned box `minx miny minz maxx maxy maxz`, m, or return None if invalid."""
    numbers = _numbers(text, 6)
    if numbers is None or (numbers[:3] > numbers[3:]).any():
        return None
    return numbers.reshape(2, 3)


def _obb(text: str) -> Box | None:
    """Parse an oriented box with center (m), extent (m) and quaternion xyzw, or return None if invalid.

    The order of the numbers is documented in github.com/hkust-vgd/scenenn, issue 11.
    """
    numbers = _numbers(text, 10)
    if numbers is None or (numbers[3:6] < 0).any():
        return None
    if not abs(np.linalg.norm(numbers[6:]) - 1) <= QUATERNION_TOLERANCE:
        return None
    return Box(numbers[:3], numbers[3:6], Rotation.from_quat(numbers[6:]).as_matrix())


def _numbers(text: str, count: int) -> Float64 | None:
    """Parse `count` finite numbers, or return None if invalid."""
    try:
        numbers = np.array([float(word) for word in text.split(maxsplit=count)])
    except ValueError:
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None
