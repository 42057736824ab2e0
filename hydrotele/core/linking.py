"""How compiled functions call each other: large ones by symbol, small ones inlined.

numba copies the code of every function that is called, and of those that it calls, into the caller,
and optimises and translates all of it again. With calls ten deep this is most of the time to
compile. Here a large function is compiled once, and its callers only name its symbol. Code from the
cache is loaded together with the functions whose symbols it names.
"""

import importlib
from typing import Any

from numba.core.caching import CompileResultCacheImpl
from numba.core.typing.templates import make_concrete_template

from hydrotele.core.references import argument_type, check_result

LINKED_BYTECODE = 300
"""Length of a function's bytecode up to which its code becomes part of the caller [bytes]. LLVM
would seldom inline longer ones."""


class Callee:
    """A compiled function as other compiled functions call it.

    Attributes:
        dispatcher: numba's dispatcher that compiles it.
        is_separate: whether callers name its symbol.
    """

    def __init__(self, dispatcher: Any, inline: bool) -> None:
        self.dispatcher = dispatcher
        function = dispatcher.py_func
        self.place = function.__module__, function.__qualname__, function.__code__.co_firstlineno
        self.is_separate = (
            not inline
            and "<locals>" not in function.__qualname__
            and len(function.__code__.co_code) > LINKED_BYTECODE
        )
        _callees[self.place] = self

    def compile(self, args: tuple) -> Any:
        """Compile for some types of arguments, or load from the cache; numba's result."""
        self.dispatcher.compile(args)
        return self.dispatcher.overloads[args]

    def call_template(self, args: tuple, keywords: dict) -> tuple:
        """Compile for a call in compiled code, as `Dispatcher.get_call_template` of numba does.

        A constant argument is taken as any number of its kind, so that no function is compiled for
        each constant.
        """
        pysig, args = self.dispatcher.fold_argument_types(args, keywords)
        args = tuple(map(argument_type, args))
        signature, name = self.compile(args).signature, self.place[1]
        check_result(signature.return_type, name)
        return make_concrete_template(f"CallTemplate({name})", name, [signature]), pysig, args, {}

    def overload(self, args: tuple) -> Any:
        """Key under which numba finds how to call it, as `Dispatcher.get_overload` of numba."""
        result = self.dispatcher.overloads[tuple(args)]
        if not self.is_separate:
            return result.entry_point
        return self._symbol_key(result)

    def _symbol_key(self, result: Any) -> tuple[str, str]:
        symbol = result.fndesc.mangled_name
        if symbol not in _symbols:
            self.dispatcher.targetctx.insert_user_function(("symbol", symbol), result.fndesc)
            _symbols[symbol] = self.place, tuple(result.signature.args)
        return "symbol", symbol


_callees: dict[tuple, Callee] = {}
_symbols: dict[str, tuple[tuple, tuple]] = {}
"""Symbol of a function -> its place and the types of its arguments."""


class LinkedCache(CompileResultCacheImpl):
    """Keeps with compiled code which functions its symbols stand for."""

    def reduce(self, cres: Any) -> Any:
        """What is kept of compiled code."""
        module = cres.library._final_module
        declared = [f.name for f in module.functions if f.is_declaration]
        needed = {name: _symbols[name] for name in declared if name in _symbols}
        return needed, super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Load compiled code and what it calls; None where a function now has another symbol."""
        needed, code = payload
        for symbol, (place, args) in needed.items():
            importlib.import_module(place[0])
            callee = _callees[place]
            found = callee.compile(args)
            if found.fndesc.mangled_name != symbol:
                return None
            callee._symbol_key(found)
        return super().rebuild(target_context, code)
