"""`instancemap compile`: compile the kernels in advance, once per installation."""

from __future__ import annotations

import argparse
import logging
import sys
import time

from framework.commands.command_line import arguments, one_line_errors
from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, compile_all, listed
from framework.errors import ConfigError


def main() -> None:
    """Run the command `instancemap compile`."""
    parser = argparse.ArgumentParser(
        description="Compile the kernels of a run with the default stages. numba stores them for later runs of this "
        "installation. Compiled kernels are skipped."
    )
    parser.add_argument("words", metavar="WORD", nargs="*", help="part of a kernel name; default: all kernels")
    parser.add_argument("--all", action="store_true", help="also compile the kernels of other stages")
    parsed = arguments(parser)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with one_line_errors():
        print(compile_named(listed(DEFAULT, *([OTHERS] if parsed.all or parsed.words else [])), parsed.words))


def compile_named(kernels: list[Kernel], words: list[str]) -> str:
    """Compile the missing kernels whose names contain one of the words ([] = all), and return a summary.

    Raises ConfigError if no kernel matches, DataError if a kernel cannot be compiled.
    """
    if words:
        kernels = [kernel for kernel in kernels if any(word in f"{kernel.module}.{kernel.name}" for word in words)]
    if not kernels:
        raise ConfigError(f"kernels: expected part of a name, got {' or '.join(words)}; no name contains it")
    missing = [kernel for kernel in kernels if not kernel.is_compiled()]
    if missing:
        started = time.perf_counter()
        compile_all(missing)
        return f"{len(missing)} of {len(kernels)} kernels compiled in {time.perf_counter() - started:.0f} s"
    return f"all {len(kernels)} kernels are compiled"
