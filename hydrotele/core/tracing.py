"""Straight-line code of numerical functions whose control flow does not depend on the traced numbers.

The Python source of a function runs once with symbolic numbers. The recorded operations become a
program without loops, branches and work arrays, in which products with zero, repeated expressions and unused
results are left out. The program is compiled for one machine, or for several at once with vector instructions.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from importlib import import_module
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

from hydrotele.core.device import import_cuda, is_simulated, rebuild_function

_COMMUTATIVE = {"add", "mul"}
_SYMBOLS = {"add": "+", "sub": "-", "mul": "*", "div": "/"}


class Program:
    """Operations in order; values are numbered, and a repeated operation has one value.

    Attributes:
        operations: name and arguments of every operation. An argument is the number of a value or a float. The
            arguments of "load" are an array's index and the element's index.
        stores: (array's index, element's index, value or float) in order.
        sizes: number of elements of each array per machine; 0 for an array whose elements are vectors of
            all machines.
        single: indices of arrays whose elements are computed in float32 where no other array needs the operation.
    """

    def __init__(self, sizes: Sequence[int], single: Sequence[int] = ()) -> None:
        """Create an empty program for arrays with these numbers of elements per machine."""
        self.single = tuple(single)
        self.operations: list[tuple] = []
        self.stores: list[tuple[int, int, Any]] = []
        self.sizes = tuple(sizes)
        self._known: dict[tuple, Value] = {}

    def record(self, name: str, *arguments: Any) -> "Value":
        """Return the value of an operation, which is recorded if it is new."""
        key = (name, *(a.number if isinstance(a, Value) else a for a in arguments))
        if name in _COMMUTATIVE:
            key = (name, *sorted(key[1:], key=lambda a: (isinstance(a, float), a)))
        key = (*key, *(isinstance(a, float) for a in key[1:]))
        if key not in self._known:
            self._known[key] = Value(self, len(self.operations))
            self.operations.append((name, *arguments))
        return self._known[key]

    def load(self, array: int, element: int) -> "Value":
        """Return the value of an element of an array at the start of the program."""
        return self.record("load", array, element)

    def store(self, array: int, element: int, value: Any) -> None:
        """Write a value to an element of an array at the end of the program."""
        self.stores.append((array, element, value))

    def used_operations(self, excluded: Sequence[int] = ()) -> list[int]:
        """Return the numbers of the operations on which values stored in all but some arrays depend, in order."""
        used = set()
        open_ones = [v.number for array, _, v in self.stores if isinstance(v, Value) and array not in excluded]
        while open_ones:
            number = open_ones.pop()
            if number not in used:
                used.add(number)
                open_ones += [a.number for a in self.operations[number][1:] if isinstance(a, Value)]
        return sorted(used)

    def single_operations(self) -> set[int]:
        """Return the numbers of the operations that are done in float32: sums, products and quotients."""
        wide = set(self.used_operations(self.single))
        return {n for n, (name, *_) in enumerate(self.operations) if n not in wide and name in _SYMBOLS}

    @property
    def digest(self) -> str:
        """Hash of the program, 16 hexadecimal digits."""
        text = repr((self.sizes, self.single, [self._describe(n) for n in self.used_operations()], self.stores))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def _describe(self, number: int) -> tuple:
        return number, *self.operations[number]

    def python_source(self, name: str, arrays: Sequence[str]) -> str:
        """Return the source of a Python function of a tuple of arrays, for one machine.

        `math` and `single`, which rounds to float32, are global variables. The arrays are contiguous, or have one
        element per row.
        """
        rounded = self.single_operations()

        def word(given: Any, is_single: bool) -> str:
            text = f"v{given.number}" if isinstance(given, Value) else repr(float(given))
            if isinstance(given, Value) and is_single == (given.number in rounded):
                return text
            return f"{'single' if is_single else 'float'}({text})"

        lines = [f"def {name}(arrays):", f"    {', '.join(arrays)} = [array.reshape(-1) for array in arrays]"]
        for number in self.used_operations():
            kind, *given = self.operations[number]
            words = [word(a, number in rounded) for a in given]
            if kind == "load":
                text = f"{arrays[given[0]]}[{given[1]}]"
            elif kind in _SYMBOLS:
                text = f"{words[0]} {_SYMBOLS[kind]} {words[1]}"
            elif kind == "keep_below":  # (value, limit, then, otherwise)
                text = f"{words[2]} if {words[0]} < {words[1]} else {words[3]}"
            else:
                text = f"math.{kind}({words[0]})"
            lines.append(f"    v{number} = {text}")
        for array, element, value in self.stores:
            lines.append(f"    {arrays[array]}[{element}] = {word(value, False)}")
        return "\n".join(lines) + "\n"

    def emit(self, builder: Any, address: Callable[[int, int, int], Any], lanes: int, call: Callable) -> None:
        """Emit the program as LLVM code.

        Args:
            builder: llvmlite's builder.
            address: emits the address of an element, given the array, the element and the machine. Of an
                array with size 0 the numbers of all machines lie side by side.
            lanes: number of machines, one per element of a vector; 1 for scalars.
            call: emits the call of a function of one number, given its name and the argument.
        """
        real, small = ir.DoubleType(), ir.FloatType()
        kind = ir.VectorType(real, lanes) if lanes > 1 else real
        small_kind = ir.VectorType(small, lanes) if lanes > 1 else small

        def constant(number: float, of_kind: Any) -> Any:
            return ir.Constant(of_kind, [number] * lanes if lanes > 1 else number)

        def elements(value: Any) -> list[Any]:
            if lanes == 1:
                return [value]
            return [builder.extract_element(value, ir.Constant(ir.IntType(32), k)) for k in range(lanes)]

        def join(parts: list[Any]) -> Any:
            if lanes == 1:
                return parts[0]
            vector = ir.Constant(kind, ir.Undefined)
            for k, part in enumerate(parts):
                vector = builder.insert_element(vector, part, ir.Constant(ir.IntType(32), k))
            return vector

        def read(array: int, element: int) -> Any:
            if self.sizes[array] == 0 and lanes > 1:
                vector = builder.bitcast(address(array, element, 0), kind.as_pointer())
                return builder.load(vector, align=8)
            return join([builder.load(address(array, element, lane)) for lane in range(lanes)])

        values: dict[int, Any] = {}
        converted: dict[int, Any] = {}
        rounded = self.single_operations()

        def operand(given: Any, is_single: bool = False) -> Any:
            if not isinstance(given, Value):
                number = float(np.float32(given)) if is_single else float(given)
                return constant(number, small_kind if is_single else kind)
            if is_single == (given.number in rounded):
                return values[given.number]
            if given.number not in converted:
                convert, of_kind = (builder.fptrunc, small_kind) if is_single else (builder.fpext, kind)
                converted[given.number] = convert(values[given.number], of_kind)
            return converted[given.number]

        arithmetic = {"add": builder.fadd, "sub": builder.fsub, "mul": builder.fmul, "div": builder.fdiv}
        for number in self.used_operations():
            name, *given = self.operations[number]
            if name == "load":
                values[number] = read(*given)
            elif name in arithmetic:
                is_single = number in rounded
                values[number] = arithmetic[name](operand(given[0], is_single), operand(given[1], is_single))
            elif name == "keep_below":
                is_below = builder.fcmp_ordered("<", operand(given[0]), operand(given[1]))
                values[number] = builder.select(is_below, operand(given[2]), operand(given[3]))
            elif name == "sqrt":
                symbol = f"llvm.sqrt.v{lanes}f64" if lanes > 1 else "llvm.sqrt.f64"
                used = cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind]), symbol)
                values[number] = builder.call(used, [operand(given[0])])
            else:
                values[number] = join([call(name, part) for part in elements(operand(given[0]))])
        for array, element, value in self.stores:
            for lane, part in enumerate(elements(operand(value))):
                builder.store(part, address(array, element, lane))


class Value:
    """A number that is known when the program runs; arithmetic with it is recorded."""

    __slots__ = ("number", "program")

    def __init__(self, program: Program, number: int) -> None:
        self.program, self.number = program, number

    def __repr__(self) -> str:
        """Return the name of the value, for the digest."""
        return f"v{self.number}"

    def __add__(self, other: Any) -> Any:
        """Return the sum; 0 is left out."""
        return self if _is_number(other, 0.0) else self.program.record("add", self, _real(other))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        """Return the difference; 0 is left out."""
        return self if _is_number(other, 0.0) else self.program.record("sub", self, _real(other))

    def __rsub__(self, other: Any) -> Any:
        """Return the difference of a number and this value."""
        return self.program.record("sub", -0.0 if _is_number(other, 0.0) else _real(other), self)

    def __mul__(self, other: Any) -> Any:
        """Return the product; a factor 0 gives 0, a factor 1 is left out."""
        if _is_number(other, 0.0):
            return 0.0
        return self if _is_number(other, 1.0) else self.program.record("mul", self, _real(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        """Return the quotient; a divisor 1 is left out."""
        return self if _is_number(other, 1.0) else self.program.record("div", self, _real(other))

    def __rtruediv__(self, other: Any) -> Any:
        """Return the quotient of a number and this value; 0 gives 0."""
        return 0.0 if _is_number(other, 0.0) else self.program.record("div", _real(other), self)

    def __neg__(self) -> Any:
        """Return the negative value."""
        return self.program.record("sub", -0.0, self)

    def __bool__(self) -> bool:
        """Raise TypeError: the control flow must not depend on traced numbers."""
        raise TypeError("the control flow depends on a number that is known only when the program runs")


def _is_number(value: Any, number: float) -> bool:
    return not isinstance(value, Value) and value == number


def _real(value: Any) -> Any:
    return value if isinstance(value, Value) else float(value)


def select_below(value: Any, limit: float, then: Any, otherwise: Any) -> Any:
    """Return `then` if a value is below a limit, else `otherwise`; also for traced numbers."""
    program = next((v.program for v in (value, then, otherwise) if isinstance(v, Value)), None)
    if program is None or not isinstance(value, Value) and not isinstance(limit, Value):
        return then if value < limit else otherwise
    return program.record("keep_below", *map(_real, (value, limit, then, otherwise)))


def _minimum(first: Any, second: Any) -> Any:
    return select_below(second, first, second, first)


def _maximum(first: Any, second: Any) -> Any:
    return select_below(first, second, second, first)


def _record_or_compute(name: str, known: Callable[[float], float]) -> Callable[[Any], Any]:
    return lambda value: value.program.record(name, value) if isinstance(value, Value) else known(value)


def _magnitude(value: Any) -> Any:
    return select_below(value, 0.0, -value, value)


_FUNCTIONS = {"sqrt": math.sqrt, "sin": math.sin, "cos": math.cos}


def make_traceable_function(dispatcher: Any, replaced: dict[Any, Any]) -> Any:
    """Return the Python form of a compiled function and of its callees that accepts traced numbers.

    Args:
        dispatcher: function compiled by `core.compiled`.
        replaced: as for `device.rebuild_function`.
    """
    module = ModuleType("math")
    vars(module).update(vars(math))
    vars(module).update({name: _record_or_compute(name, known) for name, known in _FUNCTIONS.items()})
    scope = {"math": module, "np": module, "abs": _magnitude, "min": _minimum, "max": _maximum}
    return rebuild_function(dispatcher, lambda function: function, replaced, modules=scope)


def make_program_codegen(program: Program, lanes: int) -> Callable:
    """Return the code generator of a numba intrinsic with one argument, a tuple of the program's arrays.

    Arrays with a size are contiguous and have the numbers of the machines one after the other, machine by machine. Of
    an array without a size the first index is that of the element, with any stride.

    Args:
        program: the program.
        lanes: number of machines, one per element of a vector; 1 for scalars.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        arrays = [
            context.make_array(kind)(context, builder, value=builder.extract_value(args[0], k))
            for k, kind in enumerate(signature.args[0])
        ]
        integer = ir.IntType(64)

        def address(array: int, element: int, lane: int) -> Any:
            made, size = arrays[array], program.sizes[array]
            if size:
                return builder.gep(made.data, [ir.Constant(integer, element + lane * size)])
            if lanes > 1:
                return builder.gep(made.data, [ir.Constant(integer, element * lanes + lane)])
            stride = builder.extract_value(made.strides, 0)
            place = builder.mul(stride, ir.Constant(integer, element))
            start = builder.bitcast(made.data, ir.IntType(8).as_pointer())
            return builder.bitcast(builder.gep(start, [place]), ir.DoubleType().as_pointer())

        def call(name: str, argument: Any) -> Any:
            kind = types.float64(types.float64)
            return context.get_function(getattr(math, name), kind)(builder, [argument])

        program.emit(builder, address, lanes, call)
        return context.get_dummy_value()

    return codegen


def make_program_function(program: Program, lanes: int, wrap: Callable[[Any], Any], intrinsic: Any) -> Any:
    """Return a function of a tuple of arrays that runs a program.

    Args:
        program: the program.
        lanes: number of machines, one per element of a vector; 1 for scalars.
        wrap: compiles a Python function, for example `core.compiled.compile_without_allocation`.
        intrinsic: numba's decorator `intrinsic` for the processor.
    """
    codegen = make_program_codegen(program, lanes)

    @intrinsic
    def run(typingctx, arrays):
        return types.none(arrays), codegen

    function = FunctionType(_call_run.__code__, {"run": run, "__name__": __name__})
    function.__module__, function.__qualname__ = __name__, f"program_{program.digest}_{lanes}"
    return wrap(function)


def make_device_program(program: Program, arrays: Sequence[str]) -> Any:
    """Return the CUDA device function of a tuple of arrays that runs a program for one machine.

    numba's simulator of CUDA runs Python code instead.

    Args:
        program: the program.
        arrays: names of its arrays.
    """
    cuda = import_cuda()
    if is_simulated():
        scope: dict[str, Any] = {"math": math, "single": np.float32}
        exec(program.python_source("run_program", arrays), scope)
        return cuda.jit(device=True)(scope["run_program"])
    extending = import_module("numba.cuda.extending")
    return make_program_function(program, 1, cuda.jit(device=True), extending.intrinsic)


run: Any = None  # the copies of the next function have an intrinsic of this name


def _call_run(arrays):
    run(arrays)


def symbolic_array(program: Program, array: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of values loaded from an array of a program, of a shape."""
    loaded = np.empty(math.prod(shape), object)
    loaded[:] = [program.load(array, k) for k in range(len(loaded))]
    return loaded.reshape(shape)
