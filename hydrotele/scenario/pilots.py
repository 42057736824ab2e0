"""Specification of the pilot, the source of the motion of a run.

The source is a table of commands, a reference path, or a person at a joystick.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from hydrotele.core.datafile import (
    Name,
    NonNegativeFloat,
    PositiveFloat,
    StrictModel,
)
from hydrotele.core.files import describe_excess
from hydrotele.scenario.teleoperation import TeleopPilot


class Pose(StrictModel):
    """Pose of the arm's tip in cylindrical coordinates about the swing axis.

    `r` is the distance from the axis and `z` the height above ground [m]. `theta` is the swing angle,
    `attitude` the pitch of the tool and `head` its rotation [rad]; not all arms have the last two.
    """

    r: PositiveFloat
    z: float
    theta: float = 0.0
    attitude: float | None = None
    head: float | None = None


class ConstantPilot(StrictModel):
    """Constant commands to valves or drives, open loop: axis -> command [1] or [V]."""

    kind: Literal["constant"]
    commands: dict[Name, float] = {}


class TablePilot(StrictModel):
    """Commands or references from a table over time, given as columns or in a log file.

    `quantity: command` drives the valves open loop, `quantity: joint` gives joint references [rad]
    or [m]. `file` is a CSV or Parquet log, of which the columns `command.<axis>` or
    `reference.<axis>` (otherwise `angle.<axis>`, `position.<axis>`) are used. `interpolate` holds
    the last value or connects the values linearly.
    """

    renamed = {"of": "quantity"}

    kind: Literal["table"]
    quantity: Literal["command", "joint"] = "command"
    time: list[NonNegativeFloat] = []
    columns: dict[Name, list[float]] = {}
    file: str | None = None
    interpolate: Literal["hold", "linear"] = "hold"

    @model_validator(mode="after")
    def _check(self):
        if bool(self.file) == bool(self.columns):
            raise ValueError("give either columns (with time) or file")
        for name, values in self.columns.items():
            if len(values) != len(self.time):
                raise ValueError(f"columns.{name} has {len(values)} values, time has {len(self.time)}")
        if self.columns and (not self.time or self.time[0] != 0.0 or any(_find_nonrising_steps(self.time))):
            raise ValueError("time must start at 0 and rise strictly")
        return self


def _find_nonrising_steps(values) -> list[bool]:
    return [b <= a for a, b in zip(values, values[1:], strict=False)]


def check_size_limit(name: str, amount: float) -> None:
    """Raise ValueError if an amount exceeds the input limit of that name."""
    if said := describe_excess(name, amount):
        raise ValueError(f"has {said}")


class FourierSeries(StrictModel):
    """Fourier series of one joint's reference: `mean + sum_k (sin_k sin(k w t) + cos_k cos(k w t))`.

    k counts from 1, w is 2 pi over the common period, and all coefficients are in [rad] or [m].
    """

    mean: float = 0.0
    sin: list[float] = []
    cos: list[float] = []


class FourierPilot(StrictModel):
    """Periodic joint references as Fourier series with a common `period` [s].

    They are faded in from the start position over `fade` [s].

    The servo holds axes without a reference at their start, except those in `closed_valves`, whose
    command is always 0.
    """

    kind: Literal["fourier"]
    period: PositiveFloat
    fade: NonNegativeFloat = 2.0
    axes: dict[Name, FourierSeries]
    closed_valves: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _check(self):
        if both := sorted(set(self.closed_valves) & self.axes.keys()):
            raise ValueError(f"closed_valves: {both[0]} also has a reference in axes; name it in one of them")
        counts = [max(len(axis.sin), len(axis.cos)) for axis in self.axes.values()]
        check_size_limit("HARMONICS", max(counts, default=0))
        return self


class TipMove(StrictModel):
    """A straight move of the tip: signed distances of r, z [m], theta, attitude, head [rad].

    `speed` is that of the tip [m/s], or [rad/s] if only angles change; `pause` [s] follows the move.
    """

    r: float = 0.0
    z: float = 0.0
    theta: float = 0.0
    attitude: float = 0.0
    head: float = 0.0
    speed: Annotated[float, Field(ge=1e-4, le=100)] = 0.5
    pause: NonNegativeFloat = 0.5


class LinesPilot(StrictModel):
    """Straight moves of the tip in cylindrical coordinates, converted to joint references.

    `mode: rate` integrates rate commands like those of a joystick under rate control; `position`
    commands the pose. The tip rests for `settle` [s] and then makes the `moves`, whose speeds are
    reached with `acceleration` [m/s^2] or [rad/s^2].
    """

    kind: Literal["lines"]
    mode: Literal["rate", "position"] = "rate"
    settle: NonNegativeFloat = 1.0
    acceleration: Annotated[float, Field(ge=1e-3, le=1000)] = 1.0
    moves: Annotated[list[TipMove], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        check_size_limit("MOVES", len(self.moves))
        return self


class Waypoint(StrictModel):
    """Joint positions or tip pose, reached `duration` [s] after the previous one, held `pause` [s].

    `joints` are joint name -> position [rad] or [m].
    """

    duration: PositiveFloat
    pause: NonNegativeFloat = 0.0
    joints: dict[Name, float] = {}
    pose: Pose | None = None


class WaypointsPilot(StrictModel):
    """Waypoints connected by quintic polynomials of time, in joint space or in the tip pose.

    The motion starts after `settle` [s].
    """

    kind: Literal["waypoints"]
    settle: NonNegativeFloat = 0.5
    points: Annotated[list[Waypoint], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        check_size_limit("MOVES", len(self.points))
        return self


Pilot = Annotated[
    ConstantPilot | TablePilot | FourierPilot | LinesPilot | WaypointsPilot | TeleopPilot,
    Field(discriminator="kind"),
]
