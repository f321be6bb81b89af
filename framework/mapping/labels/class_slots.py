"""What is done to all class slots of a voxel at once.

The sixteen of compact storage are one vector. LLVM unrolls so short a loop before it could make vectors of it, so the
vectors are written out, in LLVM's own terms, which are the same for any little-endian processor. Exact storage has
other types and more slots, and is done by loops, which say the same.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from framework.mapping.voxels.voxel_grid_kernels import device

CLASS_SLOTS = 16  # of a voxel in compact storage
NO_CLASS = 255  # in a free slot; slots are filled from the front
NEW_CLASSES = 8  # a detection can bring its best so many classes into a voxel's slots
ALL_NAMED = (1 << NEW_CLASSES) - 1

_OPTIONS = {"forceinline": True, "error_model": "numpy", "_nrt": False}  # as those of `device`


@device
def add_said(classes, units, said_by, most):
    """Adds to the `units` (T,) of a voxel's `classes` (T,) what is said of each, said_by (NO_CLASS + 1,) as by
    class_said(); they stay at -most or above.

    Returns (the bits of what is said of all of them, how many slots are filled, by how much the most units are above
    `most`).
    """
    return _add_said(classes, units, said_by, most)


@device
def likeliest_slot(classes, units):
    """The slot of the class with the most units; a tie goes to the smaller class."""
    return _likeliest_slot(classes, units)


@device
def least_likely_slot(units):
    """The first of the slots with the fewest units."""
    return _least_likely_slot(units)


def _add_said(classes, units, said_by, most):
    known = filled = 0
    largest = -most
    for s in range(len(classes)):
        said = said_by[classes[s]]
        units[s] = max(units[s] + (said >> NEW_CLASSES), -most)
        largest = max(largest, units[s])
        known |= said & ALL_NAMED
        filled += classes[s] != NO_CLASS
    return known, filled, largest - most


def _likeliest_slot(classes, units):
    best = 0
    for s in range(1, len(classes)):
        if classes[s] == NO_CLASS:
            break
        if units[s] > units[best] or (units[s] == units[best] and classes[s] < classes[best]):
            best = s
    return best


def _least_likely_slot(units):
    least = 0
    for s in range(1, len(units)):
        least = s if units[s] < units[least] else least
    return least


_BIT, _BYTE, _INT16, _INT32 = (ir.IntType(bits) for bits in (1, 8, 16, 32))


def _vector(number: Any) -> Any:
    return ir.VectorType(number, CLASS_SLOTS)


def _all(value: int, number: Any) -> Any:
    return ir.Constant(_vector(number), CLASS_SLOTS * [value])


class _Slots:
    """Writes LLVM's instructions for vectors of CLASS_SLOTS numbers: `context` and `builder` are an intrinsic's."""

    def __init__(self, context: Any, builder: Any) -> None:
        self.context = context
        self.builder = builder

    def address(self, array_type: Any, array: Any) -> Any:
        """Where the numbers of an array lie, one behind the other."""
        return self.context.make_array(array_type)(self.context, self.builder, array).data

    def load(self, address: Any) -> Any:
        number = address.type.pointee
        loaded = self.builder.load(self.builder.bitcast(address, _vector(number).as_pointer()))
        loaded.align = 1
        return loaded

    def store(self, vector: Any, address: Any) -> None:
        stored = self.builder.store(vector, self.builder.bitcast(address, vector.type.as_pointer()))
        stored.align = 1

    def look_up(self, table: Any, places: Any) -> Any:
        """The numbers at the bytes `places` of a table."""
        found = ir.Constant(_vector(table.type.pointee), ir.Undefined)
        for s in range(CLASS_SLOTS):
            place = self.builder.zext(self.builder.load(self.builder.gep(places, [_INT32(s)])), _INT32)
            found = self.builder.insert_element(found, self.builder.load(self.builder.gep(table, [place])), _INT32(s))
        return found

    def repeat(self, number: Any) -> Any:
        nothing = ir.Constant(_vector(number.type), ir.Undefined)
        first = self.builder.insert_element(nothing, number, _INT32(0))
        return self.builder.shuffle_vector(first, nothing, _all(0, _INT32))

    def larger(self, a: Any, b: Any) -> Any:
        return self.builder.select(self.builder.icmp_signed(">", a, b), a, b)

    def bits(self, conditions: Any) -> Any:
        """A bit for each slot."""
        return self.builder.bitcast(conditions, ir.IntType(CLASS_SLOTS))

    def call(self, name: str, *arguments: Any, of: str = "i16") -> Any:
        """One of LLVM's functions."""
        result = _INT32 if of.endswith("i32") else _INT16
        kind = ir.FunctionType(result, [argument.type for argument in arguments])
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.{of}")
        return self.builder.call(function, arguments)

    def reduce(self, name: str, vector: Any) -> Any:
        return self.call(f"vector.reduce.{name}", vector, of=f"v{CLASS_SLOTS}i32")


@intrinsic
def _add_said_to_vector(_context: Any, classes: Any, units: Any, said_by: Any, most: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        ids, old, table = map(slots.address, signature.args[:3], arguments[:3])
        least = builder.neg(builder.trunc(arguments[3], _INT32))
        said = slots.look_up(table, ids)
        gain = builder.ashr(said, _all(NEW_CLASSES, _INT32))
        new = slots.larger(builder.add(builder.sext(slots.load(old), _vector(_INT32)), gain), slots.repeat(least))
        slots.store(builder.trunc(new, _vector(_INT16)), old)
        known = builder.and_(slots.reduce("or", said), _INT32(ALL_NAMED))
        named = slots.bits(builder.icmp_unsigned("!=", slots.load(ids), _all(NO_CLASS, _BYTE)))
        filled = builder.zext(slots.call("ctpop", named), _INT32)
        too_much = builder.add(slots.reduce("smax", new), least)
        return context.make_tuple(builder, signature.return_type, [known, filled, too_much])

    return types.UniTuple(types.int32, 3)(classes, units, said_by, types.int64), generate


@intrinsic
def _likeliest_of_vector(_context: Any, classes: Any, units: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        ids, values = (slots.load(slots.address(*pair)) for pair in zip(signature.args, arguments, strict=True))
        above = builder.mul(builder.sext(values, _vector(_INT32)), _all(NO_CLASS + 1, _INT32))
        rank = builder.sub(above, builder.zext(ids, _vector(_INT32)))
        free = builder.icmp_unsigned("==", ids, _all(NO_CLASS, _BYTE))
        rank = builder.select(free, _all(-(2**31), _INT32), rank)
        best = builder.icmp_signed("==", rank, slots.repeat(slots.reduce("smax", rank)))
        return builder.zext(slots.call("cttz", slots.bits(best), _BIT(1)), _INT32)

    return types.int32(classes, units), generate


@intrinsic
def _least_likely_of_vector(_context: Any, units: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        slots = _Slots(context, builder)
        values = builder.sext(slots.load(slots.address(signature.args[0], arguments[0])), _vector(_INT32))
        place = ir.Constant(_vector(_INT32), list(range(CLASS_SLOTS)))
        rank = builder.add(builder.mul(values, _all(CLASS_SLOTS, _INT32)), place)
        return builder.and_(slots.reduce("smin", rank), _INT32(CLASS_SLOTS - 1))

    return types.int32(units), generate


def _are_compact(*arrays: Any) -> bool:
    """Whether class ids, units and what is said have the types of compact storage, which has CLASS_SLOTS of a voxel,
    one behind the other.
    """
    return all(
        array.dtype == kind for array, kind in zip(arrays, (types.uint8, types.int16, types.int32), strict=False)
    )


@overload(_add_said, jit_options=_OPTIONS)
def _typed_add_said(classes, units, said_by, most):
    if _are_compact(classes, units, said_by):
        return lambda classes, units, said_by, most: _add_said_to_vector(classes, units, said_by, most)
    return _add_said


@overload(_likeliest_slot, jit_options=_OPTIONS)
def _typed_likeliest_slot(classes, units):
    if _are_compact(classes, units):
        return lambda classes, units: _likeliest_of_vector(classes, units)
    return _likeliest_slot


@overload(_least_likely_slot, jit_options=_OPTIONS)
def _typed_least_likely_slot(units):
    if units.dtype == types.int16:
        return lambda units: _least_likely_of_vector(units)
    return _least_likely_slot
