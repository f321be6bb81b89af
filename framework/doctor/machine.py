"""Checks of the machine: memory, disk, system libraries and environment variables."""

from __future__ import annotations

import ctypes
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from framework.doctor.check_result import Check, Status, anonymous
from framework.runtime.environment_checks import environment_errors

MIN_DISK_GB = 2.0  # minimum free disk space; a run writes 20 to 200 MB, a synthetic benchmark several GB
MIN_MEMORY_GIB = 2.0  # minimum available memory; the demo requires 1.2 GiB
SYSTEM_LIBRARIES = {
    "libGL.so.1": ("libgl1", "Open3D"),
    "libEGL.so.1": ("libegl1", "Open3D"),
    "libgomp.so.1": ("libgomp1", "Open3D"),
    "libusb-1.0.so.0": ("libusb-1.0-0", "Open3D"),
    "libOpenNI2.so.0": ("libopenni2-0", "convert-oni"),
}
"""Debian package of each library, and the component that requires it. Open3D is required by every run."""

PREFIXES = ("HF_", "INSTANCEMAP_", "NUMBA_", "OMP_", "TRANSFORMERS_", "CUDA_VISIBLE", "XDG_CACHE", "PYTHONPATH")
"""Prefixes of the names of the listed environment variables."""

SECRET = re.compile("KEY|PASS|SECRET|TOKEN")  # in names of environment variables whose values are not printed


def hardware() -> Iterator[Check]:
    """Report the processor, and check the available memory."""
    from framework.runs.provenance import processor
    from framework.runtime.process_settings import available_cores

    yield Check("processor", Status.OK, f"{available_cores()} of {os.cpu_count()} cores, {processor()}")
    if Path("/proc/meminfo").exists():
        sizes = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines() if ":" in line)
        total, free = (int(sizes[key].split()[0]) / 2**20 for key in ("MemTotal", "MemAvailable"))
        fix = "close other programs, or set fuser.voxel_size=0.02 (a quarter of the map's memory)"
        yield Check.of("memory", free >= MIN_MEMORY_GIB, f"{free:.1f} of {total:.1f} GiB free", fix)


def disk() -> Iterator[Check]:
    """Check the folders for outputs, caches and temporary files.

    They must be writable and have enough free space.
    """
    import platformdirs

    for name, folder, fix in (
        ("outputs", Path.cwd(), "set hydra.run.dir=DIR and hydra.sweep.dir=DIR"),
        ("cache", platformdirs.user_cache_path("instancemap", appauthor=False), "set XDG_CACHE_HOME=DIR"),
        ("temporary", Path(tempfile.gettempdir()), "set TMPDIR=DIR"),
    ):
        existing, writable = writable_parent(folder)
        free = shutil.disk_usage(existing).free / 1e9
        detail = f"{free:.1f} GB free in {anonymous(folder)}" + ("" if writable else ", not writable")
        yield Check.of(name, free >= MIN_DISK_GB and writable, detail, fix)


def writable_parent(folder: Path) -> tuple[Path, bool]:
    """Return a folder or its nearest existing parent, and True if it is writable."""
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    return existing, os.access(existing, os.W_OK)


def system_libraries() -> Iterator[Check]:
    """Check on Linux that the system libraries can be loaded."""
    for file, (package, user) in SYSTEM_LIBRARIES.items() if platform.system() == "Linux" else ():
        try:
            found = bool(ctypes.CDLL(file))
        except OSError:
            found = False
        detail = f"{file}{'' if found else ' not found'}, needed by {user}"
        yield Check.of(package, found, detail, f"apt-get install {package}", required=user == "Open3D")


def environment() -> Iterator[Check]:
    """List the environment variables that affect runs, and check those of numba."""
    errors = {error.partition(":")[0]: error for error in environment_errors()}
    for name in sorted(name for name in os.environ if name.startswith(PREFIXES)):
        _, _, error = errors.get(name, "").partition(": ")
        detail, _, fix = error.partition("; ")
        given = anonymous(os.environ[name]) or '""'
        value = "set" if SECRET.search(name) and os.environ[name] else given
        yield Check.of(name, not error, detail or value, fix, required=True)
