"""Writer for OpenNI recordings (.oni)."""

import os
import signal
import struct
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

DEPTH, COLOR = 2, 3  # node types of the format
NAMES = {DEPTH: "Depth", COLOR: "Image"}
DEPTH_1_MM, RGB888, YUV422 = 100, 200, 201
GRAY16, RGB24 = 4, 1  # pixel formats of OpenNI 1
OPENNI_1_END_NODE = 2**32 - 1


def uncompressed(image):
    return image.tobytes()


def jpeg(image):
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, 100))[1].tobytes()


def with_table(image):
    """Return an image in the 16zT encoding of OpenNI, without short forms.

    The content is the table of values, the index of the first pixel, and then 0xff and an index for each other pixel.
    """
    values, places = np.unique(image, return_inverse=True)
    table = struct.pack("<H", len(values)) + values.astype("<u2").tobytes()
    first, *others = places.ravel()
    return table + struct.pack("<H", first) + b"".join(b"\xff" + struct.pack(">H", place) for place in others)


CODECS = {b"NONE": uncompressed, b"JPEG": jpeg, b"16zT": with_table}


@dataclass
class Node:
    """Stream of depth images (H, W), uint16, or of color images (H, W, 3), uint8 RGB."""

    type: int
    images: list[np.ndarray]
    times: list[int]  # time of each image, us
    codec: bytes = b"NONE"
    pixel_format: int | None = None  # pixel format of OpenNI 2; None = omitted, like in OpenNI 1
    positions: list[int] = field(default_factory=list)  # byte offset of each image record, set by OniFile.write


@dataclass
class OniFile:
    """Content of a recording."""

    nodes: list[Node]
    wide: bool = True  # True = version 1.0.1.0, with 64-bit positions; False = 1.0.0.5, without seek tables
    end_node: int = 0  # node in the end record; OpenNI 1 writes OPENNI_1_END_NODE

    def write(self, path: Path) -> Path:
        content = self._content([0] * len(self.nodes))
        if self.wide:
            tables, position = [], self._tables_at
            for node in self.nodes:
                tables.append(position)
                position += 28 + 20 * (len(node.images) + 1)
            content = self._content(tables)
        path.write_bytes(content)
        return path

    def _content(self, tables: list[int]) -> bytes:
        version = (1, 0, 1, 0) if self.wide else (1, 0, 0, 5)
        content = struct.pack("<4sBBHIQI", b"NI10", *version, 10**9, len(self.nodes))
        for k, (node, table) in enumerate(zip(self.nodes, tables, strict=True), start=1):
            content += self._added(k, node, table)
        for k, node in enumerate(self.nodes, start=1):
            node.positions.clear()
            content += self._record(0x08, k, struct.pack("<IQ", len(node.images), 10**9))
        order = sorted((time, k, i) for k, node in enumerate(self.nodes) for i, time in enumerate(node.times))
        for time, k, i in order:
            node = self.nodes[k]
            node.positions.append(len(content))
            content += self._record(0x0A, k + 1, struct.pack("<QI", time, i + 1), CODECS[node.codec](node.images[i]))
        for k in range(len(self.nodes)):
            content += self._record(0x07, k + 1)
        self._tables_at = len(content)
        if self.wide:
            for k, node in enumerate(self.nodes, start=1):
                entries = [(0, 0, 0), *((time, 0, at) for time, at in zip(node.times, node.positions, strict=True))]
                content += self._record(0x0E, k, payload=b"".join(struct.pack("<QIQ", *entry) for entry in entries))
        return content + self._record(0x0B, self.end_node)

    def _added(self, k: int, node: Node, table: int) -> bytes:
        height, width = node.images[0].shape[:2]
        fields = struct.pack("<I4sIQQ", node.type, node.codec, len(node.images), 0, 10**9)
        if self.wide:
            fields += struct.pack("<Q", table)
        content = self._record(0x0D if self.wide else 0x0C, k, _string(NAMES[node.type]) + fields)
        content += self._number(k, "xnDeviceMaxDepth", 10000)
        content += self._property(0x06, k, "xnMapOutputMode", struct.pack("<3I", width, height, 30))
        content += self._number(k, "xnPixelFormat", GRAY16 if node.type == DEPTH else RGB24)
        if node.pixel_format is not None:
            content += self._number(k, "oniPixelFormat", node.pixel_format)
        content += self._property(0x06, k, "xnCropping", bytes(12))
        return content + self._record(0x09, k)

    def _number(self, k: int, name: str, value: int) -> bytes:
        return self._property(0x03, k, name, struct.pack("<Q", value))

    def _property(self, kind: int, k: int, name: str, value: bytes) -> bytes:
        return self._record(kind, k, _string(name) + struct.pack("<I", len(value)) + value)

    def _record(self, kind: int, k: int, fields: bytes = b"", payload: bytes = b"") -> bytes:
        header = struct.Struct("<4s4I" + ("Q" if self.wide else "I"))
        return header.pack(b"NIR\0", kind, k, header.size + len(fields), len(payload), 0) + fields + payload


def _string(text: str) -> bytes:
    return struct.pack("<I", len(text) + 1) + text.encode() + b"\0"


def crash(sender, path, streams):
    """Simulate a crash of OpenNI 2 on a damaged recording."""
    os.kill(os.getpid(), signal.SIGKILL)
