"""Memory by address for compiled code: arrays of numbers, and records of many addresses at once.

Addresses are numbers, so that compiled functions can be cached on disk and called by C.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import numpy as np
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import compiled


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
def rows_of(address, rows, columns):
    """(rows, columns) floats at an address."""
    return floats(address, rows * columns).reshape((rows, columns))


@compiled
def integers(address, count):
    """(count,) 64-bit integers at an address."""
    return carray(pointer(address), (count,), np.int64)


@compiled
def copy_to(there, values):
    """Copy numbers into the first places of an array.

    numba's own assignment compiles words for its error message with it, which takes seconds.

    Args:
        there: (>= n,) written.
        values: (n,).

    Returns:
        Nothing.
    """
    for i in range(len(values)):
        there[i] = values[i]


@compiled
def short_integers(address, count):
    """(count,) 32-bit integers at an address."""
    return carray(pointer(address), (count,), np.int32)


def address_record(kind: np.dtype, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """A record of the addresses of arrays, for native code that takes many of them at once.

    Reading a named tuple of arrays costs numba a microsecond each, a record none.

    Args:
        kind: record type with a field of 64-bit integers for every array.
        arrays: field -> contiguous array of 64-bit floats or integers, which must outlive it.

    Returns:
        (1,) record; other fields are 0.

    Raises:
        TypeError: an array is of another kind.
    """
    record = np.zeros(1, kind)
    for name, array in arrays.items():
        if array.dtype not in (np.float64, np.int64) or not array.flags.c_contiguous:
            raise TypeError(f"{name} must be contiguous 64-bit numbers, not {array.dtype}")
        record[name] = array.ctypes.data
    return record


@compiled
def field(base, offset, count):
    """(count,) floats that a struct at `base` points to with its member at `offset`."""
    return floats(carray(pointer(base + offset), (1,), np.int64)[0], count)
