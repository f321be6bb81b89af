"""Compilation of kernels in advance, in parallel processes and with a progress bar.

numba compiles a kernel at its first call with new argument types, and stores it in its cache. kernels.txt lists the
argument types of each kernel.
"""

from __future__ import annotations

import ast
import logging
import os
import queue
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from inspect import getsource
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from types import CodeType
from typing import Any

from filelock import FileLock, Timeout
from numba import types
from numba.core.dispatcher import Dispatcher

from framework.compilation.kernel_cache import KernelCache, check_cache_folders, warn_of_storage
from framework.errors import DataError
from framework.runtime.process_settings import available_cores
from framework.runtime.progress import Progress

log = logging.getLogger(__name__)

LIST = Path(__file__).with_name("kernels.txt")
CHECKOUT = Path(__file__).resolve().parents[2]
DEFAULT, OTHERS = "# a run with the default stages", "# additional kernels of other stages"
MAX_WORKERS = 4  # maximum number of worker processes; each needs 0.5 GB and compiles shared functions again
SECONDS_EACH = 0.65  # s, compilation time of a kernel on one core (AMD EPYC, Zen 5)


@dataclass(frozen=True)
class Kernel:
    """A kernel with the argument types of one call."""

    module: str
    name: str
    types: str  # argument types, as in kernels.txt

    @property
    def dispatcher(self) -> Any:
        """The numba dispatcher.

        Raises:
            DataError: kernels.txt is older than the code.
        """
        found = getattr(import_module(self.module), self.name, None)
        if not isinstance(found, Dispatcher):
            raise DataError(
                f"{LIST.name}: expected an existing kernel, got {self.module}.{self.name}; run python -m "
                "tests.support.kernel_calls"
            )
        return found

    @property
    def signature(self) -> tuple[Any, ...]:
        return tuple(map(_type_of, ast.parse(f"f({self.types})", mode="eval").body.args))  # type: ignore[attr-defined]

    def is_compiled(self) -> bool:
        """Return True if the cache of numba contains the kernel for the current code."""
        cache = self.dispatcher._cache
        if not isinstance(cache, KernelCache):  # no folder is writable
            return False
        try:
            written = cache.index.stat().st_mtime
        except OSError:
            return False
        # numba checks only the file of the kernel itself, not the files of called kernels
        files = {kernel.py_func.__code__.co_filename for kernel in called_by(self.dispatcher)}
        if any(Path(path).stat().st_mtime > written for path in files):
            cache.flush()
            return False
        return cache.contains(self.signature, self.dispatcher.targetctx.codegen())

    def compile(self) -> None:
        self.dispatcher.compile(self.signature)


def listed(*sections: str) -> list[Kernel]:
    """Return the kernels in sections of kernels.txt (DEFAULT or OTHERS)."""
    found, section = [], ""
    for line in LIST.read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            section = line
        elif line and section in sections:
            place, _, arguments = line.partition("(")
            module, _, name = place.rpartition(".")
            found.append(Kernel(module, name, arguments.removesuffix(")")))
    return found


def line_of(dispatcher: Any, signature: Iterable[Any]) -> str:
    """Return the line of kernels.txt for a kernel and its argument types."""
    function = dispatcher.py_func
    return f"{function.__module__}.{function.__name__}({', '.join(map(_text_of, signature))})"


def compile_for_run() -> None:
    """Compile the listed kernels of all imported modules. Failures are logged as warnings.

    A run calls this function after it builds its stages, and again after it opens its dataset.
    """
    loaded = [kernel for kernel in listed(DEFAULT, OTHERS) if kernel.module in sys.modules]
    missing = [kernel for kernel in loaded if not kernel.is_compiled()]
    if not missing:
        return
    try:
        check_cache_folders(kernel.dispatcher._cache for kernel in missing)
    except DataError as error:
        warn_of_storage(error)
        return
    with _one_process_at_a_time(missing):
        missing = [kernel for kernel in missing if not kernel.is_compiled()]  # another process may have compiled them
        if not missing:
            return
        seconds = SECONDS_EACH * len(missing) / _workers(missing)
        log.info("compiling %d kernels (about %.0f s, once per machine)", len(missing), max(seconds, 2))
        try:
            compile_all(missing)
        except DataError as error:
            log.warning("%s; it is compiled at its first call", error)


def compile_all(kernels: list[Kernel]) -> None:
    """Compile kernels in parallel processes, with a progress bar.

    Raises:
        DataError: A kernel could not be compiled. All other kernels are compiled first.
    """
    in_order = sorted(kernels, key=attrgetter("module"))
    # kernels of a module share functions, so one process compiles all of them
    by_module = {module: list(group) for module, group in groupby(in_order, attrgetter("module"))}
    # modules with the longest source first, because they take longest
    waiting: queue.SimpleQueue[list[Kernel]] = queue.SimpleQueue()
    for module in sorted(by_module, key=lambda name: len(getsource(import_module(name))), reverse=True):
        waiting.put(by_module[module])
    events: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    processes = [_worker() for _ in range(_workers(kernels))]
    threads = [threading.Thread(target=_feed, args=(process, waiting, events), daemon=True) for process in processes]
    try:
        for thread in threads:
            thread.start()
        errors = _watch(len(kernels), threads, events)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    if errors:
        raise DataError(errors[0])


def _workers(kernels: list[Kernel]) -> int:
    return min(MAX_WORKERS, available_cores(), len({kernel.module for kernel in kernels}))


def _worker() -> subprocess.Popen[str]:
    """Start a worker process. It reads one kernel per line, and prints an error or an empty line."""
    path = os.pathsep.join(filter(None, [str(CHECKOUT), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "framework.compilation.worker"],  # -P: import nothing from the working directory
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        start_new_session=os.name == "posix",  # Ctrl-C goes only to the parent
    )


def _feed(
    process: subprocess.Popen[str], waiting: queue.SimpleQueue[list[Kernel]], events: queue.SimpleQueue[tuple[str, str]]
) -> None:
    """Send kernels to a worker, module by module, and report events.

    The events are ("begun", kernel name) and ("done", error message), with an empty message on success.
    """
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(queue.Empty):
        while True:
            for kernel in waiting.get_nowait():
                events.put(("begun", f"{kernel.module.removeprefix('framework.')}.{kernel.name}"))
                try:
                    process.stdin.write(f"{kernel.module}\t{kernel.name}\t{kernel.types}\n")
                    process.stdin.flush()
                    answer = process.stdout.readline()
                except OSError:
                    answer = ""
                error = (
                    answer.strip()
                    if answer
                    else f"{kernel.module}.{kernel.name}: expected a compiled kernel, got a terminated process"
                )
                events.put(("done", error))


def _watch(count: int, threads: list[threading.Thread], events: queue.SimpleQueue[tuple[str, str]]) -> list[str]:
    """Show the progress until all kernels are done, and return the error messages."""
    left = count
    errors: list[str] = []
    with Progress(count, " kernels") as bar:
        while left:
            try:
                event, text = events.get(timeout=1.0)
            except queue.Empty:
                event, text = "", ""
                if not any(thread.is_alive() for thread in threads):
                    raise DataError("kernels: expected running workers, got none; run the command again") from None
            if event == "done":
                left -= 1
                bar.update()
                errors += filter(None, [text])
            elif event == "begun":
                bar.set_description_str(f"{left} left, {text}", refresh=False)
            bar.refresh()
            if bar.line_is_due():
                log.info("%d of %d kernels remaining", left, count)
    return errors


@contextmanager
def _one_process_at_a_time(kernels: list[Kernel]) -> Iterator[None]:
    """Let only one process at a time run the `with` body, because the jobs of a sweep start simultaneously."""
    folder = Path(kernels[0].dispatcher._cache.cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "compiling.lock")
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("another process is compiling kernels; waiting for it")
            lock.acquire()
    except OSError as error:  # without locks, several processes may compile the same kernels
        reason = error.strerror
        log.warning(
            "%s: expected a file system with locks, got an error (%s); compiling without a lock", folder, reason
        )
    try:
        yield
    finally:
        lock.release()


def called_by(dispatcher: Any) -> set[Any]:
    """Return a kernel and all kernels that it calls, directly or indirectly."""
    found: set[Any] = set()
    waiting = [dispatcher]
    while waiting:
        kernel = waiting.pop()
        if kernel not in found:
            found.add(kernel)
            called = map(kernel.py_func.__globals__.get, set(_names(kernel.py_func.__code__)))
            waiting += [value for value in called if isinstance(value, Dispatcher)]
    return found


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _text_of(kind: Any) -> str:
    """Return a numba type as a Python expression."""
    if isinstance(kind, types.Array):
        axes = [":"] * kind.ndim
        if kind.layout == "C":
            axes[-1] = "::1"
        elif kind.layout == "F":
            axes[0] = "::1"
        text = f"{_text_of(kind.dtype)}[{', '.join(axes)}]"
        return text if kind.mutable else f"readonly({text})"
    if isinstance(kind, types.BaseNamedTuple):
        cls = kind.instance_class
        return f"{cls.__module__}.{cls.__qualname__}({', '.join(map(_text_of, kind))})"
    if isinstance(kind, types.BaseTuple):
        return f"({''.join(f'{_text_of(part)}, ' for part in kind).strip()})"
    if isinstance(kind, types.Omitted):
        return f"omitted({kind.value!r})"
    text = "boolean" if kind == types.boolean else str(kind)
    if getattr(types, text, None) != kind:
        raise TypeError(f"{kind}: expected a type of numba.types, got {type(kind).__name__}")
    return text


def _type_of(node: ast.expr) -> Any:
    """Return the numba type of a Python expression from `_text_of`."""
    if isinstance(node, ast.Name):
        return getattr(types, node.id)
    if isinstance(node, ast.Tuple):
        return types.BaseTuple.from_types([_type_of(part) for part in node.elts])
    if isinstance(node, ast.Subscript):
        axes = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        dense = [isinstance(axis, ast.Slice) and axis.step is not None for axis in axes]
        layout = "C" if dense[-1] else "F" if dense[0] else "A"
        return types.Array(_type_of(node.value), len(axes), layout)
    assert isinstance(node, ast.Call)
    called = ast.unparse(node.func)
    if called == "readonly":
        return _type_of(node.args[0]).copy(readonly=True)
    if called == "omitted":
        return types.Omitted(ast.literal_eval(node.args[0]))
    module, _, name = called.rpartition(".")
    return types.BaseTuple.from_types([_type_of(part) for part in node.args], getattr(import_module(module), name))
