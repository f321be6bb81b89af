"""Imports and probes in separate processes.

A broken library can end the process that loads it.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from framework.doctor.check_result import anonymous

TIMEOUT_S = 120.0  # s, maximum run time of a process
ROOT = Path(__file__).resolve().parents[2]
ACCELERATION, KERNELS, REPAIR = (
    f"from {__name__} import {name}; {name}()" for name in ("acceleration", "kernels", "repair")
)

Outcomes = Mapping[str, tuple[str, str]]  # last printed line and error ("" = success) by code


def run_all(codes: Iterable[str]) -> Outcomes:
    """Run each piece of Python code in a separate process, and return the outcomes."""
    codes = [*codes]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return dict(zip(codes, pool.map(_run, codes), strict=True))


def _run(code: str) -> tuple[str, str]:
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(":")
    }
    command = [sys.executable, "-P", "-c", code]  # -P: import nothing from the working directory
    try:
        done = subprocess.run(command, env=environment, input="", capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return "", f"not finished within {TIMEOUT_S:g} s"
    if done.returncode == 0:
        return done.stdout.rpartition("\n")[0].rpartition("\n")[2], ""
    message = re.split(r"^\s.*\n", done.stderr, flags=re.MULTILINE)[-1] if done.returncode == 1 else ""
    error = " ".join(message.split()) or f"process ended with status {done.returncode}"
    return "", anonymous(error)[:300]


def acceleration() -> None:
    """Print, as JSON, the GPUs and the CPU support for 8-bit kernels."""
    import torch

    from framework.detection.runtimes.caffe2_network import has_int8_kernels

    gpus = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    names = [f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB" for gpu in gpus]
    print(json.dumps({"gpus": names, "int8": has_int8_kernels()}))


def kernels() -> None:
    """Print, as JSON, the folder and the damaged files of the kernel cache, and the numbers of compiled kernels."""
    from framework.compilation.catalog import DEFAULT, OTHERS, listed

    damaged = _damaged_kernels()
    sections = [listed(DEFAULT), listed(OTHERS)]
    counts = [(sum(kernel.is_compiled() for kernel in section), len(section)) for section in sections]
    folder = sections[0][0].dispatcher._cache.cache_path
    print(json.dumps({"folder": folder, "damaged": [*map(str, damaged)], "counts": counts}))


def repair() -> None:
    """Delete the damaged files of the kernel cache, and print their number."""
    damaged = _damaged_kernels()
    for path in damaged:
        path.unlink()
    print(len(damaged))


def _damaged_kernels() -> list[Path]:
    from framework.compilation.catalog import DEFAULT, OTHERS, listed
    from framework.compilation.kernel_cache import damaged_files

    folders = {kernel.dispatcher._cache.cache_path for kernel in listed(DEFAULT, OTHERS)}
    return damaged_files(sorted(folders - {None}))  # None = no folder is writable
