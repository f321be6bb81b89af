"""The process that compiles kernels for others. It runs none of them, and leaves out what only running them needs.

numba makes machine code, and ways in from Python and C, of each function that a kernel calls, though a copy of it is
part of the kernel's own code; that takes a third of the time. What ends up in the cache is the same without.

numba also optimizes each such copy as if it were called by itself, and once more as a part of each that it is copied
into. Here most are optimized as parts of a kernel alone. It takes another fifth of the time, and the kernels are no
slower: loops whose callers are known are unrolled and vectorized better. What is inlined by force is optimized before,
as its loops over a batch or a row are vectorized only while they stand alone.
"""

from __future__ import annotations

import gc
import sys
from typing import Any

import numba
from numba.core.caching import NullCache

from framework.compilation.catalog import DEFAULT, OTHERS, Kernel, called_by, listed

TESTED = ("0.68.1",)
"""Versions of numba whose internals this process replaces. With other versions, compiling takes 1.4 times the time."""


def work() -> None:
    """Reads one kernel a line, compiles it, writes a line, until there are no more."""
    gc.freeze()  # numba makes many objects that stay: looking through them again and again takes a tenth of the time
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
            reason = f"{kernel.module}.{kernel.name} cannot be compiled: {type(error).__name__}: {error}"
            print(reason.splitlines()[0], flush=True)
        else:
            print(flush=True)


def make_code_only_for(names: set[str]) -> None:
    """Has numba make machine code only of functions with these names; others are there to be parts of them."""
    from numba.core.codegen import CPUCodeLibrary, JITCPUCodegen
    from numba.core.registry import cpu_target

    cpu_target.target_context.refresh()  # numba's own runtime, which is needed as it is
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
    """Has numba optimize only functions with these names; of others, it takes out counts of references, and is ready
    to copy them into their callers.
    """
    from numba.core.codegen import CPUCodeLibrary

    optimize = CPUCodeLibrary._optimize_final_module

    def optimize_as_part(library: Any) -> None:
        if library.name in names:
            optimize(library)
            return
        # numba's own first step, before it takes out counts
        passes, builder = library._codegen._module_pass_manager(
            loop_vectorize=False, slp_vectorize=False, opt=0, cost="cheap"
        )
        passes.run(library._final_module, builder)

    CPUCodeLibrary._optimize_final_module = optimize_as_part


if __name__ == "__main__":
    work()
