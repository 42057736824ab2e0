"""Formulas in machine files: products of basic functions, each with its coefficient.

    parameters: {"1": 40.0, "velocity * abs(velocity)": -310.0,
                 "bump(position, 0.4, 0.05) * sign(velocity, 0.005)": -900.0}

A product has factors joined by `*`, each may carry a power up to `** 6`. A factor is an argument or
a function of one; an argument is a variable of `DriveState` or a difference of two of them.
"""

import ast
from collections.abc import Mapping

from hydrotele.core.datafile import suggest
from hydrotele.terms.law import VARIABLES

FUNCTIONS = {
    "abs": (1, 0, "abs(e) = |e|"),
    "sign": (2, 1, "sign(e, w) = tanh(e / w)"),
    "root": (3, 1, "root(e, d) = e / (e^2 + d^2)^(1/4), the root of |e| with the sign of e"),
    "bump": (4, 2, "bump(e, c, w) = exp(-(e - c)^2 / (2 w^2))"),
    "above": (5, 1, "above(e, a) = max(0, e - a)"),
    "below": (6, 1, "below(e, a) = max(0, a - e)"),
    "rise": (7, 1, "rise(e, T) = 1 - exp(-e / T)"),
    "sin": (8, 1, "sin(e, L) = sin(2 pi e / L)"),
    "cos": (9, 1, "cos(e, L) = cos(2 pi e / L)"),
}
"""Basic function -> (its code, number of constants, what it is)."""

_DIVIDES = {"sign": 0, "root": 0, "bump": 1, "rise": 0, "sin": 0, "cos": 0}
_PLAIN, _NONE, _HIGHEST = 0, -1, 6


def formula_arguments(parameters: Mapping[str, float]) -> dict[str, list[float]]:
    """A formula as numbers for the law `formula`.

    Args:
        parameters: product -> coefficient.

    Returns:
        `numbers`: count of products, then of each its coefficient, the count of its factors and of
        each of these: function, variable, variable to subtract or -1, two constants, power.

    Raises:
        ValueError: a product is no such product; says what is allowed.

    >>> formula_arguments({"velocity ** 2": 3.0})["numbers"]
    [1, 3.0, 1, 0, 2, -1, 0.0, 0.0, 2]
    """
    if not parameters:
        raise ValueError("law formula needs at least one product, such as '1' or 'velocity'")
    numbers: list[float] = [len(parameters)]
    for text, coefficient in parameters.items():
        if isinstance(coefficient, bool) or not isinstance(coefficient, int | float):
            raise ValueError(f"formula {text!r}: the coefficient {coefficient!r} is no number")
        factors = _factors(text)
        numbers += [coefficient, len(factors)]
        for factor in factors:
            numbers += factor
    return {"numbers": numbers}


def _factors(text: str) -> list[list[float]]:
    try:
        node = ast.parse(text.strip(), mode="eval").body
    except SyntaxError:
        raise _wrong(text, "it cannot be read") from None
    if isinstance(node, ast.Constant) and node.value == 1:
        return []
    return [_factor(text, part) for part in _parts(node)]


def _parts(node: ast.expr) -> list[ast.expr]:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
        return [*_parts(node.left), *_parts(node.right)]
    return [node]


def _factor(text: str, node: ast.expr) -> list[float]:
    power = 1
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        exponent = node.right
        if not (isinstance(exponent, ast.Constant) and exponent.value in range(1, _HIGHEST + 1)):
            raise _wrong(text, f"a power must be a whole number from 1 to {_HIGHEST}")
        node, power = node.left, int(str(exponent.value))
    if not isinstance(node, ast.Call):
        return [_PLAIN, *_argument(text, node), 0.0, 0.0, power]
    name = node.func.id if isinstance(node.func, ast.Name) else "?"
    if name not in FUNCTIONS:
        raise _wrong(text, f"{name!r} is no function; {suggest(name, FUNCTIONS)}")
    code, count, words = FUNCTIONS[name]
    if len(node.args) != 1 + count or node.keywords:
        raise _wrong(text, f"the function is {words}")
    constants = [_number(text, argument) for argument in node.args[1:]]
    if name in _DIVIDES and constants[_DIVIDES[name]] <= 0.0:
        raise _wrong(text, f"a width, length or time must be positive: {words}")
    constants += [0.0] * (2 - count)
    return [code, *_argument(text, node.args[0]), *constants, power]


def _argument(text: str, node: ast.expr) -> list[int]:
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return [_variable(text, node.left), _variable(text, node.right)]
    return [_variable(text, node), _NONE]


def _variable(text: str, node: ast.expr) -> int:
    name = node.id if isinstance(node, ast.Name) else ast.unparse(node)
    if name not in VARIABLES:
        raise _wrong(text, f"{name!r} is no variable; {suggest(name, VARIABLES)}")
    return VARIABLES[name]


def _number(text: str, node: ast.expr) -> float:
    try:
        value = ast.literal_eval(node)
    except ValueError:
        value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise _wrong(text, f"{ast.unparse(node)!r} is no number")
    return float(value)


def _wrong(text: str, why: str) -> ValueError:
    return ValueError(
        f"formula {text!r}: {why}; write '1' or a product such as 'velocity * abs(velocity)' of"
        f" variables and of {', '.join(FUNCTIONS)}"
    )
