"""SHA-256 hashes of arrays, files and folders."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from framework.data import Array
from framework.files.atomic_write import check_regular

CHUNK = 2**22  # bytes; smaller chunks delay threads that wait for the interpreter lock


def add_values(digest: hashlib._Hash, array: Array) -> None:
    """Add the values of an array to a hash."""
    digest.update(np.ascontiguousarray(array).data)


def add_array(digest: hashlib._Hash, array: Array) -> None:
    """Add the type, shape and values of an array to a hash."""
    digest.update(f"{array.dtype.str}{array.shape};".encode())
    add_values(digest, array)


def path_hash(path: Path) -> str:
    """Return the SHA-256 of a file, or of all files in a folder.

    Raises:
        DataError: A file cannot be read.
    """
    if path.is_dir():
        digest = hashlib.sha256()
        for below in sorted(below for below in path.rglob("*") if below.is_file()):
            name = below.relative_to(path).as_posix()
            digest.update(f"{len(name)}:{name}:{path_hash(below)}".encode())
        return digest.hexdigest()
    check_regular(path)
    digest = hashlib.sha256()
    with path.open("rb", buffering=0) as file:
        chunk = memoryview(bytearray(min(CHUNK, path.stat().st_size) or 1))
        while count := file.readinto(chunk):
            digest.update(chunk[:count])
    return digest.hexdigest()
