"""Frames of synthetic sequences, which are rendered once for all test processes.

The cache is in the cache folder of the user. The key is a hash of the rendering code, the library versions and the
parameters of the sequence.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import platformdirs
from filelock import FileLock

from framework.data import Frame
from framework.synthetic.sequence import Synthetic

FRAMEWORK = Path(__file__).resolve().parents[2] / "framework"
CODE = ("data.py", "geometry.py", "rendering", "sensors", "synthetic")
LIBRARIES = ("numpy", "numba", "open3d")


def rendered_frames(sequence: Synthetic, indices: Sequence[int] | None = None) -> list[Frame]:
    """Return the frames with these indices, by default all frames. Frames in the cache are not rendered again."""
    chosen = list(range(len(sequence)) if indices is None else indices)
    directory = Path(platformdirs.user_cache_dir("instancemap"), "test_frames")
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{_key(sequence, chosen)}.pickle"
    with FileLock(f"{path}.lock"):
        if not path.exists():
            frames = [sequence[k] for k in chosen]
            partial = path.with_suffix(".partial")
            partial.write_bytes(pickle.dumps(frames, pickle.HIGHEST_PROTOCOL))
            partial.replace(path)
            return frames
    restored: list[Frame] = pickle.loads(path.read_bytes())
    return restored


def _key(sequence: Synthetic, chosen: Sequence[int]) -> str:
    digest = hashlib.sha256(repr((sequence, chosen, [version(name) for name in LIBRARIES])).encode())
    for part in CODE:
        for path in sorted([FRAMEWORK / part, *(FRAMEWORK / part).rglob("*.py")]):
            if path.is_file():
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
