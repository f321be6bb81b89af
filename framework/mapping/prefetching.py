"""Asking for memory before it is needed: blocks lie anywhere, which the processor cannot foresee."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from framework.mapping.voxels.voxel_grid_kernels import device

CACHE_LINE = 64  # bytes
_READ, _KEEP, _DATA = 0, 2, 1  # llvm.prefetch: for reading; into the second level of cache and beyond; not code


@intrinsic
def prefetch_line(_typing_context: Any, array: Any, offset: Any) -> Any:
    """Has the cache line loaded that is `offset` bytes after the first element of an array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte, int32 = ir.IntType(8), ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.gep(builder.bitcast(data, byte.as_pointer()), [arguments[1]])
        function_type = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), int32, int32, int32])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0i8")
        builder.call(function, [address, int32(_READ), int32(_KEEP), int32(_DATA)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@device
def prefetch_element(array, row, column):
    """Has array[row, column] loaded while the processor goes on."""
    prefetch_line(array, np.int64(row) * array.strides[0] + np.int64(column) * array.strides[1])


@device
def prefetch_row(array, row):
    """Has array[row] loaded while the processor goes on; a row beyond the array's last is none."""
    if 0 <= row < array.shape[0]:
        bytes_a_row = array.itemsize * (array.size // array.shape[0])
        for line in range(0, bytes_a_row, CACHE_LINE):
            prefetch_line(array, row * bytes_a_row + line)
