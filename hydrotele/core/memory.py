"""Access to memory by address in compiled code: array views and records of addresses.

Addresses are integers, so that compiled functions can be cached on disk and called from C.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import numpy as np
from numba import carray, types
from numba.core import cgutils
from numba.extending import intrinsic

from hydrotele.core.compiled import compiled


@intrinsic
def address_to_pointer(typingctx, address):
    """Convert an int64 address to a void pointer."""

    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), codegen


@compiled
def float64_view(address, count):
    """Return a (count,) view of the 64-bit floats at an address."""
    return carray(address_to_pointer(address), (count,), np.float64)


@compiled
def matrix_view(address, rows, columns):
    """Return a (rows, columns) view of the 64-bit floats at an address, row by row."""
    return float64_view(address, rows * columns).reshape((rows, columns))


@compiled
def int64_view(address, count):
    """Return a (count,) view of the 64-bit integers at an address."""
    return carray(address_to_pointer(address), (count,), np.int64)


@compiled
def copy_values(target, values):
    """Copy values into the first elements of an array.

    numba's slice assignment also compiles the formatting of its error message, which takes seconds.

    Args:
        target: (>= n,) destination array; its first n elements are written.
        values: (n,) values to copy.

    Returns:
        Nothing.
    """
    for i in range(len(values)):
        target[i] = values[i]


@compiled
def int32_view(address, count):
    """Return a (count,) view of the 32-bit integers at an address."""
    return carray(address_to_pointer(address), (count,), np.int32)


def address_record(kind: np.dtype, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Create a record (NumPy structure) with the addresses of arrays, for compiled code with many arrays.

    To unbox a named tuple of arrays takes numba about a microsecond per array; a record avoids it.

    Args:
        kind: record type with a 64-bit integer field for every array.
        arrays: field -> contiguous array of 64-bit floats or integers, which must outlive the
            record.

    Returns:
        (1,) record; all other fields are 0.

    Raises:
        TypeError: an array is not contiguous or has another element type.
    """
    record = np.zeros(1, kind)
    for name, array in arrays.items():
        if array.dtype not in (np.float64, np.int64) or not array.flags.c_contiguous:
            raise TypeError(f"{name} must be a contiguous 64-bit array, not {array.dtype}")
        record[name] = array.ctypes.data
    return record


@compiled
def struct_field_view(base, offset, count):
    """Return a (count,) view of the 64-bit floats to which a pointer field of a C structure points.

    Args:
        base: address of the structure.
        offset: offset of the field [bytes].
        count: number of floats.
    """
    return float64_view(carray(address_to_pointer(base + offset), (1,), np.int64)[0], count)
