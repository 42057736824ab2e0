"""Forms that a learned law can have: a table over one or two variables, linear in between."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hydrotele.terms.facts import OF_A_DRIVE
from hydrotele.terms.table import acting

THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
_POINTS = 14  # of a table over one variable; what keeps them alike is in the regression
_PAIR_POINTS = 10  # over each of two
_TIMES = 10  # over time: what acts for a while begins and ends somewhere
_SHRINK = 0.1  # precision of an entry, in units of the lack: what no data tells is nothing
_OWN = (
    "velocity", "position", "command", "force", "pressure_head", "pressure_rod", "spool",
    "pump_speed", "pressure_supply", "time",
)  # fmt: skip


class Table(NamedTuple):
    """A form that a law can have: entries at points of one or two variables.

    Attributes:
        variables: one or two of a drive's state; those of another drive with its axis, such as
            `velocity.swing`.
        points: rising points of each [its unit].
        window: times between which it acts [s]; empty for always.
    """

    variables: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]
    window: tuple[float, ...] = ()

    @property
    def kind(self) -> tuple[tuple[str, ...], bool]:
        """Variables, and whether it acts for a while only."""
        return self.variables, bool(self.window)

    @property
    def name(self) -> str:
        """On what it depends, such as `spool,time`."""
        text = ",".join(self.variables)
        return text + (f"@{self.window[0]:.4g}-{self.window[1]:.4g}" if self.window else "")

    @property
    def size(self) -> int:
        """Number of its entries K."""
        return int(np.prod([len(points) for points in self.points]))

    @property
    def of(self) -> dict[str, str]:
        """Variable -> the drive that it is of, where that is not the law's own."""
        return dict(v.split(".") for v in self.variables if "." in v)

    def columns(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, K) shares of the entries along data; row by row they add to 1 where the law acts."""
        found = _shares(values[self.variables[0]], self.points[0])
        if len(self.variables) == 2:
            across = _shares(values[self.variables[1]], self.points[1])
            found = (found[:, :, None] * across[:, None]).reshape(len(found), -1)
        if self.window:
            found *= acting(values["time"], *self.window)[:, None]
        return found

    def precision(self, smoothness: float) -> np.ndarray:
        """(K, K) prior precision of the entries: of their second differences, and of each."""
        found = np.zeros((1, 1))
        for points in self.points:
            bends = np.diff(np.eye(len(points)), 2, axis=0)
            own = np.kron(np.eye(len(found)), bends.T @ bends)
            found = np.kron(found, np.eye(len(points))) + own
        return smoothness * found + _SHRINK * np.eye(self.size)

    def law(self, entries: np.ndarray) -> dict[str, Any]:
        """Law, parameters, variables and window of a term with some entries (K,)."""
        plain, points = [v.partition(".")[0] for v in self.variables], self.points
        where = {"of": self.of, "window": self.window or None}
        if len(plain) == 1:
            table = {"variable": plain[0], "points": points[0], "values": tuple(entries.tolist())}
            return {"law": "linear_table", "parameters": table, **where}
        rows = entries.reshape(len(points[0]), -1)
        table = {
            "row_variable": plain[0], "column_variable": plain[1], "row_points": points[0],
            "column_points": points[1], "values": tuple(tuple(row) for row in rows.tolist()),
        }  # fmt: skip
        return {"law": "table2", "parameters": table, **where}


def _shares(x: np.ndarray, points: Sequence[float]) -> np.ndarray:
    """(n, K) weights of linear interpolation, constant beyond the ends."""
    at = np.asarray(points)
    x = np.clip(np.nan_to_num(x), at[0], at[-1])
    low = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    part = (x - at[low]) / (at[low + 1] - at[low])
    found, rows = np.zeros((len(x), len(at))), np.arange(len(x))
    found[rows, low], found[rows, low + 1] = 1.0 - part, part
    return found


def possible_tables(
    values: Sequence[Mapping[str, np.ndarray]], smoothing: float,
    window: tuple[float, ...] = (),
) -> list[Table]:  # fmt: skip
    """Every table over one variable that a law can have.

    Args:
        values: per run variable -> (n,) values of the drive, and of others (`velocity.swing`).
        smoothing: of the sign of the drive's velocity [m/s] or [rad/s]; friction has points there.
        window: in which they act.

    Returns:
        The tables.
    """
    points = {n: _points(n, values, _POINTS, smoothing, window) for n in _names(values)}
    return [Table((n,), (p,), window) for n, p in points.items() if p]


def paired_tables(
    values: Sequence[Mapping[str, np.ndarray]],
    smoothing: float,
    others: bool,
    window: tuple[float, ...] = (),
) -> list[Table]:
    """Every table over two variables that a law can have.

    Args:
        values: as of `possible_tables`.
        smoothing: as of `possible_tables`.
        others: whether variables of other drives are among them.
        window: in which they act.

    Returns:
        The tables; none has two variables that only their drives tell apart.
    """
    names = [n for n in _names(values) if others or "." not in n]
    points = {n: _points(n, values, _PAIR_POINTS, smoothing, window) for n in names}
    pairs = itertools.combinations([n for n in names if points[n]], 2)
    return [
        Table((a, b), (points[a], points[b]), window) for a, b in pairs
        if a.partition(".")[0] != b.partition(".")[0]
        and a.partition(".")[2] in ("", b.partition(".")[2] or a.partition(".")[2])
    ]  # fmt: skip


def _names(values: Sequence[Mapping[str, np.ndarray]]) -> list[str]:
    others = [n for n in values[0] if "." in n and n.partition(".")[0] in OF_A_DRIVE]
    return [n for n in (*_OWN, *others) if n in values[0]]


def _points(
    name: str, values: Sequence[Mapping[str, np.ndarray]], count: int, smoothing: float,
    window: tuple[float, ...],
) -> tuple[float, ...]:  # fmt: skip
    """Points of a variable, half-way between evenly and by quantiles; none if it never moves.

    Those of the time lie evenly in the window, if there is one.
    """
    if name == "time" and window:
        begin, end = window
        return tuple(np.linspace(begin, end, _TIMES).tolist())
    x = np.concatenate([v[name] for v in values])
    x = x[np.isfinite(x)]
    if len(x) < 10 * count or np.ptp(x) == 0.0:
        return ()
    count = _TIMES if name == "time" else count
    low, high = np.quantile(x, [0.01, 0.99])
    found = np.quantile(x, np.linspace(0.01, 0.99, count)) + np.linspace(low, high, count)
    points = set((0.5 * found).tolist())
    if name == "velocity" and low < -2.0 * smoothing and high > 2.0 * smoothing:
        points = {p for p in points if abs(p) > 2.0 * smoothing} | {-smoothing, smoothing}
    rounded = sorted({float(f"{p:.6g}") for p in points})
    return tuple(rounded) if len(rounded) > 1 else ()
