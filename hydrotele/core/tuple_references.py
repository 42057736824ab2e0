"""Pass large named tuples between compiled functions by reference.

numba passes a named tuple by value, as one native argument per scalar: seven to nine for each
array, a thousand for the estimator's model. Compile time grows with this count. Here the caller
stores a large named tuple in memory, and the callee gets its address and reads the fields that it
uses. The memory belongs to the caller and does not change while the callee runs.
"""

import functools
import hashlib
from typing import Any

from llvmlite import ir
from numba.core import cgutils, errors, types
from numba.core.datamodel.models import OpaqueModel
from numba.core.imputils import (
    impl_ret_borrowed,
    lower_builtin,
    lower_cast,
    lower_getattr_generic,
)
from numba.extending import NativeValue, register_model, unbox

MAX_ARGUMENTS_BY_VALUE = 40
"""Largest number of native arguments of a named tuple that is still passed by value. Small named
tuples stay in registers."""

_NAMED_TUPLES = (types.NamedTuple, types.NamedUniTuple)


class Reference(types.BaseNamedTuple):
    """numba type of a reference to a named tuple; it has the same fields as the tuple.

    Nested named tuples are references, too.

    Attributes:
        record: numba's type of the named tuple.
        types: types of its fields.
    """

    def __init__(self, record: Any) -> None:
        self.record = record
        self.instance_class, self.fields, self.count = (
            record.instance_class, record.fields, len(record)
        )  # fmt: skip
        self.types = tuple(Reference(t) if isinstance(t, _NAMED_TUPLES) else t for t in record)
        owner = record.instance_class
        text = f"{owner.__module__}.{owner.__qualname__} {record}"
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        # numba adds the names of the argument types to the function's symbol: keep this one short.
        super().__init__(f"{owner.__name__}_{digest}")

    def __getitem__(self, index: int) -> Any:
        """Return the type of a field."""
        return self.types[index]

    def __iter__(self) -> Any:
        """Iterate over the types of the fields."""
        return iter(self.types)

    def __len__(self) -> int:
        """Return the number of fields."""
        return self.count


@functools.cache
def argument_type(kind: Any) -> Any:
    """Return the type with which an argument is passed to a compiled function.

    Args:
        kind: numba's type of the argument in the caller.

    Returns:
        A `Reference` for a large named tuple; the non-literal type for a constant, so that a
        function is not compiled for each constant; otherwise `kind` itself.
    """
    if isinstance(kind, _NAMED_TUPLES) and count_native_arguments(kind) > MAX_ARGUMENTS_BY_VALUE:
        return Reference(kind)
    return types.unliteral(kind)


def count_native_arguments(kind: Any) -> int:
    """Return the number of machine-level arguments for a value of a numba type passed by value.

    A scalar has 1, an array 5 plus 2 per dimension, a tuple the sum of its items.
    """
    if isinstance(kind, types.BaseTuple) and not isinstance(kind, Reference):
        return sum(count_native_arguments(part) for part in _item_types(kind))
    return 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1


def check_result_type(kind: Any, name: str) -> None:
    """Reject a function that returns a reference, which could outlive the memory it points to.

    Args:
        kind: type of the result.
        name: name of the function.

    Raises:
        TypingError: the result is or contains a reference.
    """
    if isinstance(kind, Reference):
        raise errors.TypingError(f"{name} returns a large named tuple that it got as an argument")
    if isinstance(kind, types.BaseTuple):
        for part in _item_types(kind):
            check_result_type(part, name)


def _item_types(kind: Any) -> tuple:
    """Return the types of the items of a numba tuple type."""
    return tuple(kind)


@register_model(Reference)
class _ReferenceModel(OpaqueModel):
    """Data model of a reference: an opaque pointer."""


@lower_getattr_generic(Reference)
def _read_attribute(context, builder, kind, address, attr):
    """Emit code that reads a field of a referenced named tuple by its name."""
    return _read_field(context, builder, kind, address, kind.fields.index(attr))


@lower_builtin("static_getitem", Reference, types.IntegerLiteral)
def _read_item(context, builder, sig, args):
    """Emit code that reads a field of a referenced named tuple by its index, also for unpacking."""
    return _read_field(context, builder, sig.args[0], args[0], args[1])


def _read_field(context, builder, kind, address, index):
    """Emit code that reads a field from memory; return a reference for a nested named tuple."""
    memory = context.data_model_manager[kind.record].get_data_type()
    place = cgutils.gep_inbounds(builder, builder.bitcast(address, memory.as_pointer()), 0, index)
    field = kind.types[index]
    if isinstance(tuple(kind.record)[index], _NAMED_TUPLES):
        return builder.bitcast(place, cgutils.voidptr_t)
    block, begin = builder.block, len(builder.block.instructions)
    found = context.data_model_manager[field].load_from_data_pointer(builder, place)
    unchanged = builder.module.add_metadata([])
    for instruction in block.instructions[begin:]:
        if isinstance(instruction, ir.LoadInstr):  # lets LLVM move it out of loops
            instruction.set_metadata("invariant.load", unchanged)
    return impl_ret_borrowed(context, builder, field, found)


@lower_cast(types.NamedTuple, Reference)
@lower_cast(types.NamedUniTuple, Reference)
def _store_named_tuple(context, builder, fromty, toty, value):
    """Emit code that stores a named tuple on the caller's stack and returns its address as a reference."""
    memory = context.data_model_manager[fromty].get_data_type()
    space = cgutils.alloca_once(builder, memory)
    _store_fields(context, builder, fromty, value, space)
    return _hide_origin(builder, space)


def _store_fields(context, builder, record, value, space) -> None:
    """Emit code that stores the fields of a named tuple, nested ones included, in memory."""
    for index, field in enumerate(record):
        part = builder.extract_value(value, index)
        place = cgutils.gep_inbounds(builder, space, 0, index)
        if isinstance(field, _NAMED_TUPLES):
            _store_fields(context, builder, field, part, place)
        else:
            context.pack_value(builder, field, part, place)


def _hide_origin(builder, space):
    """Emit code that returns the same address, such that LLVM cannot tell where it comes from.

    Otherwise LLVM could move the reads marked as invariant before the writes after inlining.
    """
    address = builder.bitcast(space, cgutils.voidptr_t)
    kind = ir.FunctionType(cgutils.voidptr_t, [cgutils.voidptr_t])
    return builder.asm(kind, "", "=r,0,~{memory}", [address], side_effect=True)


@unbox(Reference)
def _unbox_reference(kind, value, c):
    """Emit code that converts a Python named tuple to native values in memory and returns their address."""
    native = c.unbox(kind.record, value)
    memory = c.context.data_model_manager[kind.record].get_data_type()
    space = cgutils.alloca_once(c.builder, memory)
    _store_fields(c.context, c.builder, kind.record, native.value, space)

    def release() -> None:
        """Emit code that releases the arrays after the call: a reference, an opaque pointer, does not do it."""
        if native.cleanup is not None:
            native.cleanup()
        if c.context.enable_nrt:  # otherwise unboxing takes no references
            c.context.nrt.decref(c.builder, kind.record, native.value)

    return NativeValue(_hide_origin(c.builder, space), native.is_error, release)
