"""`instancemap compile`: compile the kernels in advance, once per installation."""

from __future__ import annotations

import argparse
import logging
import sys
import time

from framework.commands.command_line import arguments, one_line_errors
from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, compile_all, listed
from framework.compilation.kernel_cache import check_cache_folders
from framework.errors import ConfigError


def main() -> None:
    """Run the command `instancemap compile`."""
    parser = argparse.ArgumentParser(
        description="Compile the kernels of the default stages in advance. numba caches them for later runs of this "
        "installation. Kernels that are already compiled are skipped."
    )
    part = "part of the names of the kernels to compile, in all stages; default: the kernels of the default stages"
    parser.add_argument("names", metavar="NAME", nargs="*", help=part)
    parser.add_argument("--all", action="store_true", help="compile the kernels of all stages")
    parsed = arguments(parser)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with one_line_errors():
        print(compile_named(listed(DEFAULT, *([OTHERS] if parsed.all or parsed.names else [])), parsed.names))


def compile_named(kernels: list[Kernel], parts: list[str]) -> str:
    """Compile all kernels whose name contains one of the parts, and return a summary.

    Kernels that are already compiled are skipped. Without parts, all kernels are selected.

    Raises:
        ConfigError: No kernel is selected.
        DataError: A kernel cannot be compiled or stored.
    """
    if parts:
        kernels = [kernel for kernel in kernels if any(part in f"{kernel.module}.{kernel.name}" for part in parts)]
    if not kernels:
        raise ConfigError(
            f"NAME: expected part of a kernel name, got {' or '.join(parts)}; omit NAME to compile the kernels of the "
            "default stages"
        )
    missing = [kernel for kernel in kernels if not kernel.is_compiled()]
    if missing:
        check_cache_folders(kernel.dispatcher._cache for kernel in missing)
        started = time.perf_counter()
        compile_all(missing)
        return f"{len(missing)} of {len(kernels)} kernels compiled in {time.perf_counter() - started:.0f} s"
    return f"all {len(kernels)} kernels are already compiled"
