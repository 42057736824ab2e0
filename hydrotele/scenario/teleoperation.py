"""Facts of a teleoperated run: joystick, reflection, operator, channel between them, safety.

Joystick axes x, y, z [m], rx, ry, rz [rad] move the task coordinates of the arm: r, z [m], theta,
attitude and head [rad]. All SI, frozen; keys may carry units as suffixes.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive

Coordinate = Literal["r", "theta", "z", "attitude", "head"]
JoystickAxis = Literal["x", "y", "z", "rx", "ry", "rz"]
Reflection = Literal[
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance"
]
_WHERE: dict[str, tuple[str, float]] = {
    "r": ("x", 1.0), "theta": ("y", 1.0), "z": ("z", 1.0), "attitude": ("ry", -1.0),
    "head": ("rx", 1.0),
}  # fmt: skip


class Coupling(Facts):
    """How one task coordinate hangs on the joystick.

    Under rate control the handle at its stop asks for `speed` [m/s] or [rad/s]; under position
    control the coordinate moves `scale` times as far as the handle ([m/m], [rad/rad]; theta by
    translation [rad/m]), no faster than `speed`. `axis` and `sign` say which way of the joystick
    moves it.
    """

    axis: JoystickAxis | None = None
    sign: Literal[-1, 1] | None = None
    speed: Positive = 0.5
    scale: Positive = 100.0

    def placed(self, coordinate: str) -> tuple[str, float]:
        """Joystick axis and sign, the usual ones of the coordinate where none is given."""
        axis, sign = _WHERE[coordinate]
        return self.axis or axis, float(self.sign or sign)


class Channel(Facts):
    """The line between operator and machine: delays [s] either way, share of packets lost.

    Delays are rounded to whole control periods. Packets are lost from `lost_from` [s] on: each with
    the probability `lost`.
    """

    delay_forward: Annotated[float, Field(ge=0, le=2)] = 0.0
    delay_back: Annotated[float, Field(ge=0, le=2)] = 0.0
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    lost_from: NonNegative = 0.0


class Safety(Facts):
    """When the machine stops by itself.

    Without a new packet for `silence` [s] rates go to zero and the reflected force fades; a joint
    further than `following_error` [rad] or [m] from its reference, or a sensor that states noise
    and reads the same for `frozen` [s], closes the valves for good.
    """

    silence: Positive = 0.15
    following_error: Positive = 0.2
    frozen: Positive = 0.5


class TipOver(Facts):
    """Tip-over protection: beyond `share` of the tipping moment the stick is pushed back.

    The machine of `mass` [kg] with its centre of mass `behind` [m] the swing axis tips about the
    edge of its tracks, `edge` [m] ahead of the axis or behind it. What
    pushes back is a spring and a damper of `stiffness` [N/m] and `damping` [N s/m].
    """

    mass: Positive
    behind: float = 0.0
    edge: Positive = 1.6
    share: Annotated[float, Field(gt=0, lt=1)] = 0.7
    stiffness: Positive = 8.0e3
    damping: NonNegative = 100.0


class Fault(Facts):
    """A sensor that freezes at a time [s]: `angle.boom`, `pressure_head.boom`, `pressure_rod.x`."""

    channel: str
    at: NonNegative


class Button(Facts):
    """From `at` [s] on, an axis that the joystick does not move gets a command (saw, grab)."""

    at: NonNegative
    axis: Name
    command: float


def _check_time(time: list[float]) -> None:
    rises = all(a < b for a, b in zip(time, time[1:], strict=False))
    if not time or time[0] != 0.0 or not rises:
        raise ValueError("time must start at 0 and rise")


class Follow(Facts):
    """The operator moves the handle along a path, `time` [s] and displacements [m] or [rad]."""

    kind: Literal["follow"]
    time: list[NonNegative] = [0.0]
    path: dict[JoystickAxis, list[float]] = {}
    interpolate: Literal["hold", "linear"] = "linear"

    @model_validator(mode="after")
    def _check(self):
        _check_time(self.time)
        for name, values in self.path.items():
            if len(values) != len(self.time):
                raise ValueError(f"path.{name} has {len(values)} values, time has {len(self.time)}")
        return self


class ForceTarget(Facts):
    """A contact force to hold or to track: at `time` [s] the `force` [N] of the coordinate.

    The machine presses with it: positive is the environment's force along the coordinate.
    """

    coordinate: Coordinate = "z"
    time: list[NonNegative]
    force: list[float]

    @model_validator(mode="after")
    def _check(self):
        _check_time(self.time)
        if len(self.time) != len(self.force):
            raise ValueError(f"force has {len(self.force)} values, time has {len(self.time)}")
        return self


class Regulate(Facts):
    """The operator makes a contact force from what he feels alone.

    He knows how joystick and machine translate it (K_nom and K_r, or the direct ratio), and pushes
    as one does under rate control.
    """

    kind: Literal["regulate"]
    target: ForceTarget
    approach: Positive = 0.35


class Track(Facts):
    """The operator tracks a force trajectory that is displayed to him, seeing it late and rough.

    With `shown: target_and_force` the screen shows the estimated contact force beside the target.
    """

    kind: Literal["track"]
    target: ForceTarget
    approach: Positive = 0.35
    shown: Literal["target", "target_and_force"] = "target"


class Steer(Facts):
    """The operator steers the tip to poses that he sees, one after the other.

    Each of `points` is a pose (r, theta, z, attitude, head as given) held until `at` [s].
    """

    kind: Literal["steer"]
    time: list[NonNegative]
    points: Annotated[dict[Coordinate, list[float]], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _check_time(self.time)
        for name, values in self.points.items():
            if len(values) != len(self.time):
                raise ValueError(
                    f"points.{name} has {len(values)} values, time has {len(self.time)}"
                )
        return self


class Live(Facts):
    """A person moves the handle by a device (`hydrotele drive`)."""

    kind: Literal["live"]


class Perception(Facts):
    """What a person's senses and muscles can do; sources in models/joystick/README.md.

    reaction: from seeing to acting [s]; touch: from feeling to acting [s]; force_noise: of felt
    forces, as a share; sight_noise: of a displayed force, as a share of its largest; tremor: of the
    muscles' force [N]; skill: gain of the outer loop [1/s]; muscle: of the handle's position [1/s];
    imagination: spread of what he believes a command does without feeling it, as a share;
    task_stiffness: what he is used to [N/m]; dwell: between correcting pushes [s];
    sight: how well a place is seen [m] or [rad].
    """

    reaction: NonNegative = 0.25
    touch: NonNegative = 0.12
    force_noise: NonNegative = 0.03
    sight_noise: NonNegative = 0.02
    tremor: NonNegative = 0.05
    skill: Positive = 1.5
    muscle: Positive = 6.0
    imagination: NonNegative = 0.3
    task_stiffness: Positive = 1.0e6
    dwell: Positive = 1.5
    sight: NonNegative = 0.02
    largest_force: Positive = 30.0


Behaviour = Annotated[Follow | Regulate | Track | Steer | Live, Field(discriminator="kind")]


class TeleopPilot(Facts):
    """A simulated operator drives the machine through the joystick.

    `mount: cab` shakes the joystick with the link that swings, `mount: table` leaves it alone.
    `reflection` is the structure, under `mode` rate or position control. `ratio` scales reflected
    forces: hand per machine force [N/N], up to the `force_limit` [N] of the machine's force.
    `coupling` [N/m] is the spring between handle and slave of coordinating force and four channels:
    per metre of the handle under position control (400 if not given), of the machine under rate
    control (40); `coupling_damping` [N s/m] is a tenth of it. `virtual_mass` [kg] is the slave's of
    four channels. References speed up by `acceleration` [m/s^2] or [rad/s^2]. `force` chooses where
    the contact force comes from: the pressures with the static or the dynamic model, through a
    filter of a `bandwidth` [rad/s] (`bandwidth_hz`), or the simulator's own (`true`).

    What structures can do: stiffness feedback is stable with every task and delay. Direct force
    bounces where `ratio` times the task's stiffness (and `scale`) is more than hand and joystick
    hold. Coordinating force tells of the machine's lag; a stiff servo hides the task from it, and
    under rate control it needs less coupling with delay. Four channels under position control give
    hand = ratio x force and place = scale x handle in the mean; on a valve-controlled machine they
    bounce unless ratio x scale x task stiffness is below the coupling, some 400 N/m. Four channels
    under rate control leave a constant contact force unfelt, by design (F_h = s/k_v F_e); they have
    no dead band. `impedance` adds ratio x gain of the coordinate (its scale, or under rate control
    its rate per displacement, for one second) x the task's identified stiffness to the joystick's,
    within its bounds, and its damping, at most as much as the joystick's own.
    """

    kind: Literal["teleop"]
    joystick: str = "joystick"
    gains: Name = "excavator"
    mount: Literal["cab", "table"] = "cab"
    mode: Literal["rate", "position"] = "rate"
    reflection: Reflection = "stiffness"
    detent: bool = False
    ratio: NonNegative = 2.0e-4
    force_limit: Positive | None = None
    coupling: NonNegative | None = None
    coupling_damping: NonNegative | None = None
    virtual_mass: Positive = 2.0
    force: Literal["static", "dynamic", "true"] = "dynamic"
    bandwidth: Annotated[float, Field(gt=0, le=10.0 * math.pi)] = 3.0 * math.pi
    acceleration: Positive = 1.0
    coordinates: dict[Coordinate, Coupling] = {}
    stiffness: dict[JoystickAxis, dict[str, float]] = {}
    operator: Behaviour
    perception: Perception = Perception()
    channel: Channel = Channel()
    safety: Safety = Safety()
    tip_over: TipOver | None = None
    buttons: list[Button] = []
    faults: list[Fault] = []
