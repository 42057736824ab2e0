"""Other compiled forms of a function and of all functions that it calls: for CUDA, or with replaced callees."""

import functools
import math
import os
import types
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils
from numba.core import types as numba_types

from hydrotele.core.errors import InputError
from hydrotele.core.target_processor import Dispatcher


def rebuild_function(
    dispatcher: Any, wrap: Callable[[Any], Any], replaced: dict[Any, Any], copy_all: bool = True,
    modules: dict[str, Any] | None = None,
) -> Any:  # fmt: skip
    """Return another form of a compiled function and of the functions that it calls, directly or indirectly.

    The Python source stays the same. A function is copied with global variables that refer to the
    other forms of its callees.

    Args:
        dispatcher: function compiled by `core.compiled`, or a Python function.
        wrap: converts a copied Python function to its other form, for example `cuda.jit(device=True)`.
        replaced: compiled function -> the form that is used instead; the dictionary receives the forms made here.
        copy_all: whether functions that call none of the replaced functions are copied, too.
        modules: global variables of all copies, such as another `np`.

    Returns:
        The other form.
    """
    if dispatcher in replaced:
        return replaced[dispatcher]
    function = getattr(dispatcher, "py_func", dispatcher)
    scope, names = {**function.__globals__, **(modules or {})}, function.__code__.co_names
    for name in names:
        if is_compiled_function(scope.get(name)):
            scope[name] = rebuild_function(scope[name], wrap, replaced, copy_all, modules)
    if not copy_all and all(scope.get(name) is function.__globals__.get(name) for name in names):
        replaced[dispatcher] = dispatcher
        return dispatcher
    copy = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
    copy.__module__, copy.__qualname__, copy.__doc__ = function.__module__, function.__qualname__, function.__doc__
    replaced[dispatcher] = wrap(copy)
    return replaced[dispatcher]


def is_compiled_function(value: Any) -> bool:
    """Return whether a value is a function compiled by `core.compiled`."""
    return isinstance(value, Dispatcher)


@functools.cache
def import_cuda() -> Any:
    """Import and return `numba.cuda`.

    Raises:
        InputError: numba-cuda is not installed.
    """
    lacking = not hasattr(np, "row_stack")
    if lacking:
        np.row_stack = np.vstack  # pyright: ignore[reportAttributeAccessIssue] - numba-cuda expects it at its import
    try:
        from numba import cuda
    except ImportError as error:
        raise InputError("cuda", f"needs numba-cuda ({error}): pip install 'hydrotele[gpu]'") from None
    finally:
        if lacking:
            del np.row_stack  # pyright: ignore[reportAttributeAccessIssue]
    return cuda


def _make_allocation(as_zeros: bool) -> Any:
    """Return the CUDA form of `numpy.empty` or `numpy.zeros`: float64, constant sizes, in the memory of the thread."""
    extending = import_module("numba.cuda.extending")

    @extending.intrinsic
    def allocate(typingctx, shape):
        parts = shape.types if isinstance(shape, numba_types.Tuple | numba_types.UniTuple) else (shape,)
        if not all(isinstance(part, numba_types.IntegerLiteral) for part in parts):
            return None
        sizes = [part.literal_value for part in parts]

        def codegen(context, builder, signature, args):
            count = math.prod(sizes)
            data = cgutils.alloca_once(builder, ir.ArrayType(ir.DoubleType(), count))
            if as_zeros:
                cgutils.memset(builder, data, ir.IntType(64)(8 * count), 0)
            array = context.make_array(signature.return_type)(context, builder)
            strides = [8 * math.prod(sizes[k + 1 :]) for k in range(len(sizes))]
            context.populate_array(
                array, data=builder.bitcast(data, array.data.type), itemsize=ir.IntType(64)(8), meminfo=None,
                shape=[ir.IntType(64)(size) for size in sizes], strides=[ir.IntType(64)(step) for step in strides],
            )  # fmt: skip
            return array._getvalue()

        return numba_types.Array(numba_types.float64, len(sizes), "C")(shape), codegen

    return allocate


@functools.cache
def _device_numpy() -> types.ModuleType:
    """Return a module like numpy whose functions of numbers exist on CUDA devices."""

    def rint(value):
        return (value + _ROUNDING) - _ROUNDING

    module = types.ModuleType("numpy")
    vars(module).update({name: value for name, value in vars(np).items() if not name.startswith("__")})
    vars(module).update({name: getattr(math, name) for name in ("cos", "expm1", "sin", "sqrt")})
    vars(module)["rint"] = import_cuda().jit(device=True)(rint)
    if not is_simulated():
        vars(module).update(empty=_make_allocation(False), zeros=_make_allocation(True))
    return module


_ROUNDING = 1.5 * 2.0**52  # the sum of this and a number below 2^51 has no fraction


def is_simulated() -> bool:
    """Return whether numba's simulator of CUDA, which runs Python code, stands for a device."""
    return os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"


def make_device_function(dispatcher: Any, replaced: dict[Any, Any]) -> Any:
    """Return the CUDA form of a compiled function, a device function; also those of its callees.

    Args:
        dispatcher: function compiled by `core.compiled`, or a Python function.
        replaced: as for `rebuild_function`.
    """
    return rebuild_function(dispatcher, import_cuda().jit(device=True), replaced, modules={"np": _device_numpy()})
