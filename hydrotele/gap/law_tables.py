"""Forms that a learned law can have: a table over one or two variables, linear in between."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from hydrotele.estimate.hypothesis import Hypothesis

THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
OWN_VARIABLES = (
    "velocity", "position", "command", "force", "pressure_head", "pressure_rod", "spool",
    "pump_speed", "pressure_supply", "time",
)  # fmt: skip


class Table(NamedTuple):
    """A form that a law can have: entries at points of one or two variables.

    Attributes:
        variables: one or two of a drive's state; those of another drive with its axis, such as
            `velocity.swing`.
        points: rising points of each [its unit].
    """

    variables: tuple[str, ...]
    points: tuple[tuple[float, ...], ...]

    @property
    def name(self) -> str:
        """On what it depends, such as `spool,time`."""
        return ",".join(self.variables)

    @property
    def size(self) -> int:
        """Number of its entries K."""
        return int(np.prod([len(points) for points in self.points]))

    @property
    def of(self) -> dict[str, str]:
        """Variable -> the drive that it is of, where that is not the law's own."""
        return dict(v.split(".") for v in self.variables if "." in v)

    def columns(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, K) shares of the entries along a run; row by row they add to 1."""
        entries, weights = self.weights(values)
        found = np.zeros((len(entries), self.size))
        np.put_along_axis(found, entries, weights, axis=1)
        return found

    def weights(self, values: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) or (n, 4) entries that have a share in a row of a run, and these shares."""
        entries, weights = _weights(values[self.variables[0]], self.points[0])
        if len(self.variables) == 2:
            across, shares = _weights(values[self.variables[1]], self.points[1])
            entries = entries[:, :, None] * len(self.points[1]) + across[:, None]
            weights = weights[:, :, None] * shares[:, None]
            entries, weights = entries.reshape(len(across), -1), weights.reshape(len(across), -1)
        return entries, weights

    def law(self, entries: np.ndarray) -> dict[str, Any]:
        """Law, parameters and variables of a term with some entries (K,)."""
        plain, points = [v.partition(".")[0] for v in self.variables], self.points
        if len(plain) == 1:
            table = {"variable": plain[0], "points": points[0], "values": tuple(entries.tolist())}
            return {"law": "linear_table", "parameters": table, "variables_from": self.of}
        rows = entries.reshape(len(points[0]), -1)
        table = {
            "row_variable": plain[0], "column_variable": plain[1], "row_points": points[0],
            "column_points": points[1], "values": tuple(tuple(row) for row in rows.tolist()),
        }  # fmt: skip
        return {"law": "bilinear_table", "parameters": table, "variables_from": self.of}


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


def _weights(x: np.ndarray, points: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) points and weights of linear interpolation, constant beyond the ends."""
    at = np.asarray(points)
    x = np.clip(np.nan_to_num(x), at[0], at[-1])
    low = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    part = (x - at[low]) / (at[low + 1] - at[low])
    return np.stack([low, low + 1], axis=1), np.stack([1.0 - part, part], axis=1)
