"""The map's kernels, compiled ahead of the runs that need them: which there are, what is missing, and by how many.

numba compiles a kernel when it is first called, for the types that it is called with, and keeps it in its cache.
kernels.txt lists those calls, so that they can be compiled before a run, side by side and with a progress bar.
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
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from types import CodeType
from typing import Any

from filelock import FileLock, Timeout
from numba import types
from numba.core.dispatcher import Dispatcher

from framework.errors import DataError
from framework.runtime.process_settings import available_cores
from framework.runtime.progress import Progress

log = logging.getLogger(__name__)

LIST = Path(__file__).with_name("kernels.txt")
CHECKOUT = Path(__file__).resolve().parents[2]
DEFAULT, OTHERS = "# a run with the default stages", "# what other stages add"
MOST_WORKERS = 4  # each compiles anew what kernels share, and takes 0.5 GB
SECONDS_EACH = 0.65  # of a core, an AMD EPYC (Zen 5) with 2 cores: for a guess of how long it takes


@dataclass(frozen=True)
class Kernel:
    """A kernel with the types of one call: `framework.refinement.lifting._count_readings(boolean[:, :, ::1], ...)`."""

    module: str
    name: str
    types: str  # as kernels.txt has them

    @property
    def dispatcher(self) -> Any:
        """Raises DataError where the list is older than the code."""
        found = getattr(import_module(self.module), self.name, None)
        if not isinstance(found, Dispatcher):
            raise DataError(
                f"{LIST.name}: there is no kernel {self.module}.{self.name}; run python -m tests.support.kernel_calls"
            )
        return found

    @property
    def signature(self) -> tuple[Any, ...]:
        return tuple(map(_type_of, ast.parse(f"f({self.types})", mode="eval").body.args))  # type: ignore[attr-defined]

    def is_compiled(self) -> bool:
        """Whether numba's cache has it, and has it since all kernels that it calls were last changed."""
        cache = self.dispatcher._cache
        if not cache._enabled:
            return False
        index = Path(cache._cache_file._index_path)
        if not index.exists():
            return False
        written = index.stat().st_mtime
        files = {kernel.py_func.__code__.co_filename for kernel in called_by(self.dispatcher)}
        if any(Path(path).stat().st_mtime > written for path in files):
            cache.flush()  # numba looks at the kernel's own file alone
            return False
        codegen = self.dispatcher.targetctx.codegen()
        return cache._index_key(self.signature, codegen) in cache._cache_file._load_index()

    def compile(self) -> None:
        self.dispatcher.compile(self.signature)


def listed(*sections: str) -> list[Kernel]:
    """The kernels in those sections of kernels.txt: DEFAULT, OTHERS."""
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
    """A kernel with the types of a call as kernels.txt has it."""
    function = dispatcher.py_func
    return f"{function.__module__}.{function.__name__}({', '.join(map(_text_of, signature))})"


def compile_for_run() -> None:
    """Compiles what the modules that are loaded need, and says so.

    A run calls it when its stages are built, and when its video is. What cannot be compiled ahead is left to numba, and
    told.
    """
    loaded = [kernel for kernel in listed(DEFAULT, OTHERS) if kernel.module in sys.modules]
    missing = [kernel for kernel in loaded if not kernel.is_compiled()]
    if not missing:
        return
    with _one_process_at_a_time(missing):
        missing = [kernel for kernel in missing if not kernel.is_compiled()]  # another process may have been at it
        if not missing:
            return
        seconds = SECONDS_EACH * len(missing) / _workers(missing)
        log.info("compiling %d kernels, about %.0f s, once for this machine", len(missing), max(seconds, 2))
        try:
            compile_all(missing)
        except DataError as error:
            log.warning("%s; it is compiled when it is first called", error)


def compile_all(kernels: list[Kernel]) -> None:
    """Compiles kernels in processes of their own, side by side, with a progress bar.

    Those of one module go to one process, for they share what they call. Raises DataError for the first that cannot be
    compiled, when the others are done.
    """
    in_order = sorted(kernels, key=attrgetter("module"))
    by_module = {module: list(group) for module, group in groupby(in_order, attrgetter("module"))}
    # longest first, so that no process is left alone with a long one; its text tells how long a module takes
    waiting: queue.SimpleQueue[list[Kernel]] = queue.SimpleQueue()
    for module in sorted(by_module, key=_length, reverse=True):
        waiting.put(by_module[module])
    told: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    processes = [_worker() for _ in range(_workers(kernels))]
    threads = [threading.Thread(target=_feed, args=(process, waiting, told), daemon=True) for process in processes]
    faults: list[str] = []
    try:
        for thread in threads:
            thread.start()
        _watch(len(kernels), threads, told, faults)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    if faults:
        raise DataError(faults[0])


def _workers(kernels: list[Kernel]) -> int:
    return min(MOST_WORKERS, available_cores(), len({kernel.module for kernel in kernels}))


def _length(module: str) -> int:
    return Path(str(import_module(module).__file__)).stat().st_size


def _worker() -> subprocess.Popen[str]:
    """A process that compiles the kernels whose lines it is given, and answers each."""
    path = os.pathsep.join(filter(None, [str(CHECKOUT), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "framework.compilation.worker"],  # -P: nothing of the working folder
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
        start_new_session=os.name == "posix",  # Ctrl-C is for who has started it
    )


def _feed(
    process: subprocess.Popen[str], waiting: queue.SimpleQueue[list[Kernel]], told: queue.SimpleQueue[tuple[str, str]]
) -> None:
    """Gives a worker one module's kernels after the other; tells which is begun, and which is done with what fault."""
    assert process.stdin is not None
    assert process.stdout is not None
    while True:
        try:
            kernels = waiting.get_nowait()
        except queue.Empty:
            return
        for kernel in kernels:
            told.put(("begun", f"{kernel.module.removeprefix('framework.')}.{kernel.name}"))
            try:
                process.stdin.write(f"{kernel.module}\t{kernel.name}\t{kernel.types}\n")
                process.stdin.flush()
                answer = process.stdout.readline()
            except OSError:
                answer = ""
            told.put(("done", answer.strip() if answer else f"{kernel.module}.{kernel.name}: its process has ended"))


def _watch(
    count: int, threads: list[threading.Thread], told: queue.SimpleQueue[tuple[str, str]], faults: list[str]
) -> None:
    """Shows how many kernels are left until all are done: a bar, or a line every few seconds where there is none."""
    left = count
    with Progress(count, " kernels") as bar:
        while left:
            try:
                event, text = told.get(timeout=1.0)
            except queue.Empty:
                event, text = "", ""
                if not any(thread.is_alive() for thread in threads):
                    raise DataError("the processes that compile kernels have ended") from None
            if event == "done":
                left -= 1
                bar.update()
                faults += filter(None, [text])
            elif event == "begun":
                bar.set_description_str(f"{left} left, {text}", refresh=False)
            bar.refresh()
            if bar.line_is_due():
                log.info("%d of %d kernels are left", left, count)


@contextmanager
def _one_process_at_a_time(kernels: list[Kernel]) -> Iterator[None]:
    """The jobs of a sweep start together: one compiles, and the others wait for what it has made."""
    folder = Path(kernels[0].dispatcher._cache.cache_path)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / "compiling.lock")
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            log.info("another process compiles kernels: waiting for it")
            lock.acquire()
    except OSError as error:  # a file system without locks: several may do the same work
        log.warning("%s cannot be locked (%s)", folder, error.strerror)
    try:
        yield
    finally:
        lock.release()


def called_by(dispatcher: Any) -> set[Any]:
    """A kernel and all kernels that it calls, directly or not."""
    found: set[Any] = set()
    waiting = [dispatcher]
    while waiting:
        kernel = waiting.pop()
        if kernel not in found:
            found.add(kernel)
            scope = kernel.py_func.__globals__
            called = (scope.get(name) for name in set(_names(kernel.py_func.__code__)))
            waiting += [value for value in called if isinstance(value, Dispatcher)]
    return found


def _names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _text_of(kind: Any) -> str:
    """A type of numba's as Python would write it; _type_of() reads it."""
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
        raise TypeError(f"no way is known to write down the type {kind}")
    return text


def _type_of(node: ast.expr) -> Any:
    """The type of numba's that _text_of() has written."""
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
