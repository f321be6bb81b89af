"""Simulated power cuts: the files that remain if all data that was not synced is lost.

`VolatileDisk` records which file contents and folder entries were synced (`os.fsync`). Before each operation that
changes files, `check` is called with two copies of the folder, as after a power cut at this moment:

- DATA_LOST: new, renamed and removed entries are on disk, but contents that were not synced are lost.
- ALL_LOST: entries and contents that were not synced are lost.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path
from typing import Any
from unittest import mock

CHANGES = ("replace", "rename", "unlink", "remove", "mkdir", "rmdir", "fsync")
"""Functions of `os` before which the power may be cut."""

ORIGINALS = {name: getattr(os, name) for name in CHANGES}


class Lost(Enum):
    """Data that a power cut removes."""

    DATA_LOST = "contents that were not synced"
    ALL_LOST = "contents and entries that were not synced"


class VolatileDisk:
    """Folder on a disk that keeps only synced data after a power cut."""

    def __init__(self, root: Path, held: Path, check: Callable[[Path, Lost, str], None]) -> None:
        """Take the current files as synced.

        Args:
            root: The folder.
            held: An unused path on the same file system, for links to removed files and for the copies.
            check: Function that is called with the path of a copy, the lost data and the next operation.
        """
        self.root, self.held, self.check = root, held, check
        self.cuts = 0  # number of moments at which the power was cut
        self._contents: dict[int, bytes] = {}  # synced contents by inode
        self._entries: dict[int, dict[str, int]] = {}  # synced inode by name, by inode of the folder
        self._folders: set[int] = set()  # inodes of all folders
        (held / "links").mkdir(parents=True)
        for folder, _, files in os.walk(root):
            self._sync_folder(folder)
            for name in files:
                path = Path(folder, name)
                self._contents[path.stat().st_ino] = path.read_bytes()

    @contextmanager
    def active(self) -> Iterator[None]:
        """Record the operations within a context."""
        with mock.patch.multiple(os, **{name: self._patched(name) for name in CHANGES}):
            yield
        self._cut("end")

    def _patched(self, name: str) -> Callable[..., Any]:
        function = ORIGINALS[name]

        def operate(*arguments: Any, **named: Any) -> Any:
            inside = name == "fsync" or any(self._is_inside(argument) for argument in arguments)
            if not inside:
                return function(*arguments, **named)
            with mock.patch.multiple(os, **ORIGINALS):
                self._cut(f"{name} {arguments}")
                if name != "fsync":
                    for argument in arguments:
                        self._hold(argument, named.get("dir_fd"))
                result = function(*arguments, **named)
                if name == "fsync":
                    self._sync(arguments[0])
                if name == "mkdir":
                    self._entries.pop(os.stat(arguments[0], dir_fd=named.get("dir_fd")).st_ino, None)
            return result

        return operate

    def _is_inside(self, path: object) -> bool:
        if not isinstance(path, str | Path):
            return False
        return Path(path).absolute().is_relative_to(self.root)

    def _hold(self, path: object, folder: int | None) -> None:
        """Link a file that may be removed, so that its inode is not used again."""
        if not isinstance(path, str | Path):
            return
        try:
            found = os.stat(path, dir_fd=folder, follow_symlinks=False)
            link = self.held / "links" / str(found.st_ino)
            if stat.S_ISREG(found.st_mode) and not link.exists():
                os.link(path, link, src_dir_fd=folder)
        except OSError:
            pass

    def _sync(self, descriptor: int) -> None:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            self._sync_folder(f"/proc/self/fd/{descriptor}")
        elif stat.S_ISREG(found.st_mode):
            self._contents[found.st_ino] = Path(f"/proc/self/fd/{descriptor}").read_bytes()

    def _sync_folder(self, folder: str) -> None:
        number = Path(folder).stat().st_ino
        self._folders.add(number)
        self._entries[number] = {}
        for entry in os.scandir(folder):
            if entry.is_dir():
                self._folders.add(entry.inode())
            self._entries[number][entry.name] = entry.inode()

    def _cut(self, operation: str) -> None:
        """Check the copies of the folder after a power cut before an operation."""
        self.cuts += 1
        for lost in Lost:
            copy = self.held / "copy"
            shutil.rmtree(copy, ignore_errors=True)
            if lost is Lost.DATA_LOST:
                self._copy_current(self.root, copy)
            else:
                self._copy_synced(self.root.stat().st_ino, copy)
            self.check(copy, lost, operation)

    def _copy_current(self, folder: Path, copy: Path) -> None:
        copy.mkdir()
        for entry in os.scandir(folder):
            if entry.is_dir():
                self._copy_current(Path(entry), copy / entry.name)
            else:
                (copy / entry.name).write_bytes(self._contents.get(entry.inode(), b""))

    def _copy_synced(self, number: int, copy: Path) -> None:
        copy.mkdir()
        for name, below in self._entries.get(number, {}).items():
            if below in self._folders:
                self._copy_synced(below, copy / name)
            else:
                (copy / name).write_bytes(self._contents.get(below, b""))
