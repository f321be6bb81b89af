"""The machine: processor, memory, disk, the libraries of the system, and what the environment says."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from framework.doctor.check_result import Finding, State, anonymous

LITTLE_ROOM = 2.0  # GB; a run leaves 20 to 200 MB, a benchmark of rooms gigabytes
LITTLE_MEMORY = 2.0  # GiB; a run of the demo takes 1.2


@dataclass(frozen=True)
class SystemLibrary:
    """A library or a program that comes with the system, not with pip."""

    file: str  # by which it is loaded, or the program's name
    package: str  # of Debian and Ubuntu
    what_for: str
    needed: bool = False  # by the default stages


SYSTEM_LIBRARIES = (
    SystemLibrary("libGL.so.1", "libgl1", "Open3D", needed=True),
    SystemLibrary("libEGL.so.1", "libegl1", "Open3D", needed=True),
    SystemLibrary("libgomp.so.1", "libgomp1", "Open3D", needed=True),
    SystemLibrary("libusb-1.0.so.0", "libusb-1.0-0", "Open3D", needed=True),
    SystemLibrary("libOpenNI2.so.0", "libopenni2-0", "convert-oni"),
)
PROGRAMS = (
    SystemLibrary("git", "git", "the commit in run records"),
    SystemLibrary("chromium", "chromium", "tests that look at pages"),
)
VARIABLES = (
    "HF_HUB_OFFLINE",
    "INSTANCEMAP_OFFLINE",
    "TRANSFORMERS_OFFLINE",
    "HF_HOME",
    "HF_HUB_CACHE",
    "XDG_CACHE_HOME",
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "CUDA_VISIBLE_DEVICES",
    "PYTHONPATH",
)


def processor() -> Iterator[Finding]:
    """The cores that this process may use, of what kind."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    detail = f"{cores} of {os.cpu_count()} cores, {names[0] if names else platform.processor() or platform.machine()}"
    yield Finding("processor", State.THERE, detail)


def memory() -> Iterator[Finding]:
    """In Linux, where it can be read."""
    path = Path("/proc/meminfo")
    if not path.exists():
        return
    sizes = dict(line.split(":") for line in path.read_text().splitlines() if ":" in line)
    total, free = (int(sizes[key].split()[0]) / 2**20 for key in ("MemTotal", "MemAvailable"))
    short = free < LITTLE_MEMORY
    remedy = "end other programs; fuser.voxel_size=0.02 takes an eighth of the map's memory" if short else ""
    yield Finding("memory", State.OPTIONAL if short else State.THERE, f"{free:.1f} of {total:.1f} GiB free", remedy)


def disk() -> Iterator[Finding]:
    """Where runs, downloads and temporary files go."""
    import platformdirs

    cache = platformdirs.user_cache_path("instancemap", appauthor=False)
    for name, folder in (("outputs", Path.cwd()), ("cache", cache), ("temporary", Path(tempfile.gettempdir()))):
        there = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(there).free / 1e9
        writable = os.access(there, os.W_OK)
        detail = f"{free:.1f} GB free in {anonymous(str(folder))}" + ("" if writable else ", which cannot be written")
        fine = free >= LITTLE_ROOM and writable
        yield Finding(name, State.THERE if fine else State.OPTIONAL, detail, "" if fine else REMEDIES[name])


REMEDIES = {
    "outputs": "hydra.run.dir=DIR, hydra.sweep.dir=DIR: runs go to another place",
    "cache": "XDG_CACHE_HOME=DIR: the cache is in another place",
    "temporary": "TMPDIR=DIR: temporary files go to another place",
}


def system_libraries() -> Iterator[Finding]:
    """Those that libraries of pip's load; looked for as these do."""
    if os.name != "posix" or platform.system() != "Linux":
        return
    for library in SYSTEM_LIBRARIES:
        try:
            ctypes.CDLL(library.file)
        except OSError:
            yield _missing(library)
        else:
            yield Finding(library.package, State.THERE, f"{library.file}, for {library.what_for}")


def programs() -> Iterator[Finding]:
    for program in PROGRAMS:
        found = shutil.which(program.file)
        there = Finding(program.package, State.THERE, f"{anonymous(str(found))}, for {program.what_for}")
        yield there if found else _missing(program)


def _missing(library: SystemLibrary) -> Finding:
    state = State.BROKEN if library.needed else State.OPTIONAL
    detail = f"{library.file} is missing, for {library.what_for}"
    return Finding(library.package, state, detail, f"apt-get install {library.package}")


def variables() -> Iterator[Finding]:
    """Those of the environment that change what is done; only the ones that are set."""
    found = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    for name, value in found.items():
        yield Finding(name, State.THERE, anonymous(value) or '""')
    if not found:
        yield Finding("none is set", State.THERE, f"of {', '.join(VARIABLES[:2])} and others")
