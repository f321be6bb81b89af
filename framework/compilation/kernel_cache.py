"""Cache of compiled kernels with checksums, and the decorator `njit` that uses it.

numba loads the files of its cache unchecked: a damaged index raises an exception in each run, and damaged machine code
aborts the process. It also raises an exception if it cannot store a compiled kernel. Here, a damaged file counts as
missing and is replaced, and a kernel that cannot be stored is kept in memory.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache
from numba.core.dispatcher import Dispatcher

from framework.errors import DataError

log = logging.getLogger(__name__)

PROBE_BYTES = 2**20  # size of the file that tests a folder; the largest kernel has 0.3 MB
_warned: set[str] = set()  # topics of the logged warnings; each is logged once per process


def njit(cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return the decorator `numba.njit(**options)`. With `cache`, it stores kernels in a KernelCache."""
    compiled = numba.njit(**options)

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = compiled(function)
        if cache and isinstance(kernel, Dispatcher):  # a plain function with NUMBA_DISABLE_JIT
            kernel._cache = _cache_of(function)  # type: ignore[attr-defined]
        return kernel

    return decorate


def _cache_of(function: Callable[..., Any]) -> Any:
    try:
        return KernelCache(function)
    except RuntimeError:  # numba found no writable folder
        warn_of_storage(storage_error(None))
        return NullCache()


class CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """Index and data files of a kernel. The last 32 bytes of a file are the SHA-256 of the rest."""

    def contains(self, key: Any) -> bool:
        """Return True if the files contain undamaged code for a key of the index."""
        name = self._load_index().get(key)
        return name is not None and Path(self._data_path(name)).is_file() and not is_damaged(self._data_path(name))

    def _load_index(self) -> dict[Any, str]:
        return _loaded(self._index_path, super()._load_index) or {}

    def _load_data(self, name: str) -> Any:
        return _loaded(self._data_path(name), lambda: super(CheckedFiles, self)._load_data(name))

    @contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[BytesIO]:
        with super()._open_for_write(filepath) as file:
            buffer = BytesIO()
            yield buffer
            content = buffer.getvalue()
            file.write(content + sha256(content).digest())


def _loaded(path: str, load: Callable[[], Any]) -> Any:
    """Return the content of a file of the cache, or None if it cannot be used."""
    if is_damaged(path):
        text = "kernel cache: expected files with valid checksums, got damaged ones such as %s; compiling again"
        _warn_once("damage", text, path)
        return None
    try:
        return load()
    except Exception:  # unpickling raises any exception if a class of the arguments has changed
        return None


def is_damaged(path: str | Path) -> bool:
    """Return True if a file exists and its content does not match its checksum."""
    try:
        content = memoryview(Path(path).read_bytes())
    except FileNotFoundError:
        return False
    except OSError:
        return True
    return sha256(content[:-32]).digest() != content[-32:]


def damaged_files(folders: Iterable[str | Path]) -> list[Path]:
    """Return the damaged files of the kernel cache in folders."""
    return [path for folder in folders for path in sorted(Path(folder).glob("*.nb[ci]")) if is_damaged(path)]


class KernelCache(FunctionCache):  # type: ignore[misc]
    """Cache of the compiled code of one kernel."""

    storage_required: ClassVar[bool] = False  # True: raise OSError for a kernel that cannot be stored

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = CheckedFiles(
            self._cache_path, self._impl.filename_base, self._impl.locator.get_source_stamp()
        )
        chosen = numba.config.CACHE_DIR
        if chosen and not Path(self._cache_path).is_relative_to(chosen):
            text = "NUMBA_CACHE_DIR: expected a writable folder, got %s; kernels are stored in the default folder"
            _warn_once("folder", text, chosen)

    @property
    def index(self) -> Path:
        """The path of the index file."""
        return Path(self._cache_file._index_path)

    def contains(self, signature: tuple[Any, ...], codegen: Any) -> bool:
        """Return True if the cache contains undamaged code for a signature."""
        return self._enabled and self._cache_file.contains(self._index_key(signature, codegen))

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            self._report(error)

    def flush(self) -> None:
        """Delete the index. On a full disk, numba could not replace it."""
        try:
            self.index.unlink(missing_ok=True)
        except OSError as error:
            self.disable()  # for this process
            self._report(error)

    def _report(self, error: OSError) -> None:
        if self.storage_required:
            raise error
        warn_of_storage(storage_error(self.cache_path, error))


def check_cache_folders(caches: Iterable[Any]) -> None:
    """Raise DataError if a kernel cannot be stored, because its folder is not writable or its disk is full."""
    for folder in {cache.cache_path for cache in caches}:
        if folder is None:
            raise storage_error(None)
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                file.write(bytes(PROBE_BYTES))
        except OSError as error:
            raise storage_error(folder, error) from error


def storage_error(folder: str | None, error: OSError | None = None) -> DataError:
    """Return the error of a folder that cannot store kernels. None = no folder was found."""
    got = f"{folder} ({error.strerror})" if error else "none"
    return DataError(f"kernel cache: expected a writable folder with free space, got {got}; set NUMBA_CACHE_DIR=DIR")


def warn_of_storage(error: DataError) -> None:
    """Log, once per process, that kernels cannot be stored."""
    _warn_once("storage", "%s; the kernels are compiled in memory", error)


def _warn_once(topic: str, text: str, value: object) -> None:
    if topic not in _warned:
        _warned.add(topic)
        log.warning(text, value)
