"""SceneNN's annotation, NNN.xml: which objects the labels of the mesh are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
from framework.files.atomic_write import read_bytes, written_whole

LARGEST_FILE = 2**24  # bytes; annotations have some 100 KB, and 16 MiB of crafted XML take 9 s and 0.5 GB
LARGEST_ID = int(np.iinfo(np.int32).max)  # what a label of the mesh can be
QUATERNION_TOLERANCE = 1e-2  # largest | |q| - 1 | that is rounding of printed digits
NO_COLOR = (0, 0, 0)
NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Annotated:
    """One label of the mesh. What the file does not say, or not in a usable form, is "", NO_COLOR or None."""

    id: int  # the value of the mesh's vertex property `label`, 0 to LARGEST_ID
    text: str  # what the annotators called it
    nyu_class: str  # its class among NYU's
    color: tuple[int, int, int] = NO_COLOR  # RGB
    aabb: Float64 | None = None  # (2, 3) m, smallest and largest corner
    obb: Box | None = None


def read_annotation(path: Path) -> tuple[Annotated, ...]:
    """The labels of an annotation, in the file's order; elements and attributes that are not known are left out.

    Raises DataError, naming the line, when the file is not XML, declares a document type (with which entities and
    default attributes come), has no label, or one with no integer as its id, or two that differ with one id.
    """
    content = read_bytes(path, LARGEST_FILE)
    labels = _Labels(path)
    parser = DefusedXMLParser(target=labels, forbid_dtd=True)
    labels.expat = parser.parser
    try:
        parser.feed(content)
        parser.close()
    except DefusedXmlException as error:
        raise DataError(
            f"{path}, line {labels.line}: document types and entities are refused, as they can be an attack; remove it"
        ) from error
    except ParseError as error:
        raise DataError(f"{path}, line {error.position[0]}: this is not XML: {ErrorString(error.code)}") from error
    except (ValueError, LookupError) as error:
        raise DataError(f"{path}, line {labels.line}: its encoding is not known, expected UTF-8") from error
    if not labels.found:
        raise DataError(f"{path} holds no <label>: it is no annotation of SceneNN's")
    return tuple(_annotated(id_, attributes) for id_, (attributes, _) in labels.found.items())


def write_annotation(path: Path, objects: Sequence[Annotated]) -> None:
    """Writes an annotation, whole or not at all; `read_annotation` gives back the same, rotations to 1e-15.

    Raises DataError when it would not, or the disk does not take the file.
    """
    if not objects:
        raise DataError(f"{path}: an annotation has at least one label")
    lines = ['<?xml version="1.0" encoding="utf-8"?>', "<annotation>"]
    ids = set()
    for label in objects:
        attributes = _attributes(label)
        if _id(attributes["id"]) is None or label.id in ids:
            raise DataError(f"{path}: the id of a label is from 0 to {LARGEST_ID} and its own, found {label.id}")
        ids.add(label.id)
        if _color(attributes["color"]) != label.color:
            raise DataError(f"{path}: the color of label {label.id} is three values from 0 to 255, found {label.color}")
        if NOT_IN_XML.search(label.text + label.nyu_class):
            raise DataError(f"{path}: label {label.id} is called {label.text!r}, and XML cannot hold that")
        if (label.aabb is not None and _aabb(attributes["aabbox"]) is None) or (
            label.obb is not None and _obb(attributes["obbox"]) is None
        ):
            raise DataError(f"{path}: a box of label {label.id} has no finite extent")
        lines.append(f"  <label {' '.join(f'{name}={quoteattr(value)}' for name, value in attributes.items())}/>")
    with written_whole(path) as temporary:
        temporary.write_text("\n".join([*lines, "</annotation>\n"]), encoding="utf-8")


class _Labels:
    """Collects the labels while the parser goes through the file: no tree, however large or deep the file is."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.expat: Any = None  # it knows the line
        self.found: dict[int, tuple[dict[str, str], int]] = {}  # by id: the label's attributes and its line

    @property
    def line(self) -> int:
        return int(self.expat.CurrentLineNumber)

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        if tag.rpartition("}")[2] != "label":  # behind its namespace, if it has one
            return
        id_ = _id(attributes.get("id", ""))
        if id_ is None:
            found = repr(attributes["id"][:40]) if "id" in attributes else "none"
            raise self._fault(f"a label needs an id from 0 to {LARGEST_ID}, found {found}")
        before, line = self.found.setdefault(id_, (attributes, self.line))
        if attributes != before:
            raise self._fault(f"the label {id_} is there already in line {line}, with other attributes")

    def _fault(self, message: str) -> DataError:
        return DataError(f"{self._path}, line {self.line}: {message}")


def _annotated(id_: int, attributes: Mapping[str, str]) -> Annotated:
    return Annotated(
        id=id_,
        text=attributes.get("text", ""),
        nyu_class=attributes.get("nyu_class", ""),
        color=_color(attributes.get("color", "")),
        aabb=_aabb(attributes.get("aabbox", "")),
        obb=_obb(attributes.get("obbox", "")),
    )


def _attributes(label: Annotated) -> dict[str, str]:
    attributes = {
        "id": str(label.id),
        "color": " ".join(map(str, label.color)),
        "text": label.text,
        "nyu_class": label.nyu_class,
    }
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
    if not (text.isascii() and text.isdigit() and len(text) <= 10 and int(text) <= LARGEST_ID):
        return None
    return int(text)


def _color(text: str) -> tuple[int, int, int]:
    numbers = _numbers(text, 3)
    if numbers is None or not np.isin(numbers, np.arange(256)).all():
        return NO_COLOR
    red, green, blue = map(int, numbers)
    return red, green, blue


def _aabb(text: str) -> Float64 | None:
    """From `minx miny minz maxx maxy maxz`."""
    numbers = _numbers(text, 6)
    if numbers is None or (numbers[:3] > numbers[3:]).any():
        return None
    return numbers.reshape(2, 3)


def _obb(text: str) -> Box | None:
    """From the centre, the dimensions and a quaternion xyzw (github.com/hkust-vgd/scenenn, issue 11)."""
    numbers = _numbers(text, 10)
    if numbers is None or (numbers[3:6] < 0).any():
        return None
    if not abs(np.linalg.norm(numbers[6:]) - 1) <= QUATERNION_TOLERANCE:
        return None
    return Box(numbers[:3], numbers[3:6], Rotation.from_quat(numbers[6:]).as_matrix())


def _numbers(text: str, count: int) -> Float64 | None:
    """So many finite numbers, or None."""
    words = text.split(maxsplit=count)
    if len(words) != count:
        return None
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError:
        return None
    return numbers if np.isfinite(numbers).all() else None
