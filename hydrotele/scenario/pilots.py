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

    `r` is the distance of the tip from the axis and `z` its height above ground [m]. `theta` is the
    swing angle, `attitude` the pitch of the tool and `head` the rotation of the tool [rad]. Arms
    without these tool joints leave `attitude` and `head` at None.
    """

    r: PositiveFloat
    z: float
    theta: float = 0.0
    attitude: float | None = None
    head: float | None = None


class ConstantPilot(StrictModel):
    """Constant open-loop commands to valves or drives.

    `commands` maps axis names to commands [1] or [V]; axes without an entry get the command 0.
    """

    kind: Literal["constant"]
    commands: dict[Name, float] = {}


class TablePilot(StrictModel):
    """Commands or references from a table over time, given as columns or in a log file.

    `quantity: command` drives the valves open loop, `quantity: joint` gives joint references [rad]
    or [m]. Either `columns` (axis -> values at each `time` [s]) or `file` is given. `file` is a CSV or
    Parquet log. Its columns `command.<axis>` are used for commands. For joint references its columns
    `reference.<axis>` are used, or else `angle.<axis>`, or else `position.<axis>`. Between the times,
    `interpolate: hold` keeps the last value, and `linear` interpolates linearly.
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
    """Raise ValueError if `amount` exceeds the input limit `name`, such as `HARMONICS` or `MOVES`.

    The limits bound the size of user input; `hydrotele.core.files` defines them.
    """
    if said := describe_excess(name, amount):
        raise ValueError(f"has {said}")


class FourierSeries(StrictModel):
    """Fourier series of one joint's reference: `mean + sum_k (sin_k sin(k w t) + cos_k cos(k w t))`.

    k counts harmonics from 1, t is time, and w is 2 pi over the period of `FourierPilot` [rad/s]. The
    constant `mean` and the coefficients in the lists `sin` and `cos` are in [rad] or [m].
    """

    mean: float = 0.0
    sin: list[float] = []
    cos: list[float] = []


class FourierPilot(StrictModel):
    """Periodic joint references as Fourier series with a common `period` [s].

    `axes` maps axis names to series. Over the first `fade` seconds the reference changes smoothly from
    the start position to the series. The servo holds axes without a series at their start position,
    except those in `closed_valves`, whose valve command is always 0.
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

    All distances are relative to the pose before the move. `speed` is the speed of the tip in r and z
    [m/s], or of the angle that changes most [rad/s] if r and z do not change. The tip rests for
    `pause` [s] after the move.
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

    `mode: rate` integrates rate commands like those of a joystick under rate control; `mode: position`
    solves the joint references from the commanded pose. The tip first rests for `settle` [s] and then
    makes the `moves` one after the other. Each move accelerates to its speed and decelerates with
    `acceleration` [m/s^2] or [rad/s^2].
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
    """Target of a motion: joint positions or a tip pose.

    The motion from the previous waypoint takes `duration` [s]. The target is then held for `pause`
    [s]. `joints` maps joint names to positions [rad] or [m].
    """

    duration: PositiveFloat
    pause: NonNegativeFloat = 0.0
    joints: dict[Name, float] = {}
    pose: Pose | None = None


class WaypointsPilot(StrictModel):
    """Waypoints connected by quintic polynomials of time, in joint space or in the tip pose.

    A waypoint with `pose` is reached along a path of tip poses, one with `joints` in joint space. The
    machine holds its start position for the first `settle` seconds.
    """

    kind: Literal["waypoints"]
    settle: NonNegativeFloat = 0.5
    points: Annotated[list[Waypoint], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        check_size_limit("MOVES", len(self.points))
        return self


PlannedPilot = Annotated[
    ConstantPilot | TablePilot | FourierPilot | LinesPilot | WaypointsPilot, Field(discriminator="kind")
]


class PolicyPilot(StrictModel):
    """A program that computes actions during the run: a trained policy, a Python function or a plug-in.

    `policy` is a file of stable-baselines3 (`.zip`), TorchScript (`.pt`) or ONNX (`.onnx`), relative to the
    folder of the scenario; `module:function` or `FILE.py:function`; or the name of a plug-in of the group
    `hydrotele.pilots`. It runs with all rights of the user: use only files that you trust.

    `observation` lists the values that it receives, by the names of the environments, such as
    `angle.boom`, `pressure_head.boom`, `tip.r`, `command.boom`, `reference.boom` or
    `reference_in_100_ms.boom`. Without it, a Python function receives a `PilotState`. `reference` is another
    pilot; its joint references or tip poses are those to follow.

    `action` is the kind of its actions, each from -1 to 1: `valve` (commands), `joint_rate` (rates of the
    axes) or `resolved_motion` (rates of the tip), as in environments; `axes` are the driven axes, by default
    those of the arm and then the others. `rate` [Hz] is the number of actions per second, and `pose_rates`
    the tip rates of full actions: r [m/s], theta [rad/s], z [m/s], attitude, head [rad/s]. Values that are
    not given are those of the program, or else `valve`, 50 Hz and those of the environments.
    """

    kind: Literal["policy"]
    policy: Annotated[str, Field(min_length=1)]
    observation: tuple[str, ...] = ()
    axes: tuple[Name, ...] = ()
    action: Literal["valve", "joint_rate", "resolved_motion"] | None = None
    rate: PositiveFloat | None = None
    pose_rates: tuple[PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat] | None = None
    reference: PlannedPilot | None = None


Pilot = Annotated[
    ConstantPilot | TablePilot | FourierPilot | LinesPilot | WaypointsPilot | TeleopPilot | PolicyPilot,
    Field(discriminator="kind"),
]
