"""The machine: memory, disk, system libraries, and environment variables that change the behavior."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from framework.doctor.check_result import Check, Status, anonymous

MIN_DISK_GB = 2.0  # a run writes 20 to 200 MB, a benchmark of rooms gigabytes
MIN_MEMORY_GIB = 2.0  # the demo takes 1.2
SYSTEM_LIBRARIES = {
    "libGL.so.1": ("libgl1", "Open3D"),
    "libEGL.so.1": ("libegl1", "Open3D"),
    "libgomp.so.1": ("libgomp1", "Open3D"),
    "libusb-1.0.so.0": ("libusb-1.0-0", "Open3D"),
    "libOpenNI2.so.0": ("libopenni2-0", "convert-oni"),
}
"""Debian package and user of each library. Open3D is required."""

PROGRAMS = {"git": "the commit in run directories", "chromium": "tests of HTML pages"}
FOLDER_FIXES = {
    "outputs": "set hydra.run.dir=DIR and hydra.sweep.dir=DIR",
    "cache": "set the environment variable XDG_CACHE_HOME",
    "temporary": "set the environment variable TMPDIR",
}
PREFIXES = ("HF_", "INSTANCEMAP_", "NUMBA_", "OMP_", "TRANSFORMERS_", "CUDA_VISIBLE", "XDG_CACHE", "PYTHONPATH")


def hardware() -> Iterator[Check]:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    yield Check("processor", Status.OK, f"{cores} of {os.cpu_count()} cores, {name}")
    if Path("/proc/meminfo").exists():
        sizes = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines() if ":" in line)
        total, free = (int(sizes[key].split()[0]) / 2**20 for key in ("MemTotal", "MemAvailable"))
        enough = free >= MIN_MEMORY_GIB
        fix = "" if enough else "close other programs, or set fuser.voxel_size=0.02 (one eighth of the map's memory)"
        yield Check("memory", Status.OK if enough else Status.MISSING, f"{free:.1f} of {total:.1f} GiB free", fix)


def disk() -> Iterator[Check]:
    import platformdirs

    cache = platformdirs.user_cache_path("instancemap", appauthor=False)
    for name, folder in (("outputs", Path.cwd()), ("cache", cache), ("temporary", Path(tempfile.gettempdir()))):
        existing = next(path for path in (folder, *folder.parents) if path.exists())
        free = shutil.disk_usage(existing).free / 1e9
        writable = os.access(existing, os.W_OK)
        detail = f"{free:.1f} GB free in {anonymous(str(folder))}" + ("" if writable else ", not writable")
        enough = free >= MIN_DISK_GB and writable
        yield Check(name, Status.OK if enough else Status.MISSING, detail, "" if enough else FOLDER_FIXES[name])


def system_libraries() -> Iterator[Check]:
    if platform.system() != "Linux":
        return
    for file, (package, user) in SYSTEM_LIBRARIES.items():
        try:
            ctypes.CDLL(file)
        except OSError:
            status = Status.ERROR if user == "Open3D" else Status.MISSING
            yield Check(package, status, f"{file} not found, needed by {user}", f"apt-get install {package}")
        else:
            yield Check(package, Status.OK, f"{file}, needed by {user}")


def programs() -> Iterator[Check]:
    for name, user in PROGRAMS.items():
        found = shutil.which(name)
        if found:
            yield Check(name, Status.OK, f"{anonymous(found)}, for {user}")
        else:
            yield Check(name, Status.MISSING, f"not found, for {user}", f"apt-get install {name}")


def environment() -> Iterator[Check]:
    found = {name: value for name, value in sorted(os.environ.items()) if name.startswith(PREFIXES)}
    for name, value in found.items():
        yield Check(name, Status.OK, anonymous(value) or '""')
