"""`python -m framework compile`: compiles the map's kernels, so that the first run does not have to."""

from __future__ import annotations

import argparse
import logging
import sys
import time

from framework.commands.command_line import arguments, one_line_errors
from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, compile_all, listed
from framework.errors import ConfigError


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Compiles the kernels that a run with the default stages calls; numba keeps them for all later runs"
        " of this machine and this installation. What is compiled already is left as it is.",
    )
    parser.add_argument("words", metavar="WORD", nargs="*", help="only kernels with one of these in their names")
    parser.add_argument("--all", action="store_true", help="also those that only the other stages call")
    asked = arguments(parser)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with one_line_errors():
        print(compile_named(listed(DEFAULT, *([OTHERS] if asked.all or asked.words else [])), asked.words))


def compile_named(kernels: list[Kernel], words: list[str]) -> str:
    """Compiles what is missing of those kernels, or of those with a word in their names, and says what it did.

    Raises ConfigError where there is none, DataError where one cannot be compiled.
    """
    if words:
        kernels = [kernel for kernel in kernels if any(word in f"{kernel.module}.{kernel.name}" for word in words)]
    if not kernels:
        raise ConfigError(f"there is no kernel with {' or '.join(words)} in its name")
    missing = [kernel for kernel in kernels if not kernel.is_compiled()]
    if missing:
        started = time.perf_counter()
        compile_all(missing)
        return f"{len(missing)} of {len(kernels)} kernels compiled in {time.perf_counter() - started:.0f} s"
    return f"all {len(kernels)} kernels are compiled"
