"""Laws: functions of a drive's state that add to its force, flow or command.

    @law
    def quadratic_drag(s, coefficient):
        return -coefficient * s.velocity * abs(s.velocity)

The first argument of a law is the `DriveState`; the others are its parameters. The return value is
added to the balance of the term: force [N] or [N m], flow into a chamber [m^3/s], or command. numba
compiles the function when a machine that uses it is simulated; it may therefore use numbers, `math`
and other compiled functions only. A parameter is a number by default. An argument annotated as
`Variable` is the name of a state variable in the file and its index in the call. An argument
annotated as `Numbers` is a list in the file and an array in the call. Default values of arguments
apply to omitted parameters.

The law `formula` evaluates sums of products of basic functions, given in machine files:

    parameters: {"1": 40.0, "velocity * abs(velocity)": -310.0,
                 "bump(position, 0.4, 0.05) * sign(velocity, 0.005)": -900.0}

The factors of a product are joined by `*`, each with an optional power up to `** 6`. A factor is an
argument or a function of an argument. An argument is a variable of `DriveState` or a difference of
two variables.
"""

import ast
import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.datafile import (
    MAX_MAGNITUDE,
    suggest_valid_name,
)
from hydrotele.core.errors import InputError
from hydrotele.terms.drive_state import VARIABLES, DriveState, suggest_valid_variable


class Variable(int):
    """Annotation of a law's argument that selects a state variable.

    Machine files give the variable's name; the compiled law receives its index in `DriveState`.
    """


class Numbers(np.ndarray):
    """Annotation of a law's argument that is a list of numbers, passed as a flat array."""


Parameters = Mapping[str, Any]
_KINDS = (float, Variable, Numbers)


@dataclass(frozen=True)
class Law:
    """A registered law: its function, and how to check and encode its parameters.

    Attributes:
        name: name of the law in machine files.
        function: `(state, *parameters) -> float`.
        kinds: argument name -> float, Variable or Numbers, in the order of the arguments.
        defaults: values of optional arguments.
        check: called with the complete parameters; raises ValueError for invalid parameters.
        translate: converts the parameters of a machine file to the arguments of the function; None
            if both are the same.
        source: file or entry point that defines the law; empty for the laws of this package.
    """

    name: str
    function: Callable[..., float]
    kinds: Mapping[str, type]
    defaults: Mapping[str, Any] = field(default_factory=dict)
    check: Callable[[Parameters], None] | None = None
    translate: Callable[[Parameters], Parameters] | None = None
    source: str = ""

    def encode_parameters(self, parameters: Parameters) -> np.ndarray:
        """Encode parameters as the array that is passed to the compiled law.

        Args:
            parameters: parameters as in a machine file.

        Returns:
            (n,) array. Its first element is n. The arguments follow in order: the value of a float,
            the index of a Variable, or the start and stop index of a list in this array. The
            contents of all lists follow at the end.

        Raises:
            ValueError: a parameter is missing, unknown or of the wrong kind; lists the valid ones.
        """
        given = dict(self.translate(parameters)) if self.translate else dict(parameters)
        for name in given.keys() - self.kinds.keys():
            raise ValueError(f"law {self.name}: unknown parameter {name!r}; {suggest_valid_name(name, self.kinds)}")
        given = {**self.defaults, **given}
        if missing := [name for name in self.kinds if name not in given]:
            raise ValueError(f"law {self.name}: missing parameters {', '.join(missing)}")
        if self.check:
            self.check(given)
        size = 1 + sum(2 if kind is Numbers else 1 for kind in self.kinds.values())
        front, back = [0.0], []
        for name, kind in self.kinds.items():
            values = _encode_value(self.name, name, kind, given[name])
            if kind is Numbers:
                front += [size + len(back), size + len(back) + len(values)]
                back += values
            else:
                front += values
        front[0] = size + len(back)
        return np.array(front + back, float)


def _encode_value(law: str, name: str, kind: type, value: Any) -> list[float]:
    """Convert one parameter of a law to a list of numbers.

    `kind` is float, Variable or Numbers. Raise ValueError, with the name of law and parameter, for an
    invalid value.
    """
    where = f"law {law}: parameter {name}"
    if kind is Variable:
        if value not in VARIABLES:
            raise ValueError(f"{where}: {value!r} is not a variable; {suggest_valid_variable(value)}")
        return [float(VARIABLES[value])]
    try:
        flat = np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):  # OverflowError: an integer beyond any float
        flat = np.array(math.nan)
    if not np.isfinite(flat).all() or (kind is float) != (flat.ndim == 0):
        what = "a list of finite numbers" if kind is Numbers else "a finite number"
        raise ValueError(f"{where} must be {what}, not {value!r}")
    return flat.ravel().tolist()


LAWS: dict[str, Law] = {}
"""Laws by name: those of `hydrotele.terms.law`, and those of user files and plug-ins."""

_law_sources: list[str] = []  # stack of the files and plug-ins that are defining laws


def law(
    function: Callable[..., float] | None = None, *,
    check: Callable[[Parameters], None] | None = None,
    translate: Callable[[Parameters], Parameters] | None = None,
) -> Any:  # fmt: skip
    """Register a function as a law under its name; decorator.

    A law adds a force, a flow or a command to a drive of a machine, as a function of its state.

    Args:
        function: `(state, *parameters) -> float`, with annotations as in the module docstring.
        check: function that raises ValueError for invalid parameters.
        translate: function that converts the parameters of a machine file to the arguments.

    Returns:
        The unchanged function, which can also be called from Python with a `DriveState`.

    Raises:
        InputError: the name is already used, or an argument has an invalid annotation.
    """
    if function is None:
        return lambda it: law(it, check=check, translate=translate)
    name, source = function.__name__, _law_sources[-1] if _law_sources else ""
    where = f"{source}: law {name}" if source else f"law {name}"
    if name in LAWS:
        owner = LAWS[name].source or "hydrotele"
        raise InputError(where, f"is already defined by {owner}; choose another name")
    _, *arguments = inspect.signature(function, eval_str=True).parameters.values()
    kinds = {a.name: float if a.annotation is a.empty else a.annotation for a in arguments}
    for argument, kind in kinds.items():
        if kind not in _KINDS:
            raise InputError(where, f"{argument}: {kind!r} is not float, Variable or Numbers")
    defaults = {a.name: a.default for a in arguments if a.default is not a.empty}
    LAWS[name] = Law(name, function, kinds, defaults, check, translate, source)
    return function


class LawSource:  # noqa: N801 - a context manager, named as it is read
    """Context manager that marks the laws registered inside it as those of a given file or plug-in.

    `Law.source` and error messages then name that file or plug-in.
    """

    def __init__(self, source: str) -> None:
        """Store the name of the file or plug-in."""
        self._source = source

    def __enter__(self) -> None:
        _law_sources.append(self._source)

    def __exit__(self, *_: object) -> None:
        _law_sources.pop()


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
"""Basic function -> (its code, number of constants, its definition)."""

_DIVISOR_CONSTANTS = {"sign": 0, "root": 0, "bump": 1, "rise": 0, "sin": 0, "cos": 0}
_NO_FUNCTION, _NO_VARIABLE, _MAX_POWER = 0, -1, 6
_MAX_PRODUCT_LENGTH = 1000  # characters of a product; Python's parser needs stack memory in proportion


def encode_formula(parameters: Mapping[str, float]) -> dict[str, list[float]]:
    """Encode a formula as numbers for the law `formula`.

    Args:
        parameters: product -> coefficient.

    Returns:
        Dictionary with the key `numbers`, a flat list. It starts with the number of products. Each
        product follows as its coefficient, its number of factors, and six numbers per factor:
        function code (0 for none), variable index, index of the variable to subtract (-1 for none),
        two constants, power.

    Raises:
        ValueError: a product cannot be parsed; the message describes the syntax.

    >>> encode_formula({"velocity ** 2": 3.0})["numbers"]
    [1, 3.0, 1, 0, 2, -1, 0.0, 0.0, 2]
    """
    if not parameters:
        raise ValueError("law formula needs at least one product, such as '1' or 'velocity'")
    numbers: list[float] = [len(parameters)]
    for text, coefficient in parameters.items():
        if isinstance(coefficient, bool) or not isinstance(coefficient, int | float):
            raise ValueError(f"formula {text!r}: the coefficient {coefficient!r} is not a number")
        factors = _parse_product(text)
        numbers += [coefficient, len(factors)]
        for factor in factors:
            numbers += factor
    return {"numbers": numbers}


def _parse_product(text: str) -> list[list[float]]:
    """Parse a product such as `velocity * abs(velocity)` into six numbers per factor.

    The product `1` has no factors. Raise ValueError for invalid syntax.
    """
    text = text.strip()
    if len(text) > _MAX_PRODUCT_LENGTH:
        raise _make_formula_error(text, f"it has {len(text)} characters, at most {_MAX_PRODUCT_LENGTH}")
    try:
        node = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError):  # ValueError: a null character
        raise _make_formula_error(text, "it cannot be parsed") from None
    except (RecursionError, MemoryError):  # raised by Python's parser
        raise _make_formula_error(text, "it is nested too deeply") from None
    if _constant_value(node) == 1.0:
        return []
    return [_parse_factor(text, part) for part in _split_factors(node)]


def _split_factors(node: ast.expr) -> list[ast.expr]:
    """Split the syntax tree of a product `a * b * c` into the syntax nodes of its factors."""
    factors, waiting = [], [node]
    while waiting:
        part = waiting.pop()
        if isinstance(part, ast.BinOp) and isinstance(part.op, ast.Mult):
            waiting += [part.right, part.left]
        else:
            factors.append(part)
    return factors


def _parse_factor(text: str, node: ast.expr) -> list[float]:
    """Encode a factor of a product as function code, two variable indices, two constants and power.

    `node` is the syntax tree of the factor; messages quote `text`, the product. Raise ValueError
    for invalid syntax.
    """
    power = 1
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        exponent = _constant_value(node.right)
        if exponent not in range(1, _MAX_POWER + 1):
            raise _make_formula_error(text, f"a power must be a whole number from 1 to {_MAX_POWER}")
        node, power = node.left, int(exponent)
    if not isinstance(node, ast.Call):
        return [_NO_FUNCTION, *_parse_argument(text, node), 0.0, 0.0, power]
    name = node.func.id if isinstance(node.func, ast.Name) else "?"
    if name not in FUNCTIONS:
        raise _make_formula_error(text, f"{name!r} is not a function; {suggest_valid_name(name, FUNCTIONS)}")
    code, count, words = FUNCTIONS[name]
    if len(node.args) != 1 + count or node.keywords:
        raise _make_formula_error(text, f"the function is {words}")
    constants = [_parse_number(text, argument) for argument in node.args[1:]]
    if name in _DIVISOR_CONSTANTS and constants[_DIVISOR_CONSTANTS[name]] <= 0.0:
        raise _make_formula_error(text, f"a width, length or time must be positive: {words}")
    constants += [0.0] * (2 - count)
    return [code, *_parse_argument(text, node.args[0]), *constants, power]


def _parse_argument(text: str, node: ast.expr) -> list[int]:
    """Return the two indices in `DriveState` of the variables of `a - b`; the second is -1 for `a` alone."""
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
        return [_parse_variable(text, node.left), _parse_variable(text, node.right)]
    return [_parse_variable(text, node), _NO_VARIABLE]


def _parse_variable(text: str, node: ast.expr) -> int:
    """Return the index in `DriveState` of the variable that a syntax node names.

    Raise ValueError if it names no variable.
    """
    name = node.id if isinstance(node, ast.Name) else ast.get_source_segment(text, node) or text
    if name not in VARIABLES:
        raise _make_formula_error(text, f"{name!r} is not a variable; {suggest_valid_variable(name)}")
    return VARIABLES[name]


def _parse_number(text: str, node: ast.expr) -> float:
    """Return the value of a numeric constant; raise ValueError for another or too large value."""
    value = _constant_value(node)
    if not abs(value) <= MAX_MAGNITUDE:
        segment = ast.get_source_segment(text, node) or text
        raise _make_formula_error(text, f"{segment!r} is not a number from -{MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}")
    return float(value)


def _constant_value(node: ast.expr) -> float:
    """Return the value of a syntax node that is a number, with or without a sign; otherwise NaN."""
    sign = 1
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        sign, node = -1 if isinstance(node.op, ast.USub) else 1, node.operand
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return sign * node.value  # pyright: ignore[reportOperatorIssue, reportReturnType] - a number
    return math.nan


def _make_formula_error(text: str, why: str) -> ValueError:
    """Create (not raise) the error for a formula that cannot be parsed, with the reason `why`."""
    return ValueError(
        f"formula {text!r}: {why}; write '1' or a product such as 'velocity * abs(velocity)' of"
        f" variables and of {', '.join(FUNCTIONS)}"
    )


@law
def constant(s: DriveState, value: float) -> float:
    """Return a constant additional force, flow or command of a drive.

    `value` has the unit of what it is added to: [N], [N m], [m^3/s], [1] or [V].
    """
    return value


@law
def pulse(s: DriveState, size: float, start: float, duration: float, edge: float = 0.1) -> float:
    """Return a force, flow or command pulse: `size` from `start` [s] for a `duration` [s], otherwise 0.

    The edges are half cosine waves, centred on start and end; their length is the fraction `edge`
    of the duration. The pulse is thus differentiable with respect to every parameter.

    >>> state = DriveState(*[0.0] * 12)
    >>> [pulse(state._replace(time=t), 8.0, 1.0, 2.0) for t in (0.8, 1.0, 2.0, 3.0, 3.2)]
    [0.0, 4.0, 8.0, 4.0, 0.0]
    """
    if duration <= 0.0:
        return 0.0
    half = max(0.5 * edge * duration, 1.0e-9)
    inside = 0.5 * duration - abs(s.time - start - 0.5 * duration)  # from the nearer end [s]
    if inside >= half:
        return size
    if inside <= -half:
        return 0.0
    return size * 0.5 * (1.0 + math.sin(0.5 * math.pi * inside / half))


@law
def ramp(s: DriveState, rate: float, start: float = 0.0) -> float:
    """Return an additional force, flow or command: 0 until `start` [s], then growing by `rate` per s."""
    return rate * max(0.0, s.time - start)


def _check_divisors(given: Parameters) -> None:
    """Raise ValueError for a time constant, width or smoothing range that is not positive; laws divide by them."""
    for name in ("time_constant", "width", "smoothing_velocity", "smoothing"):
        value = given.get(name, 1.0)
        if isinstance(value, (int, float)) and not value > 0.0:
            raise ValueError(f"{name} must be positive, not {value!r}")


@law(check=_check_divisors)
def exponential_drift(s: DriveState, value: float, time_constant: float) -> float:
    """Return an additional force, flow or command that drifts exponentially from 0 to `value`.

    It is `value (1 - exp(-t / time_constant))`, with t the time [s].
    """
    return value * (1.0 - math.exp(-s.time / time_constant))


def _check_increasing_points(given: Parameters, *names: str) -> None:
    """Raise ValueError unless each named parameter is a list of at least two increasing numbers."""
    for name in names:
        points = list(given[name])
        if len(points) < 2 or any(b <= a for a, b in zip(points, points[1:], strict=False)):
            raise ValueError(f"{name} must be at least two increasing numbers, not {points}")


def _flatten(values: Any) -> list[float]:
    return [x for row in values for x in (row if isinstance(row, list | tuple) else [row])]


def _check_table(given: Parameters) -> None:
    _check_increasing_points(given, "points")
    if len(given["values"]) != len(given["points"]):
        raise ValueError(f"values must have as many numbers as points, {len(given['points'])}")


def _check_bilinear_table(given: Parameters) -> None:
    _check_increasing_points(given, "row_points", "column_points")
    rows, columns = len(given["row_points"]), len(given["column_points"])
    if len(_flatten(given["values"])) != rows * columns:
        raise ValueError(f"values must be {rows} rows of {columns} numbers")


@law(check=_check_table)
def linear_table(s: DriveState, variable: Variable, points: Numbers, values: Numbers) -> float:
    """Interpolate an additional force, flow or command linearly in one state variable of a drive.

    `points` [unit of the variable] increase, and `values` are the forces, flows or commands at these
    points. Beyond the first and the last point the value is constant.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 12)._replace(velocity=0.15)
    >>> float(linear_table(state, 2, np.array([0.0, 0.1, 0.2]), np.array([0.0, 10.0, 30.0])))
    20.0
    """
    x, last = s[variable], len(points) - 1
    if x <= points[0]:
        return values[0]
    if x >= points[last]:
        return values[last]
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if points[middle] <= x:
            low = middle
        else:
            high = middle
    part = (x - points[low]) / (points[high] - points[low])
    return values[low] + part * (values[high] - values[low])


@law(check=_check_bilinear_table)
def bilinear_table(
    s: DriveState, row_variable: Variable, column_variable: Variable, row_points: Numbers,
    column_points: Numbers, values: Numbers,
) -> float:  # fmt: skip
    """Interpolate an additional force, flow or command bilinearly in two state variables of a drive.

    A variable beyond its outer points is replaced by the nearest of them.

    `values` has one row for each of the `row_points`, and one column for each of the
    `column_points`; the compiled law receives it row by row.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 12)._replace(position=0.5, velocity=9.0)
    >>> axis = np.array([0.0, 1.0])
    >>> float(bilinear_table(state, 1, 2, axis, axis, np.array([0.0, 1.0, 10.0, 21.0])))
    11.0
    """
    x, y = s[row_variable], s[column_variable]
    columns = len(column_points)
    i, j = 0, 0
    while i < len(row_points) - 2 and x >= row_points[i + 1]:
        i += 1
    while j < columns - 2 and y >= column_points[j + 1]:
        j += 1
    a = (x - row_points[i]) / (row_points[i + 1] - row_points[i])
    b = (y - column_points[j]) / (column_points[j + 1] - column_points[j])
    a, b = min(1.0, max(0.0, a)), min(1.0, max(0.0, b))
    k = i * columns + j
    low = values[k] + b * (values[k + 1] - values[k])
    k += columns
    high = values[k] + b * (values[k + 1] - values[k])
    return low + a * (high - low)


@law(translate=encode_formula)
def formula(s: DriveState, numbers: Numbers) -> float:
    """Evaluate a formula: a sum of products of basic functions, each with a coefficient.

    `numbers` is the encoding of `encode_formula`; the module docstring gives the syntax.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 12)._replace(velocity=-2.0)
    >>> coded = encode_formula({"1": 5.0, "velocity * abs(velocity)": 3.0})
    >>> float(formula(state, np.array(coded["numbers"])))
    -7.0
    """
    at, total = 1, 0.0
    for _ in range(int(numbers[0])):
        product, factors = numbers[at], int(numbers[at + 1])
        at += 2
        for _ in range(factors):
            e = s[int(numbers[at + 1])]
            if numbers[at + 2] >= 0.0:
                e -= s[int(numbers[at + 2])]
            code, a, b = int(numbers[at]), numbers[at + 3], numbers[at + 4]
            if code == 1:
                e = abs(e)
            elif code == 2:
                e = math.tanh(e / a)
            elif code == 3:
                e = e / math.sqrt(math.sqrt(e * e + a * a))
            elif code == 4:
                e = math.exp(-0.5 * ((e - a) / b) ** 2)
            elif code == 5:
                e = max(0.0, e - a)
            elif code == 6:
                e = max(0.0, a - e)
            elif code == 7:
                e = 1.0 - math.exp(-e / a)
            elif code == 8:
                e = math.sin(2.0 * math.pi * e / a)
            elif code == 9:
                e = math.cos(2.0 * math.pi * e / a)
            for _ in range(int(numbers[at + 5])):
                product *= e
            at += 6
        total += product
    return total


def _encode_product(parameters: Parameters) -> Parameters:
    """Encode the text `product` of a `scaled_table` for the law `formula`."""
    given = dict(parameters)
    product = given.pop("product", None)
    if not isinstance(product, str):
        raise ValueError(f"law scaled_table: product must be a text such as 'velocity', not {product!r}")
    return {**given, **encode_formula({product: 1.0})}


_linear_table, _formula = compiled(linear_table), compiled(formula)


@law(check=_check_table, translate=_encode_product)
def scaled_table(s: DriveState, variable: Variable, points: Numbers, values: Numbers, numbers: Numbers) -> float:
    """Multiply a product of basic functions by a coefficient that is a table of one state variable.

    Machine files give `product` (syntax of the module docstring) instead of `numbers`, its encoding. `values` are the
    coefficient at the increasing `points` [unit of the variable]. With `product: sign(velocity, 0.005)` and a table
    over `position` it is Coulomb friction that varies along the travel.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 12)._replace(position=0.5, velocity=2.0)
    >>> product = np.array(encode_formula({"velocity": 1.0})["numbers"])
    >>> float(scaled_table(state, 1, np.array([0.0, 1.0]), np.array([0.0, -10.0]), product))
    -10.0
    """
    return _linear_table(s, variable, points, values) * _formula(s, numbers)


@law
def quadratic_drag(s: DriveState, coefficient: float) -> float:
    """Return a drag force proportional to the square of the speed, `-c v |v|` [N] or [N m].

    c is `coefficient` [N s^2/m^2] or [N m s^2/rad^2], v the velocity of the drive.
    """
    return -coefficient * s.velocity * abs(s.velocity)


@law(check=_check_divisors)
def load_friction(s: DriveState, coefficient: float, smoothing_velocity: float) -> float:
    """Return dry friction of seals and guides that is proportional to the drive's load.

    The force is `-c |F| tanh(v / v0)`: c is `coefficient` [1], F the force of the oil [N] or [N m],
    v the velocity, and v0 the `smoothing_velocity` [m/s] or [rad/s].

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit 1994, Automatica 30(7), load dependence.
    """
    return -coefficient * abs(s.force) * math.tanh(s.velocity / smoothing_velocity)


@law(check=_check_divisors)
def friction_bump(s: DriveState, coulomb: float, centre: float, width: float, smoothing_velocity: float) -> float:
    """Return dry friction around one position, `-F exp(-(x - c)^2 / (2 w^2)) tanh(v / v0)`.

    F is `coulomb` [N] or [N m], x the position, c the `centre` and w the `width` of the friction
    zone [m] or [rad], v the velocity and v0 the `smoothing_velocity` [m/s] or [rad/s].
    """
    far = (s.position - centre) / width
    return -coulomb * math.exp(-0.5 * far * far) * math.tanh(s.velocity / smoothing_velocity)


@law(check=_check_divisors)
def orifice_leakage(s: DriveState, flow_gain: float, smoothing: float) -> float:
    """Return the turbulent leakage from the head-side into the rod-side chamber [m^3/s].

    The flow is `k dp / (dp^2 + d^2)^(1/4)`, that is `k sgn(dp) sqrt(|dp|)` smoothed below d. k is the
    `flow_gain` [m^3/(s sqrt(Pa))], dp the head-side minus the rod-side pressure and d the
    `smoothing` pressure [Pa]. With a negative `flow_gain` it is the flow into the head-side chamber.

    Source: orifice equation, as `hydraulics.laws.orifice_flow`.
    """
    drop = s.pressure_head - s.pressure_rod
    return flow_gain * drop / math.sqrt(math.sqrt(drop * drop + smoothing * smoothing))


@law(check=_check_divisors)
def viscous_drift(s: DriveState, viscous: float, ratio: float, time_constant: float) -> float:
    """Return the change of viscous friction while the oil's viscosity drifts, `-b (m(t) - 1) v`.

    b is the initial coefficient `viscous` [N s/m] or [N m s/rad], and v the velocity. The viscosity
    is m(t) times the initial one, `m = 1 + (r - 1)(1 - exp(-t / T))`, with the final `ratio` r [1]
    and the `time_constant` T [s].
    """
    change = (ratio - 1.0) * (1.0 - math.exp(-s.time / time_constant))
    return -viscous * change * s.velocity


@law(check=_check_divisors)
def leakage_drift(s: DriveState, leakage: float, ratio: float, time_constant: float) -> float:
    """Return the change of laminar leakage while the oil's viscosity drifts [m^3/s].

    The flow into the rod-side chamber changes by `k (1 / m(t) - 1) (p_A - p_B)`, with the initial
    `leakage` k [m^3/(s Pa)] and the head- and rod-side pressures p_A and p_B. m(t) is the viscosity
    relative to the initial one, `1 + (ratio - 1)(1 - exp(-t / time_constant))`. With a negative
    `leakage` it is the change of the flow into the head-side chamber.
    """
    viscosity = 1.0 + (ratio - 1.0) * (1.0 - math.exp(-s.time / time_constant))
    return leakage * (1.0 / viscosity - 1.0) * (s.pressure_head - s.pressure_rod)
