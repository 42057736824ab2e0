"""Forms that a learned law can have: a table over one or two variables, linear in between.

It may see a variable through a play, or be switched by one, as a relay with hysteresis does.

Regression of prediction errors on the entries of a law's table, judged by parts of runs left out.

The errors are those of a track whose unknown inputs have taken up what they could; how they answer
to an addition is known to first order (`estimate.track`). So a reading counts as it does in the
likelihood, and a law that is faster than the unknown inputs is seen as it is, not as a smoother
blurs it. Entries that follow each other are taken to be alike (P-splines, Eilers and Marx 1996).
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.terms.table import PLAY, SWITCH, update_hysteresis, window_factor

THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
_STEEP = 0.3  # precision of first differences, in units of the lack: beyond what the data tell a
# law goes on as it is there, not as steeply as it was
_SHRINK = 0.1  # precision of an entry, in units of the lack: what no data tells is nothing
OWN_VARIABLES = (
    "velocity", "position", "command", "force", "pressure_head", "pressure_rod", "spool",
    "pump_speed", "pressure_supply", "time",
)  # fmt: skip


PLAYED, AHEAD = "play_output", "play_difference"
"""What a law's play lets through of its variable, and by how much the variable is ahead of it."""


class Memory(NamedTuple):
    """How a law remembers a variable.

    Attributes:
        way: PLAY or SWITCH of `terms.table`.
        variable: as of a table [its unit].
        begin: 0 of a play; where a switch goes off.
        end: half width of a play; where a switch goes on.
    """

    way: int
    variable: str
    begin: float
    end: float

    def along(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n,) what is remembered along a run [1], see `terms.table.remembered`."""
        x = (np.asarray(values[self.variable], float) - self.begin) / (self.end - self.begin)
        return _along(self.way, x)

    def seen(self, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """What a law sees of it along a run, (n,) each: `PLAYED` and `AHEAD` of a play."""
        if self.way != PLAY:
            return {}
        played = self.end * self.along(values)
        return {PLAYED: played, AHEAD: np.asarray(values[self.variable]) - played}

    @property
    def facts(self) -> dict[str, dict[str, Any]]:
        """Keys of a term."""
        plain = self.variable.partition(".")[0]
        if self.way == PLAY:
            return {"play": {"variable": plain, "half_width": self.end}}
        return {"switch": {"variable": plain, "on": self.end, "off": self.begin}}


@compiled
def _along(way, x):
    """What is remembered after each of (n,) values; what is not known changes nothing."""
    held, out = 0.0, np.empty(len(x))
    for k in range(len(x)):
        if np.isfinite(x[k]):
            held = update_hysteresis(way, held, x[k])
        out[k] = held
    return out


class Table(NamedTuple):
    """A form that a law can have: entries at points of one or two variables.

    Attributes:
        variables: one or two of a drive's state; those of another drive with its axis, such as
            `velocity.swing`; `PLAYED` and `AHEAD` of a play.
        points: rising points of each [its unit].
        window: times between which it acts [s]; empty for always.
        memory: what it remembers, if it does.
    """

    variables: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]
    window: tuple[float, ...] = ()
    memory: Memory | None = None

    @property
    def kind(self) -> tuple[tuple[str, ...], bool, int]:
        """Variables, whether it acts for a while only, and in what way it remembers."""
        return self.variables, bool(self.window), self.memory.way if self.memory else 0

    @property
    def name(self) -> str:
        """On what it depends, such as `spool,time`."""
        text = ",".join(self.variables)
        if self.memory:
            m = self.memory
            text += f"@{m.variable}~{m.end:.4g}" + (f"/{m.begin:.4g}" if m.begin else "")
        return text + (f"@{self.window[0]:.4g}-{self.window[1]:.4g}" if self.window else "")

    @property
    def size(self) -> int:
        """Number of its entries K."""
        return int(np.prod([len(points) for points in self.points]))

    @property
    def of(self) -> dict[str, str]:
        """Variable -> the drive that it is of, where that is not the law's own."""
        named = (*self.variables, *([self.memory.variable] if self.memory else []))
        return dict(v.split(".") for v in named if "." in v)

    def columns(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, K) shares of the entries along a run; row by row they add to 1 where the law acts."""
        entries, weights = self.weights(values)
        found = np.zeros((len(entries), self.size))
        np.put_along_axis(found, entries, weights, axis=1)
        return found

    def weights(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) or (n, 4) entries that have a share in a row of a run, and these shares."""
        held = self.memory.along(values) if self.memory else None
        if held is not None and self.memory and self.memory.way == PLAY:
            values = {**values, **self.memory.seen(values)}
        entries, weights = _weights(values[self.variables[0]], self.points[0])
        if len(self.variables) == 2:
            across, shares = _weights(values[self.variables[1]], self.points[1])
            entries = entries[:, :, None] * len(self.points[1]) + across[:, None]
            weights = weights[:, :, None] * shares[:, None]
            entries, weights = entries.reshape(len(across), -1), weights.reshape(len(across), -1)
        if held is not None and self.memory and self.memory.way == SWITCH:
            weights = weights * held[:, None]
        if self.window:
            weights = weights * window_factor(values["time"], *self.window)[:, None]
        return entries, weights

    def precision(self, smoothness: float) -> np.ndarray:
        """(K, K) prior precision of the entries: of their differences, and of each."""
        counts = tuple(map(len, self.points))
        bent, steep = (_differences(counts, order) for order in (2, 1))
        return smoothness * bent + _STEEP * steep + _SHRINK * np.eye(self.size)

    def law(self, entries: np.ndarray) -> dict[str, Any]:
        """Law, parameters, variables and window of a term with some entries (K,)."""
        plain, points = [v.partition(".")[0] for v in self.variables], self.points
        where = {"variables_from": self.of, "window": self.window or None}
        where |= self.memory.facts if self.memory else {}
        if len(plain) == 1:
            table = {"variable": plain[0], "points": points[0], "values": tuple(entries.tolist())}
            return {"law": "linear_table", "parameters": table, **where}
        rows = entries.reshape(len(points[0]), -1)
        table = {
            "row_variable": plain[0], "column_variable": plain[1], "row_points": points[0],
            "column_points": points[1], "values": tuple(tuple(row) for row in rows.tolist()),
        }  # fmt: skip
        return {"law": "bilinear_table", "parameters": table, **where}


@dataclass(frozen=True)
class Learned:
    """A fitted law or profile.

    Attributes:
        hypothesis: the machine with it.
        balance: force, flow_head, flow_rod, `THROUGH`, command or `SUPPLY`.
        axis: of the drive.
        table: its form.
        entries: (K,) of the table [unit of the balance].
        covariance: (K, K) of the entries.
        smoothing: of the sign of the velocity [m/s] or [rad/s].
        seen: variable -> values along the fit runs.
        form_of: library effect whose coefficient it is; empty of a law without a known cause.
    """

    hypothesis: Hypothesis
    balance: str
    axis: str
    table: Table
    entries: np.ndarray
    covariance: np.ndarray
    smoothing: float
    seen: Mapping[str, np.ndarray] = field(repr=False)
    form_of: str = ""


@functools.cache
def _differences(counts: tuple[int, ...], order: int) -> np.ndarray:
    """(K, K) products of differences of entries with so many points of each variable.

    Args:
        counts: of points.
        order: of the differences.
    """
    found = np.zeros((1, 1))
    for count in counts:
        each = np.diff(np.eye(count), order, axis=0)
        own = np.kron(np.eye(len(found)), each.T @ each)
        found = np.kron(found, np.eye(count)) + own
    return found


def _weights(x: np.ndarray, points: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) points and weights of linear interpolation, constant beyond the ends."""
    at = np.asarray(points)
    x = np.clip(np.nan_to_num(x), at[0], at[-1])
    low = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    part = (x - at[low]) / (at[low + 1] - at[low])
    return np.stack([low, low + 1], axis=1), np.stack([1.0 - part, part], axis=1)
