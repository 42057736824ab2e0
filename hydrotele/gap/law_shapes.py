"""Forms that a learned law can have: piecewise linear in one or two variables of a drive."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
_KNOTS = 5  # inner kinks of a law of one variable
_PAIR_KNOTS = 2  # of each variable of a law of two
_TIMES = 7  # of the time in a law of two variables: what acts for a while begins and ends somewhere
_DROP = "pressure_head - pressure_rod"
_VARIABLES: Mapping[str, tuple[str, ...]] = {
    "force": ("velocity", "position", "command", "force", "time"),
    "flow_head": (_DROP, "pressure_head", "pressure_rod", "spool", "pump_speed", "velocity",
                  "position", "pressure_supply", "time"),
    "flow_rod": (_DROP, "pressure_rod", "pressure_head", "spool", "pump_speed", "velocity",
                 "position", "pressure_supply", "time"),
    THROUGH: (_DROP, "position", "spool", "pump_speed", "velocity", "time"),
    "command": ("command", "spool", "velocity", "position", "force",
                "pressure_supply", "time"),
}  # fmt: skip


class Shape(NamedTuple):
    """A form that a law can have: piecewise linear in one variable times a factor, or in two.

    Attributes:
        variable: a variable of `DriveState`, or a difference of two.
        factor: what it is multiplied by: empty, `sign(velocity, v0)` or `velocity`.
        knots: where it kinks.
        other: a second variable; the law is then a sum of products of both (bilinear in every
            cell of their knots). Empty for none.
        other_knots: where it kinks over the second variable.
        chosen: which of the products it has; all if empty.
    """

    variable: str
    factor: str
    knots: tuple[float, ...]
    other: str = ""
    other_knots: tuple[float, ...] = ()
    chosen: tuple[int, ...] = ()

    @property
    def kind(self) -> tuple[str, str, str]:
        """Variable, factor and second variable."""
        return self.variable, self.factor, self.other

    @property
    def name(self) -> str:
        """On what it depends, without blanks: such as `position*velocity` or `spool,time`."""
        text = self.variable
        if self.factor:
            text += "*sign(velocity)" if self.factor.startswith("sign") else f"*{self.factor}"
        if self.other:
            text += f",{self.other}"
        return text.replace(" ", "")

    @property
    def variables(self) -> list[str]:
        """The variables of the drive's state on which it depends, without that of the factor."""
        return [v for part in (self.variable, self.other) if part for v in part.split(" - ")]

    @property
    def products(self) -> list[str]:
        """The products of basic functions, one per coefficient, as `terms.formula` reads them."""
        found = _hinges(self.variable, self.knots)
        if self.factor:
            found = [_times(p, self.factor) for p in found]
        if self.other:
            found = [_times(p, q) for p in found for q in _hinges(self.other, self.other_knots)]
        return [found[k] for k in self.chosen] if self.chosen else found

    def with_products(self, chosen: Sequence[int]) -> "Shape":
        """With some of the products, and without a variable that none of these has."""
        if self.other:
            count = 2 + len(self.other_knots)
            first, second = zip(*(divmod(k, count) for k in chosen), strict=True)
            if not any(second):
                return Shape(self.variable, self.factor, self.knots, chosen=first)
            if not any(first) and not self.factor:
                return Shape(self.other, "", self.other_knots, chosen=second)
        return self._replace(chosen=tuple(chosen))

    def columns(self, values: Mapping[str, np.ndarray], smoothing: float) -> np.ndarray:
        """(n, K) the products along data."""
        found = _hinge_columns(self.variable, self.knots, values)
        if self.factor.startswith("sign"):
            found *= np.tanh(values["velocity"] / smoothing)[:, None]
        elif self.factor:
            found *= values[self.factor][:, None]
        if self.other:
            across = _hinge_columns(self.other, self.other_knots, values)
            found = (found[:, :, None] * across[:, None]).reshape(len(found), -1)
        return found[:, list(self.chosen)] if self.chosen else found


def _hinges(variable: str, knots: Sequence[float]) -> list[str]:
    """The functions that a piecewise linear law of a variable is a sum of."""
    line = f"({variable})" if " - " in variable else variable
    return ["1", line, *(f"above({variable}, {_number(k)})" for k in knots)]


def _times(a: str, b: str) -> str:
    return b if a == "1" else a if b == "1" else f"{a} * {b}"


def _hinge_columns(
    variable: str, knots: Sequence[float], values: Mapping[str, np.ndarray]
) -> np.ndarray:
    a, _, b = variable.partition(" - ")
    x = values[a] - values[b] if b else values[a]
    return np.column_stack([np.ones_like(x), x, *(np.maximum(0.0, x - k) for k in knots)])


def _number(value: float) -> str:
    return f"{value:.6g}"


def possible_shapes(
    balance: str, values: Sequence[Mapping[str, np.ndarray]], smoothing: float
) -> list[Shape]:
    """Every form that a law of a balance can have, with kinks where the data lie.

    Args:
        balance: force, flow_head, flow_rod, `THROUGH` or command.
        values: per run variable -> (n,) values of the drive.
        smoothing: of the sign of its velocity [m/s] or [rad/s].

    Returns:
        The forms, those of one variable first.
    """
    found, single = [], {}
    sign = f"sign(velocity, {_number(smoothing)})"
    for variable in _VARIABLES[balance]:
        a, _, b = variable.partition(" - ")
        if a not in values[0] or (b and b not in values[0]):
            continue
        x = np.concatenate([v[a] - v[b] if b else v[a] for v in values])
        x = x[np.isfinite(x)]
        if len(x) < 10 * _KNOTS or np.ptp(x) == 0.0:
            continue
        at_rest = {0.0} if variable == "velocity" else set()
        knots = tuple(sorted({*_knots(x, _KNOTS), *at_rest}))
        factors = (
            ("",) if variable == "velocity" or balance == "command" else ("", sign, "velocity")
        )
        found += [Shape(variable, factor, knots) for factor in factors]
        count = _TIMES if variable == "time" else _PAIR_KNOTS
        single[variable] = tuple(sorted({*_knots(x, count), *at_rest}))
    for a, b in itertools.combinations(single, 2):
        if not set(a.split(" - ")) & set(b.split(" - ")):
            found.append(Shape(a, "", single[a], b, single[b]))
    return found


def _knots(x: np.ndarray, count: int) -> tuple[float, ...]:
    """Kinks between the ends of what data hold, half-way between evenly and by quantiles."""
    low, high = np.quantile(x, [0.02, 0.98])
    edges = np.quantile(x, np.linspace(0.02, 0.98, count + 2)[1:-1])
    even = np.linspace(low, high, count + 2)[1:-1]
    return tuple(sorted({float(_number(k)) for k in 0.5 * (edges + even)}))
