"""Worker process that compiles kernels without running them.

numba generates machine code and wrappers for each function that a kernel calls, although the kernel contains a copy of
the function. This process skips that step. It saves a third of the time and results in the same cache.

numba also optimizes each function twice, separately and as part of each caller. This process optimizes most functions
only as part of a kernel, which saves another fifth of the time. The kernels are equally fast. Functions with forced
inlining are still optimized separately, because otherwise their loops are not vectorized.
"""

from __future__ import annotations

import gc
import logging
import sys
from typing import Any

import numba
from numba.core.caching import NullCache

from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, called_by, listed
from framework.compilation.kernel_cache import KernelCache

TESTED = ("0.68.1",)
"""Versions of numba whose internals this process replaces. With other versions, compilation takes 1.4 times as long."""


def work() -> None:
    """Read one kernel per line from stdin, compile it, and print an error or an empty line."""
    logging.disable()  # the main process reports problems of the cache
    KernelCache.storage_required = True
    gc.freeze()  # numba's many permanent objects slow down garbage collection
    gc.set_threshold(200_000, 20, 20)
    wanted = {(kernel.module, kernel.name) for kernel in listed(DEFAULT, OTHERS)}
    names = {name for _, name in wanted}
    optimized = set(names)
    if numba.__version__ in TESTED:
        make_code_only_for(names)
        optimize_fully(optimized)
    for line in sys.stdin:
        kernel = Kernel(*line.rstrip("\n").split("\t"))
        wanted.add((kernel.module, kernel.name))
        names.add(kernel.name)
        optimized.add(kernel.name)
        try:
            for dispatcher in called_by(kernel.dispatcher):
                function = dispatcher.py_func
                if dispatcher.targetoptions.get("forceinline"):
                    optimized.add(function.__name__)
                dispatcher.targetoptions["no_cfunc_wrapper"] = True
                if (function.__module__, function.__name__) not in wanted:
                    dispatcher.targetoptions["no_cpython_wrapper"] = True
                    dispatcher._cache = NullCache()
            kernel.compile()
        except Exception as error:
            name = f"{kernel.module}.{kernel.name}"
            reason = f"{name}: expected a compiled kernel, got {type(error).__name__}: {error}"
            print(reason.splitlines()[0], flush=True)
        else:
            print(flush=True)


def make_code_only_for(names: set[str]) -> None:
    """Make numba generate machine code only for functions with the given names.

    The code of such a function includes all functions that it calls.
    """
    from numba.core.codegen import CPUCodeLibrary, JITCPUCodegen
    from numba.core.registry import cpu_target

    cpu_target.target_context.refresh()  # compile numba's own runtime before the methods are replaced
    finalize, set_env = CPUCodeLibrary._finalize_final_module, JITCPUCodegen.set_env

    def finalize_without_code(library: Any) -> None:
        if library.name in names:
            finalize(library)
            return
        library._finalize_dynamic_globals()
        library._verify_declare_only_symbols()
        library._finalized = True

    def set_env_of_code(codegen: Any, name: str, env: Any) -> None:
        if codegen._engine.get_global_value_address(name):
            set_env(codegen, name, env)

    CPUCodeLibrary._finalize_final_module = finalize_without_code
    JITCPUCodegen.set_env = set_env_of_code


def optimize_fully(names: set[str]) -> None:
    """Make numba optimize only functions with the given names.

    For all other functions, numba only removes reference counts.
    """
    from numba.core.codegen import CPUCodeLibrary

    optimize = CPUCodeLibrary._optimize_final_module

    def optimize_as_part(library: Any) -> None:
        if library.name in names:
            optimize(library)
            return
        # numba's own first step, before it removes reference counts
        passes, builder = library._codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=0, cost="cheap"
        )
        passes.run(library._final_module, builder)

    CPUCodeLibrary._optimize_final_module = optimize_as_part


if __name__ == "__main__":
    work()
