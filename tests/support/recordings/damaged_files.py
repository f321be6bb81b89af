"""Random damage to files, for fuzz tests of readers."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from framework.errors import DataError

EXAMPLES = int(os.environ.get("INSTANCEMAP_FUZZ", "30"))
SLOWEST = 2.0  # s, maximum CPU time to read a file of up to 100 KB; wall time would depend on other processes
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
ODD_NUMBERS = (b"0", b"-1", b"3", b"65536", b"2147483648", b"4294967295", b"1" * 20, b"1" * 5000, b"1e400", b"-0.5")
NO_NUMBERS = (b"nan", b"-inf", b"1_0", b"0x1p3", b"x", b"", b"\xff", b"\x00", b"1 1", b"\n")


LARGE = (0, 1, -1, 2, 255, 256, -2, 32767, 2**20, 10**8, 2**31 - 1, -(2**31), 2**31, 2**63 - 1, 10**30, 10**400)
ODD = (*LARGE, 0.5, 1e-300, 1e300, -1e-9, float("nan"), float("inf"), None, True, "", "x", "\n" * 300, [], {}, [[]])


@st.composite
def changed_json(draw: st.DrawFn, node: Any) -> Any:
    """Return JSON with one random value replaced, removed or duplicated."""
    if isinstance(node, dict) and node and draw(st.integers(0, 9)):
        key = draw(st.sampled_from(sorted(node)))
        if draw(st.integers(0, 9)) == 0:
            return {name: value for name, value in node.items() if name != key}
        return node | {key: draw(changed_json(node[key]))}
    if isinstance(node, list) and node and draw(st.integers(0, 4)):
        k = draw(st.integers(0, len(node) - 1))
        if draw(st.integers(0, 4)) == 0:
            return node[:k] + node[k : k + 1] * draw(st.sampled_from((0, 2))) + node[k + 1 :]
        return [*node[:k], draw(changed_json(node[k])), *node[k + 1 :]]
    return draw(st.sampled_from(ODD))


@st.composite
def damaged(draw: st.DrawFn, content: bytes, tokens: tuple[bytes, ...]) -> bytes:
    """Return `content` with one to four random changes, like those caused by disks, transfers, editors or attackers."""
    for _ in range(draw(st.integers(1, 4))):
        first = draw(st.integers(0, max(len(content) - 1, 0)))
        last = first + draw(st.integers(0, 30))
        match draw(st.sampled_from(("flip", "delete", "insert", "repeat", "cut", "number", "token"))):
            case "flip":
                flipped = bytes(b ^ draw(st.integers(1, 255)) for b in content[first : first + 1])
                content = content[:first] + flipped + content[first + 1 :]
            case "delete":
                content = content[:first] + content[last:]
            case "insert":
                content = content[:first] + draw(st.binary(max_size=20)) + content[first:]
            case "repeat":
                content = content[:last] + content[first:last] * draw(st.integers(1, 3)) + content[last:]
            case "cut":
                content = content[:first]
            case "token":
                content = content[:first] + draw(st.sampled_from(tokens)) + content[first:]
            case "number":
                numbers = list(NUMBER.finditer(content))
                if numbers:
                    start, end = draw(st.sampled_from(numbers)).span()
                    content = content[:start] + draw(st.sampled_from(ODD_NUMBERS + NO_NUMBERS)) + content[end:]
    return content


def check(read: Callable[[Path], object], path: Path, content: bytes) -> str:
    """Write and read the file. Return the error message, or "" without an error. Fail for any other outcome."""
    path.write_bytes(content)
    began = time.process_time()
    try:
        read(path)
    except DataError as error:
        line = str(error)
    else:
        line = ""
    assert time.process_time() - began < SLOWEST
    assert line.isprintable(), line
    assert len(line) < 400 + len(str(path)), line
    assert not line or str(path) in line
    return line
