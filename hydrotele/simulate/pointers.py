"""Memory that C hands to compiled code: addresses seen as arrays, C functions called by address.

Addresses come in as numbers, so that compiled functions can be cached on disk: a function pointer
of ctypes could not.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import functools

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import compiled
from hydrotele.simulate.layout import mujoco_library


@intrinsic
def pointer(typingctx, address):
    """Reinterpret an int64 address as void*."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), codegen


@compiled
def floats(address, count):
    """(count,) floats at an address."""
    return carray(pointer(address), (count,), np.float64)


@compiled
def field(base, offset, count):
    """(count,) floats that a struct at `base` points to with its member at `offset`."""
    return floats(carray(pointer(base + offset), (1,), np.int64)[0], count)


@intrinsic
def call_step(typingctx, function, model, data):
    """`mj_step(model, data)`, with the address of that function."""

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * 2)
        function, *places = args
        called = builder.inttoptr(function, kind.as_pointer())
        builder.call(called, [builder.inttoptr(place, cgutils.voidptr_t) for place in places])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def call_set_state(typingctx, function, model, data, state, spec):
    """`mj_setState(model, data, state, spec)`, with the address of that function."""

    def codegen(context, builder, signature, args):
        integer = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t] * 3 + [integer])
        function, *places, spec = args
        called = builder.inttoptr(function, kind.as_pointer())
        pointers = [builder.inttoptr(place, cgutils.voidptr_t) for place in places]
        builder.call(called, [*pointers, builder.trunc(spec, integer)])
        return context.get_dummy_value()

    five = (types.int64,) * 5
    return types.void(*five), codegen


@functools.cache
def function_address(name: str) -> int:
    """Address of a function of MuJoCo's library, such as `mj_step`."""
    import ctypes

    return ctypes.cast(getattr(mujoco_library(), name), ctypes.c_void_p).value or 0
