"""Lists whose items are on disk, so that the memory of a run does not grow with its length."""

from __future__ import annotations

import logging
import pickle
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, TypeVar, cast, overload

log = logging.getLogger(__name__)

CHUNK = 128  # number of items that are written together

Item = TypeVar("Item")


class Spool:
    """An unnamed temporary file, which disappears with the process. It is created when something is written.

    If the disk cannot be written, a warning is logged, and later chunks stay in memory.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder  # None = the folder for temporary files
        self._file: BinaryIO | None = None
        self._end = 0  # size of the complete chunks, bytes
        self._failed = False

    def __reduce__(self) -> tuple[type[Spool], tuple[Path | None]]:
        return Spool, (self._folder,)  # a copy is empty

    def write(self, content: bytes) -> int | None:
        """Append the content, and return its position; None = it cannot be written."""
        if self._failed:
            return None
        start, end = self._end, self._end + len(content)
        try:
            if self._file is None:
                file = tempfile.TemporaryFile(buffering=0, dir=self._folder)  # noqa: SIM115  (open until the end)
                self._file = cast(BinaryIO, file)
            self._file.seek(start)
            while start < end:
                start += self._file.write(content[start - end :])
        except OSError as error:
            self._failed = True
            log.warning(
                "%s: expected a writable disk for the frame data of the run, got an error (%s); keeping them in memory",
                self._folder or tempfile.gettempdir(), error.strerror,
            )  # fmt: skip
            return None
        start, self._end = self._end, end
        return start

    def opened(self, start: int) -> BinaryIO:
        """Return the file for reading at the position `start`."""
        assert self._file is not None
        self._file.seek(start)
        return self._file


class SpooledList(Sequence[Item]):
    """A list with all but its last items in a temporary file. Several lists can share the file.

    The items are pickled, so each access to an item returns another copy.
    """

    def __init__(self, spool: Spool) -> None:
        self._spool = spool
        self.clear()

    def __reduce__(self) -> tuple[type[SpooledList[Item]], tuple[Spool], None, Iterator[Item]]:
        return SpooledList, (self._spool,), None, iter(self)

    def clear(self) -> None:
        """Remove all items. Their space in the file is not reused."""
        self._starts = array("q")  # position of each chunk in the file, -1 = in memory
        self._unwritten: dict[int, bytes] = {}  # chunks that could not be written, by number
        self._last: list[Item] = []

    def append(self, item: Item) -> None:
        self._last.append(item)
        if len(self._last) == CHUNK:
            content = pickle.dumps(self._last, pickle.HIGHEST_PROTOCOL)
            start = self._spool.write(content)
            if start is None:
                self._unwritten[len(self._starts)] = content
            self._starts.append(-1 if start is None else start)
            self._last = []

    def extend(self, items: Iterable[Item]) -> None:
        for item in items:
            self.append(item)

    def __len__(self) -> int:
        return CHUNK * len(self._starts) + len(self._last)

    @overload
    def __getitem__(self, index: int) -> Item: ...

    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...

    def __getitem__(self, index: int | slice) -> Item | list[Item]:
        if isinstance(index, slice):
            return list(self)[index]
        k = range(len(self))[index]
        return self._chunk(k // CHUNK)[k % CHUNK]

    def __iter__(self) -> Iterator[Item]:
        for number in range(len(self._starts) + 1):
            yield from self._chunk(number)

    def _chunk(self, number: int) -> list[Item]:
        if number == len(self._starts):
            return self._last
        unwritten = self._unwritten.get(number)
        content = self._spool.opened(self._starts[number]) if unwritten is None else BytesIO(unwritten)
        return cast(list[Item], pickle.load(content))
