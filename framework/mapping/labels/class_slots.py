"""Operations on the class slots of a voxel.

In compact storage, a voxel has sixteen class slots, which fit into one SIMD vector. Because LLVM does not vectorize
such short loops, the intrinsics in this module emit vector instructions. Exact storage uses ordinary loops with the
same results.

In voxels, class ids begin at 1 and 0 is a free slot, as for instance ids: id k is column k - 1 of class probabilities.
The ids of a vocabulary of at most 255 classes take one byte, larger ones take two.

A quantized score is the evidence times a scale, rounded to an integer. An array of cluster scores (C + 1,) is indexed
by class id. It contains the quantized score, shifted left by NEW_CLASSES bits. Bit m is set for the m-th named class of
the cluster. The entry of free slots is 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from framework.mapping.voxels.voxel_grid_kernels import device

CLASS_SLOTS = 16  # number of class slots of a voxel in compact storage
NO_CLASS = 0  # class id of a free slot; slots are filled from the front
NEW_CLASSES = 8  # maximum number of named classes of a cluster; only these can be added to the slots of a voxel
ALL_NAMED = (1 << NEW_CLASSES) - 1  # bits of all named classes

ClassIds = npt.NDArray[np.unsignedinteger[Any]]  # of the type of class_id_type()
_OPTIONS = {"forceinline": True, "error_model": "numpy", "_nrt": False}  # the options of `device`


def class_id_type(classes: int) -> type[np.unsignedinteger[Any]]:
    """Return the type of the class ids in the voxels of a map with the given number of classes."""
    return np.uint8 if classes <= np.iinfo(np.uint8).max else np.uint16


@device
def add_scores(classes, scores, cluster_scores, limit):
    """Add the scores of a cluster to the class slots of a voxel.

    Returns the bits of the named classes that have a slot, the number of used slots, and the excess of the largest
    score over `limit`.

    Args:
        classes: The classes (T,) in the slots.
        scores: The scores (T,) of the slots, modified in place. They are at least -limit.
        cluster_scores: The packed scores (C + 1,) of the cluster, indexed by class id.
        limit: The maximum score.
    """
    return _add_scores(classes, scores, cluster_scores, limit)


@device
def most_likely_slot(classes, scores):
    """Return the slot with the highest score.

    Ties go to the smaller class id.
    """
    return _most_likely_slot(classes, scores)


@device
def least_likely_slot(scores):
    """Return the slot with the lowest score.

    Ties go to the first slot.
    """
    return _least_likely_slot(scores)


def _add_scores(classes, scores, cluster_scores, limit):
    known = filled = 0
    largest = -limit
    for s in range(len(classes)):
        packed = cluster_scores[classes[s]]
        scores[s] = max(scores[s] + (packed >> NEW_CLASSES), -limit)
        largest = max(largest, scores[s])
        known |= packed & ALL_NAMED
        filled += classes[s] != NO_CLASS
    return known, filled, largest - limit


def _most_likely_slot(classes, scores):
    best = 0
    for s in range(1, len(classes)):
        if classes[s] == NO_CLASS:
            break
        if scores[s] > scores[best] or (scores[s] == scores[best] and classes[s] < classes[best]):
            best = s
    return best


def _least_likely_slot(scores):
    least = 0
    for s in range(1, len(scores)):
        least = s if scores[s] < scores[least] else least
    return least


_BIT, _INT16, _INT32 = (ir.IntType(bits) for bits in (1, 16, 32))


def _vector(number: Any) -> Any:
    return ir.VectorType(number, CLASS_SLOTS)


def _all(value: int, number: Any) -> Any:
    return ir.Constant(_vector(number), CLASS_SLOTS * [value])


class _Slots:
    """Emitter of LLVM vector instructions on class slots."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.context = context
        self.builder = builder

    def address(self, array_type: Any, array: Any) -> Any:
        """Return the data pointer of a contiguous array."""
        return self.context.make_array(array_type)(self.context, self.builder, array).data

    def load(self, address: Any) -> Any:
        loaded = self.builder.load(self.builder.bitcast(address, _vector(address.type.pointee).as_pointer()))
        loaded.align = 1
        return loaded

    def store(self, vector: Any, address: Any) -> None:
        stored = self.builder.store(vector, self.builder.bitcast(address, vector.type.as_pointer()))
        stored.align = 1

    def gather(self, table: Any, indices: Any) -> Any:
        """Return the table entries selected by the unsigned indices stored at address `indices`."""
        found = ir.Constant(_vector(table.type.pointee), ir.Undefined)
        for s in range(CLASS_SLOTS):
            index = self.builder.zext(self.builder.load(self.builder.gep(indices, [_INT32(s)])), _INT32)
            found = self.builder.insert_element(found, self.builder.load(self.builder.gep(table, [index])), _INT32(s))
        return found

    def repeat(self, number: Any) -> Any:
        undefined = ir.Constant(_vector(number.type), ir.Undefined)
        single = self.builder.insert_element(undefined, number, _INT32(0))
        return self.builder.shuffle_vector(single, undefined, _all(0, _INT32))

    def bits(self, conditions: Any) -> Any:
        """Return the conditions as an integer with one bit per slot."""
        return self.builder.bitcast(conditions, ir.IntType(CLASS_SLOTS))

    def call(self, name: str, *arguments: Any, of: str = "i16") -> Any:
        result = _INT32 if of.endswith("i32") else _INT16
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.{of}")
        return self.builder.call(function, arguments)

    def reduce(self, name: str, vector: Any) -> Any:
        return self.call(f"vector.reduce.{name}", vector, of=f"v{CLASS_SLOTS}i32")


@intrinsic
def _add_scores_to_vector(_context: Any, classes: Any, scores: Any, cluster_scores: Any, limit: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        ids, old, table = map(slots.address, signature.args[:3], arguments[:3])
        lowest = builder.neg(builder.trunc(arguments[3], _INT32))
        packed = slots.gather(table, ids)
        added = builder.ashr(packed, _all(NEW_CLASSES, _INT32))
        total, floor = builder.add(builder.sext(slots.load(old), _vector(_INT32)), added), slots.repeat(lowest)
        new = builder.select(builder.icmp_signed(">", total, floor), total, floor)
        slots.store(builder.trunc(new, _vector(_INT16)), old)
        known = builder.and_(slots.reduce("or", packed), _INT32(ALL_NAMED))
        named = slots.bits(builder.icmp_unsigned("!=", slots.load(ids), _all(NO_CLASS, ids.type.pointee)))
        filled = builder.zext(slots.call("ctpop", named), _INT32)
        excess = builder.add(slots.reduce("smax", new), lowest)
        return context.make_tuple(builder, signature.return_type, [known, filled, excess])

    return types.UniTuple(types.int32, 3)(classes, scores, cluster_scores, types.int64), generate


@intrinsic
def _most_likely_of_vector(_context: Any, classes: Any, scores: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        ids, values = (slots.load(slots.address(*pair)) for pair in zip(signature.args, arguments, strict=True))
        above = builder.shl(builder.sext(values, _vector(_INT32)), _all(ids.type.element.width, _INT32))
        rank = builder.sub(above, builder.zext(ids, _vector(_INT32)))
        free = builder.icmp_unsigned("==", ids, _all(NO_CLASS, ids.type.element))
        rank = builder.select(free, _all(-(2**31), _INT32), rank)
        best = builder.icmp_signed("==", rank, slots.repeat(slots.reduce("smax", rank)))
        return builder.zext(slots.call("cttz", slots.bits(best), _BIT(1)), _INT32)

    return types.int32(classes, scores), generate


@intrinsic
def _least_likely_of_vector(_context: Any, scores: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        values = builder.sext(slots.load(slots.address(signature.args[0], arguments[0])), _vector(_INT32))
        index = ir.Constant(_vector(_INT32), list(range(CLASS_SLOTS)))
        rank = builder.add(builder.mul(values, _all(CLASS_SLOTS, _INT32)), index)
        return builder.and_(slots.reduce("smin", rank), _INT32(CLASS_SLOTS - 1))

    return types.int32(scores), generate


def _are_compact(*arrays: Any) -> bool:
    """Return True if the arrays have the types of compact storage."""
    kinds = ((types.uint8, types.uint16), (types.int16,), (types.int32,))
    return all(array.dtype in kind for array, kind in zip(arrays, kinds, strict=False))


@overload(_add_scores, jit_options=_OPTIONS)
def _typed_add_scores(classes, scores, cluster_scores, limit):
    if _are_compact(classes, scores, cluster_scores):
        return lambda classes, scores, cluster_scores, limit: _add_scores_to_vector(
            classes, scores, cluster_scores, limit
        )
    return _add_scores


@overload(_most_likely_slot, jit_options=_OPTIONS)
def _typed_most_likely_slot(classes, scores):
    if _are_compact(classes, scores):
        return lambda classes, scores: _most_likely_of_vector(classes, scores)
    return _most_likely_slot


@overload(_least_likely_slot, jit_options=_OPTIONS)
def _typed_least_likely_slot(scores):
    if scores.dtype == types.int16:
        return lambda scores: _least_likely_of_vector(scores)
    return _least_likely_slot
