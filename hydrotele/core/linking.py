"""Separate compilation of numba functions: large callees are linked by symbol, small ones inlined.

By default numba copies the code of every callee, direct or indirect, into the caller and compiles
all of it again. With calls ten levels deep this dominates the compile time. Here a large function
is compiled once, and its callers only refer to its symbol. Code loaded from the cache also loads
the functions whose symbols it refers to.
"""

import importlib
from typing import Any

from numba.core.typing.templates import make_concrete_template

from hydrotele.core.target_processor import publish_symbol
from hydrotele.core.tuple_references import argument_type, check_result_type

MAX_INLINED_BYTECODE = 300
"""Largest bytecode length of a function whose code is copied into the caller [bytes]. LLVM seldom
inlines longer functions."""


class Callee:
    """A compiled function that is called from other compiled functions.

    Attributes:
        dispatcher: numba's dispatcher that compiles it.
        location: module, qualified name and first line number of the function.
        is_separate: whether callers link to its symbol instead of copying its code.
    """

    def __init__(self, dispatcher: Any, inline: bool) -> None:
        self.dispatcher = dispatcher
        function = dispatcher.py_func
        self.location = function.__module__, function.__qualname__, function.__code__.co_firstlineno
        self.is_separate = (
            not inline
            and "<locals>" not in function.__qualname__
            and len(function.__code__.co_code) > MAX_INLINED_BYTECODE
        )
        _callees[self.location] = self

    def compile(self, args: tuple) -> Any:
        """Compile the function for some argument types, or load its code from the cache.

        Returns:
            numba's `CompileResult`.
        """
        self.dispatcher.compile(args)
        return self.dispatcher.overloads[args]

    def call_template(self, args: tuple, keywords: dict) -> tuple:
        """Compile the function for the argument types of a call, and describe its types to numba.

        It replaces `Dispatcher.get_call_template` of numba. A literal argument gets its non-literal
        type, so that a function is not compiled for each constant.

        Args:
            args: numba types of the positional arguments.
            keywords: numba types of the keyword arguments.

        Returns:
            (numba's call template with the compiled signature, Python signature, argument types,
            {}).

        Raises:
            TypingError: the result of the function is or contains a `Reference`.
        """
        pysig, args = self.dispatcher.fold_argument_types(args, keywords)
        args = tuple(map(argument_type, args))
        signature, name = self.compile(args).signature, self.location[1]
        check_result_type(signature.return_type, name)
        return make_concrete_template(f"CallTemplate({name})", name, [signature]), pysig, args, {}

    def overload_key(self, args: tuple) -> Any:
        """Return the key by which numba's code generator finds the compiled function.

        It replaces `Dispatcher.get_overload` of numba. For a separately compiled function the key refers to
        its symbol.
        """
        result = self.dispatcher.overloads[tuple(args)]
        if not self.is_separate:
            return result.entry_point
        return self._symbol_key(result)

    def _symbol_key(self, result: Any) -> tuple[str, str]:
        """Make a compiled function's symbol known to numba's code generator, and return the key of the symbol.

        Args:
            result: numba's `CompileResult` of the function.

        Returns:
            ("symbol", name of the symbol).
        """
        symbol = result.fndesc.mangled_name
        if symbol not in _symbols:
            publish_symbol(result)
            self.dispatcher.targetctx.insert_user_function(("symbol", symbol), result.fndesc)
            _symbols[symbol] = self.location, tuple(result.signature.args)
        return "symbol", symbol


_callees: dict[tuple, Callee] = {}
_symbols: dict[str, tuple[tuple, tuple]] = {}
"""Symbol of a function -> its module, name and line, and the types of its arguments."""


def external_callees(result: Any) -> dict[str, tuple[tuple, tuple]]:
    """Return the functions that the external symbols of compiled code refer to.

    Args:
        result: numba's result of a compilation.

    Returns:
        Symbol -> module, name and line of the function, and the types of its arguments.
    """
    declared = [f.name for f in result.library._final_module.functions if f.is_declaration]
    return {name: _symbols[name] for name in declared if name in _symbols}


def load_callees(needed: dict[str, tuple[tuple, tuple]]) -> bool:
    """Compile or load the functions that cached code refers to by symbol.

    Args:
        needed: result of `external_callees` when the code was stored.

    Returns:
        False if the symbol of a function has changed, so that the cached code cannot be used; else
        True.
    """
    for symbol, (place, args) in needed.items():
        importlib.import_module(place[0])
        callee = _callees[place]
        found = callee.compile(args)
        if found.fndesc.mangled_name != symbol:
            return False
        callee._symbol_key(found)
    return True
