"""The laws of this package that terms can use; numba compiles them, each by itself.

Every law is a function of a `DriveState` s and of its parameters, and returns what it adds to the
balance of its term: force [N] or [N m], flow into a chamber [m^3/s], or command. The unit of a
parameter follows from that.
"""

import math
from typing import Any

from hydrotele.terms.formula import formula_arguments
from hydrotele.terms.law import DriveState, Numbers, Parameters, Variable, law


@law
def constant(s: DriveState, value: float) -> float:
    """A constant value."""
    return value


@law
def pulse(s: DriveState, size: float, start: float, duration: float, edge: float = 0.1) -> float:
    """A value from `start` [s] for a `duration` [s].

    Its edges are half waves of a cosine, `edge` of the duration long and centred on its ends, so
    that a derivative with respect to every parameter exists.

    >>> state = DriveState(*[0.0] * 10)
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
    """A value that grows by `rate` per second from `start` [s] on."""
    return rate * max(0.0, s.time - start)


@law
def exponential_drift(s: DriveState, value: float, time_constant: float) -> float:
    """A value that is approached from zero as `1 - exp(-t / time_constant)`."""
    return value * (1.0 - math.exp(-s.time / time_constant))


def _check_points(given: Parameters, *names: str) -> None:
    for name in names:
        points = list(given[name])
        if len(points) < 2 or any(b <= a for a, b in zip(points, points[1:], strict=False)):
            raise ValueError(f"{name} must be at least two numbers that rise, not {points}")


def _flat(values: Any) -> list[float]:
    return [x for row in values for x in (row if isinstance(row, list | tuple) else [row])]


def _check_table(given: Parameters) -> None:
    _check_points(given, "points")
    if len(given["values"]) != len(given["points"]):
        raise ValueError(f"{len(given['points'])} points need as many values")


def _check_table2(given: Parameters) -> None:
    _check_points(given, "row_points", "column_points")
    rows, columns = len(given["row_points"]), len(given["column_points"])
    if len(_flat(given["values"])) != rows * columns:
        raise ValueError(f"values must be {rows} rows of {columns} numbers")


@law(check=_check_table)
def linear_table(s: DriveState, variable: Variable, points: Numbers, values: Numbers) -> float:
    """Linear interpolation in one variable, constant beyond the first and the last point.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 10)._replace(velocity=0.15)
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


@law(check=_check_table2)
def table2(
    s: DriveState, row_variable: Variable, column_variable: Variable, row_points: Numbers,
    column_points: Numbers, values: Numbers,
) -> float:  # fmt: skip
    """Bilinear interpolation in two variables, constant beyond the outer points.

    `values` has a row for each of the `row_points`.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 10)._replace(position=0.5, velocity=9.0)
    >>> axis = np.array([0.0, 1.0])
    >>> float(table2(state, 1, 2, axis, axis, np.array([0.0, 1.0, 10.0, 21.0])))
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


@law(translate=formula_arguments)
def formula(s: DriveState, numbers: Numbers) -> float:
    """A sum of coefficients times products of basic functions; see `hydrotele.terms.formula`.

    >>> import numpy as np
    >>> state = DriveState(*[0.0] * 10)._replace(velocity=-2.0)
    >>> coded = formula_arguments({"1": 5.0, "velocity * abs(velocity)": 3.0})
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


@law
def quadratic_drag(s: DriveState, coefficient: float) -> float:
    """Resistance that grows with the square of the speed, `-c v |v|`."""
    return -coefficient * s.velocity * abs(s.velocity)


@law
def load_friction(s: DriveState, coefficient: float, smoothing_velocity: float) -> float:
    """Dry friction in proportion to the load, `-c |F| tanh(v / v0)`: seals and guides under load.

    Source: Armstrong-Helouvry, Dupont and Canudas de Wit 1994, Automatica 30(7), load dependence.
    """
    return -coefficient * abs(s.force) * math.tanh(s.velocity / smoothing_velocity)


@law
def friction_bump(
    s: DriveState, coulomb: float, centre: float, width: float, smoothing_velocity: float
) -> float:
    """Dry friction at one place of the travel, `-F exp(-(x - c)^2 / (2 w^2)) tanh(v / v0)`."""
    far = (s.position - centre) / width
    return -coulomb * math.exp(-0.5 * far * far) * math.tanh(s.velocity / smoothing_velocity)


@law
def orifice_leakage(s: DriveState, flow_gain: float, smoothing: float) -> float:
    """Turbulent flow into the rod-side chamber, `k sgn(dp) sqrt(|dp|)` made smooth through zero.

    With a negative `flow_gain` it is the flow into the head-side chamber.

    Source: as `hydraulics.laws.orifice`.
    """
    drop = s.pressure_head - s.pressure_rod
    return flow_gain * drop / math.sqrt(math.sqrt(drop * drop + smoothing * smoothing))


@law
def viscous_drift(s: DriveState, viscous: float, ratio: float, time_constant: float) -> float:
    """Change of viscous friction b v with the oil's viscosity, `-b (m(t) - 1) v`.

    The viscosity is m(t) times the first one, `m = 1 + (r - 1)(1 - exp(-t / T))`.
    """
    change = (ratio - 1.0) * (1.0 - math.exp(-s.time / time_constant))
    return -viscous * change * s.velocity


@law
def leakage_drift(s: DriveState, leakage: float, ratio: float, time_constant: float) -> float:
    """Change of the laminar leakage into the rod-side chamber, `k (1 / m(t) - 1) (p_A - p_B)`.

    With a negative `leakage` it is the flow into the head-side chamber; m as in `viscous_drift`.
    """
    viscosity = 1.0 + (ratio - 1.0) * (1.0 - math.exp(-s.time / time_constant))
    return leakage * (1.0 / viscosity - 1.0) * (s.pressure_head - s.pressure_rod)
