"""Other compiled forms of a function and of all functions that it calls: for CUDA, or with replaced callees."""

import types
from collections.abc import Callable
from typing import Any


def rebuild_function(
    dispatcher: Any, wrap: Callable[[Any], Any], replaced: dict[Any, Any], copy_all: bool = True
) -> Any:  # fmt: skip
    """Return another form of a compiled function and of the functions that it calls, directly or indirectly.

    The Python source stays the same. A function is copied with global variables that refer to the
    other forms of its callees.

    Args:
        dispatcher: function compiled by `core.compiled`.
        wrap: converts a copied Python function to its other form, for example `cuda.jit(device=True)`.
        replaced: compiled function -> the form that is used instead; the dictionary receives the forms made here.
        copy_all: whether functions that call none of the replaced functions are copied, too.

    Returns:
        The other form.
    """
    if dispatcher in replaced:
        return replaced[dispatcher]
    function = dispatcher.py_func
    scope, names = dict(function.__globals__), function.__code__.co_names
    for name in names:
        if is_compiled_function(scope.get(name)):
            scope[name] = rebuild_function(scope[name], wrap, replaced, copy_all)
    if not copy_all and all(scope.get(name) is function.__globals__.get(name) for name in names):
        replaced[dispatcher] = dispatcher
        return dispatcher
    copy = types.FunctionType(function.__code__, scope, function.__name__, function.__defaults__, function.__closure__)
    copy.__module__, copy.__qualname__, copy.__doc__ = function.__module__, function.__qualname__, function.__doc__
    replaced[dispatcher] = wrap(copy)
    return replaced[dispatcher]


def is_compiled_function(value: Any) -> bool:
    """Return whether a value is a function compiled by `core.compiled`."""
    return hasattr(value, "py_func") and hasattr(value, "targetctx")
