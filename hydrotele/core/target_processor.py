"""Compile functions for a level of the x86-64 architecture instead of the processor of this machine.

Code for a level runs on every processor that has the instructions of the level, so that a wheel can
contain compiled code. The level is x86-64-v3 (AVX2 and FMA, since 2013), on older processors
x86-64-v2. Where neither is available, and on other architectures, the processor is that of this
machine, as numba does.

The classes here replace numba's for the functions of this package only. They share numba's table of
functions, so that functions of both kinds can call each other. Code of other packages is
compiled by numba as without this package.

Source of the levels: x86-64 psABI, version 1.0, table 3.1.
"""

import functools
from typing import Any

from llvmlite import binding
from numba.core import registry
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.compiler import CompileResult
from numba.core.runtime import _nrt_python  # pyright: ignore[reportAttributeAccessIssue] - compiled

_V2 = ("cx16", "sahf", "popcnt", "sse3", "ssse3", "sse4.1", "sse4.2")
_LEVELS = {
    "x86-64-v3": (*_V2, "avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"),
    "x86-64-v2": _V2,
}
"""Level -> names of its features in LLVM, the highest level first."""


def choose_processor(features: dict[str, bool]) -> str | None:
    """Return the highest level of x86-64 that a processor supports; None if it supports none.

    Args:
        features: names of the processor's features in LLVM, and whether it has them.

    >>> choose_processor({"sse4.2": True, "avx2": True}) is None
    True
    """
    return next((name for name, needed in _LEVELS.items() if all(map(features.get, needed))), None)


def _host_processor() -> str | None:
    """Return the level of the processor of this machine; None if it has none or is of another architecture."""
    if not binding.get_process_triple().startswith("x86_64"):
        return None
    return choose_processor(dict(binding.get_host_cpu_features()))


class _Library(JITCodeLibrary):
    """Machine code of one function, stored together with its LLVM code only if callers copy it.

    Attributes:
        is_copied: whether callers copy the LLVM code instead of linking to the machine code.
    """

    is_copied = True

    def serialize_using_object_code(self) -> tuple:
        """Return the parts that are stored, for `_unserialize`."""
        if self.is_copied:
            return super().serialize_using_object_code()
        self._ensure_finalized()
        groups = self._final_module.functions, self._final_module.global_variables
        symbols = [value.name for group in groups for value in group if not value.is_declaration]
        return self.name, "linked", (self._get_compiled_object(), symbols)

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple) -> Any:
        name, kind, data = state
        if kind != "linked":
            return super()._unserialize(codegen, state)
        code, symbols = data
        library = codegen.create_library(name)
        library.enable_object_caching()
        library._set_compiled_object(code)
        library._finalize_final_module()
        codegen._engine._defined_symbols.update(symbols)
        return library


class _Codegen(JITCPUCodegen):
    """Code generator for the level of x86-64 that this machine supports."""

    _library_class = _Library

    def __init__(self, module_name: str) -> None:
        self._processor = _host_processor()
        super().__init__(module_name)

    def _get_host_cpu_name(self) -> str:
        return self._processor or super()._get_host_cpu_name()

    def _get_host_cpu_features(self) -> str:
        return "" if self._processor else super()._get_host_cpu_features()


class _Target(registry.CPUTarget):
    """numba's target with another code generator.

    Both share the type inference and the tables of functions, as numba's own targets for
    ahead-of-time compilation do.
    """

    def __init__(self) -> None:
        super().__init__("cpu")
        shared: Any = registry.cpu_target.target_context
        self._context = shared.subtarget(_internal_codegen=_Codegen("hydrotele.exec"))

    @property
    def target_context(self) -> Any:
        return self._context

    @property
    def typing_context(self) -> Any:
        return registry.cpu_target.typing_context


TARGET = _Target()


class Dispatcher(registry.CPUDispatcher):
    """numba's dispatcher of a function, for the processor of this module."""

    targetdescr = TARGET


class CFunction(CFunc):
    """numba's callback for C code, for the processor of this module."""

    _targetdescr = TARGET


def processor_name() -> str:
    """Return LLVM's name of the processor for which functions are compiled, such as `x86-64-v3`."""
    return TARGET.target_context.codegen().magic_tuple()[1]


@functools.cache
def publish_runtime() -> None:
    """Make the symbols of numba's runtime for arrays known to LLVM.

    Stored code needs no more than that. `refresh` of numba's target context does it, too, but also
    loads the tables of the compiler, which takes a fifth of a second; numba calls it before it compiles.
    """
    for name, address in _nrt_python.c_helpers.items():
        binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def publish_symbol(result: CompileResult) -> str:
    """Make the symbol of a compiled function known to all code of this process, and return it.

    Code of numba's own target, such as a function of another package, can then call it, too.
    """
    symbol = result.fndesc.mangled_name
    binding.add_symbol(symbol, result.library.get_pointer_to_function(symbol))
    return symbol
