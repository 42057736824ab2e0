"""Large named tuples are handed from one compiled function to another by their address.

numba hands a named tuple on as one argument per number in it: seven to nine for each array, a
thousand for the estimator's model. The time to compile a function grows with that number. Here each
large named tuple lies in memory, and a function gets its address and reads what it uses. The memory
belongs to the caller and does not change while the callee runs.
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
"""Native arguments of a named tuple up to which it is handed on by value, as numba does: small ones
stay in registers."""

_RECORDS = (types.NamedTuple, types.NamedUniTuple)


class Reference(types.BaseNamedTuple):
    """Type of the address of a named tuple, with the same fields; nested ones are addresses, too.

    Attributes:
        record: numba's type of the named tuple.
        types: types of its fields.
    """

    def __init__(self, record: Any) -> None:
        self.record = record
        self.instance_class, self.fields, self.count = (
            record.instance_class, record.fields, len(record)
        )  # fmt: skip
        self.types = tuple(Reference(t) if isinstance(t, _RECORDS) else t for t in record)
        owner = record.instance_class
        text = f"{owner.__module__}.{owner.__qualname__} {record}"
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        # numba writes the name of each argument's type into that of the function.
        super().__init__(f"{owner.__name__}_{digest}")

    def __getitem__(self, index: int) -> Any:
        """Type of a field."""
        return self.types[index]

    def __iter__(self) -> Any:
        """Types of the fields."""
        return iter(self.types)

    def __len__(self) -> int:
        """Number of fields."""
        return self.count


@functools.cache
def argument_type(kind: Any) -> Any:
    """Type in which an argument reaches a compiled function.

    Args:
        kind: numba's type of what the caller has.

    Returns:
        A `Reference` for a large named tuple; for a constant the type of all numbers of its kind,
        so that a function is not compiled for each constant; else the same type.
    """
    if isinstance(kind, _RECORDS) and count_arguments(kind) > MAX_ARGUMENTS_BY_VALUE:
        return Reference(kind)
    return types.unliteral(kind)


def count_arguments(kind: Any) -> int:
    """Count the native arguments that a type becomes when it is handed on by value."""
    if isinstance(kind, types.BaseTuple) and not isinstance(kind, Reference):
        return sum(count_arguments(part) for part in _parts(kind))
    return 5 + 2 * kind.ndim if isinstance(kind, types.Array) else 1


def check_result(kind: Any, name: str) -> None:
    """Refuse a function that returns an address, which may outlive what lies there.

    Args:
        kind: type of the result.
        name: of the function.

    Raises:
        TypingError: it is, or contains, an address.
    """
    if isinstance(kind, Reference):
        raise errors.TypingError(f"{name} returns a large named tuple that it was given")
    if isinstance(kind, types.BaseTuple):
        for part in _parts(kind):
            check_result(part, name)


def _parts(kind: Any) -> tuple:
    """Types of the items of a tuple."""
    return tuple(kind)


@register_model(Reference)
class _ReferenceModel(OpaqueModel):
    """An address."""


@lower_getattr_generic(Reference)
def _read_attribute(context, builder, kind, address, attr):
    """Read a field by its name."""
    return _read_field(context, builder, kind, address, kind.fields.index(attr))


@lower_builtin("static_getitem", Reference, types.IntegerLiteral)
def _read_item(context, builder, sig, args):
    """Read a field by its place; so does taking a named tuple apart."""
    return _read_field(context, builder, sig.args[0], args[0], args[1])


def _read_field(context, builder, kind, address, index):
    """Read a field from memory."""
    memory = context.data_model_manager[kind.record].get_data_type()
    place = cgutils.gep_inbounds(builder, builder.bitcast(address, memory.as_pointer()), 0, index)
    field = kind.types[index]
    if isinstance(tuple(kind.record)[index], _RECORDS):
        return builder.bitcast(place, cgutils.voidptr_t)
    block, begin = builder.block, len(builder.block.instructions)
    found = context.data_model_manager[field].load_from_data_pointer(builder, place)
    unchanged = builder.module.add_metadata([])
    for instruction in block.instructions[begin:]:
        if isinstance(instruction, ir.LoadInstr):  # so that LLVM takes it out of loops
            instruction.set_metadata("invariant.load", unchanged)
    return impl_ret_borrowed(context, builder, field, found)


@lower_cast(types.NamedTuple, Reference)
@lower_cast(types.NamedUniTuple, Reference)
def _store(context, builder, fromty, toty, value):
    """Store a named tuple on the stack of the calling function."""
    memory = context.data_model_manager[fromty].get_data_type()
    space = cgutils.alloca_once(builder, memory)
    _store_fields(context, builder, fromty, value, space)
    return _hide(builder, space)


def _store_fields(context, builder, record, value, space) -> None:
    for index, field in enumerate(record):
        part = builder.extract_value(value, index)
        place = cgutils.gep_inbounds(builder, space, 0, index)
        if isinstance(field, _RECORDS):
            _store_fields(context, builder, field, part, place)
        else:
            context.pack_value(builder, field, part, place)


def _hide(builder, space):
    """Hide from LLVM where an address is from.

    After inlining, reads that are marked as unchanged could otherwise go before the writes.
    """
    address = builder.bitcast(space, cgutils.voidptr_t)
    kind = ir.FunctionType(cgutils.voidptr_t, [cgutils.voidptr_t])
    return builder.asm(kind, "", "=r,0,~{memory}", [address], side_effect=True)


@unbox(Reference)
def _unbox(kind, value, c):
    """Read a named tuple of Python into memory."""
    native = c.unbox(kind.record, value)
    memory = c.context.data_model_manager[kind.record].get_data_type()
    space = cgutils.alloca_once(c.builder, memory)
    _store_fields(c.context, c.builder, kind.record, native.value, space)
    return NativeValue(_hide(c.builder, space), native.is_error, native.cleanup)
