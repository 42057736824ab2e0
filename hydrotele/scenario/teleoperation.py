"""Facts of a teleoperated run: joystick, reflection, operator, channel between them, safety.

Joystick axes x, y, z [m], rx, ry, rz [rad] move the task coordinates of the arm: r, z [m], theta,
attitude and head [rad]. All SI, frozen; keys may carry units as suffixes.
"""

import math
import warnings
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from hydrotele.core.datafile import Facts, Name, NonNegative, Positive

Coordinate = Literal["r", "theta", "z", "attitude", "head"]
JoystickAxis = Literal["x", "y", "z", "rx", "ry", "rz"]
Reflection = Literal[
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance",
    "wave_variables", "passivity_control",
]  # fmt: skip
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

    Delays are rounded to whole control periods; one packet is sent a period. Packets are lost from
    `lost_from` [s] on: each with the probability `lost`. Each is later than the delay by a time of
    its own with the mean `jitter` [s], exponentially distributed; packets that were overtaken are
    not used. `trace` is a CSV file of measured delays with the columns `forward` and `back` [s],
    one row a packet, empty where lost, used again from its beginning where the run is longer; it
    takes the place of delays and jitter.
    """

    delay_forward: Annotated[float, Field(ge=0, le=2)] = 0.0
    delay_back: Annotated[float, Field(ge=0, le=2)] = 0.0
    jitter: Annotated[float, Field(ge=0, le=1)] = 0.0
    trace: str | None = None
    lost: Annotated[float, Field(ge=0, le=1)] = 0.0
    lost_from: NonNegative = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.trace and (self.delay_forward or self.delay_back or self.jitter):
            raise ValueError("trace has the delays; leave delay_forward, delay_back, jitter out")
        return self


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

    `display: both` shows the contact force (as the machine's sensors tell it) beside the target;
    `target` the target alone, so that he has to feel or to imagine the force.
    """

    kind: Literal["track"]
    target: ForceTarget
    approach: Positive = 0.35
    display: Literal["target", "both"] = "target"


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


class Recorded(Facts):
    """The handle moves as a person moved it: `recorded` is a CSV or Parquet file of his hand.

    It has `time` and `handle.x` ... `handle.rz` (or `x` ... `rz`), as displacements [m] or [rad];
    a unit may stand in the column's name (`handle.z [mm]`). Axes without a column stay centred.
    """

    kind: Literal["recorded"] = "recorded"
    recorded: str


class Perception(Facts):
    """Who the simulated operator is, and what his senses and muscles can do.

    `file` has other parameters than `hydrotele/teleop/operator.yaml`, which tells what is known of
    each; `drawn` takes the operator of that number from the spread given there. `grip` (relaxed,
    normal, firm) replaces the joystick file's hand, `posture` (near, mid, far) gives it
    the ellipses of an arm. Every parameter that is set here counts instead of the file's:

    visual_delay: from seeing to acting [s]; touch: from feeling to acting [s]; crossover: of the
    loops that he closes by sight, at most [rad/s]; force_weber, position_weber, integration_weber:
    of felt forces, displacements and stiffnesses, as a share; remnant: of his observation noise;
    sight: how well a place is seen [m] or [rad]; sight_noise: of a displayed force, as a share of
    its largest; tremor: of the muscles' force [N]; muscle: of the handle's position [1/s];
    cocontraction: share of the largest; imagination: spread of what he believes a command does
    without feeling it, as a share; task_stiffness: what he is used to [N/m]; dwell: between
    correcting pushes [s]; `Operator` in `hydrotele.teleop.operator_parameters` has all of them.
    """

    file: str | None = None
    drawn: Annotated[int, Field(ge=0)] | None = None
    grip: Name | None = None
    posture: Name | None = None
    visual_delay: NonNegative | None = None
    crossover: Positive | None = None
    tracking_margin: Positive | None = None
    placing_margin: Positive | None = None
    gain_margin: Annotated[float, Field(gt=0, lt=1)] | None = None
    neuromuscular_frequency: Positive | None = None
    neuromuscular_damping: Positive | None = None
    remnant: NonNegative | None = None
    sight: NonNegative | None = None
    sight_noise: NonNegative | None = None
    touch: NonNegative | None = None
    force_weber: NonNegative | None = None
    position_weber: NonNegative | None = None
    integration_weber: NonNegative | None = None
    tremor: NonNegative | None = None
    muscle: Positive | None = None
    largest_force: Positive | None = None
    cocontraction: Annotated[float, Field(ge=0, le=1)] | None = None
    usual_speed: Positive | None = None
    usual_scale: Positive | None = None
    task_stiffness: Positive | None = None
    surprise: Positive | None = None
    memory: Positive | None = None
    imagination: NonNegative | None = None
    dwell: Positive | None = None

    @model_validator(mode="before")
    @classmethod
    def _rename(cls, data):
        """Read keys by their former names."""
        if not isinstance(data, dict):
            return data
        for old, new in _FORMER.items():
            if old in data:
                if new in data:
                    raise ValueError(f"{old} is the former name of {new}; give one of them")
                message = f"pilot.perception: {old} is now called {new}; it was read as that"
                warnings.warn(message, FutureWarning, stacklevel=2)
                data = {new if key == old else key: value for key, value in data.items()}
        return data


_FORMER = {"reaction": "visual_delay", "force_noise": "force_weber", "skill": "crossover"}


def _kind_of(value: object) -> object:
    """The kind of an operator; one with a record needs no other word."""
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return "recorded" if kind is None and isinstance(value, dict) and "recorded" in value else kind


Behaviour = Annotated[
    Annotated[Follow, Tag("follow")]
    | Annotated[Regulate, Tag("regulate")]
    | Annotated[Track, Tag("track")]
    | Annotated[Steer, Tag("steer")]
    | Annotated[Live, Tag("live")]
    | Annotated[Recorded, Tag("recorded")],
    Discriminator(
        _kind_of,
        custom_error_type="operator_kind",
        custom_error_message="needs kind: follow, regulate, track, steer, live; or recorded: FILE",
    ),
]


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

    What structures can do: stiffness feedback is proven stable with every task and delay where
    `B^2 > 4 M K_max` and `K_min > 0`, hand included (Zhu 1994, theorem 4-2); the published gains do
    not meet that, and are stable by the bound on the worst switching (`hydrotele analyse teleop`).
    Direct force bounces where `ratio` times the task's stiffness (and `scale`) is more than hand
    and joystick hold. Coordinating force tells of the machine's lag; a stiff servo hides the task
    from it, and under rate control it needs less coupling with delay. It compares the machine's
    place with that of the handle (`coordinating: handle`, Zhu 1994, 3.52 and 3.53), or with the
    machine's own reference (`reference`), which a late line makes later. Four channels under
    position control give hand = ratio x force and place = scale x handle in the mean; on a
    valve-controlled machine they bounce unless ratio x scale x task stiffness is below the
    coupling, some 400 N/m. Four channels under rate control leave a constant contact force unfelt,
    by design (F_h = s/k_v F_e); they have no dead band. `impedance` adds ratio x gain of the
    coordinate (its scale, or under rate control its rate per displacement, for one second) x the
    task's identified stiffness to the joystick's, within its bounds, its damping, at most as much
    as the joystick's own, and its mass, at most half of the flotor's.

    `wave_variables` (impedance `wave` [N s/m]) and `passivity_control` make the line passive with
    any delay and jitter, under position control: a virtual mass follows the handle through the
    coupling, which comes back, and the task's force moves it. What the line cannot make passive is
    a late estimate of that force.

    `compliance: springs` makes the joystick's axes springs at the handle, `decoupled` gives each
    its own second-order system whatever the flotor's inertia couples (Zhu 1994, 5.9-5.11).

    `resolved_motion: inverse_kinematics` solves the joint references from the commanded pose;
    `inverse_jacobian` integrates joint rates `J^-1(q) V` at the measured angles, so that errors of
    the path accumulate (Zhu 1994, Eq. 2.1). The second is there for comparison.
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
    coordinating: Literal["handle", "reference"] = "handle"
    compliance: Literal["springs", "decoupled"] = "springs"
    resolved_motion: Literal["inverse_kinematics", "inverse_jacobian"] = "inverse_kinematics"
    wave: Positive | None = None
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

    @model_validator(mode="after")
    def _passive_line(self):
        if self.reflection in ("wave_variables", "passivity_control") and self.mode == "rate":
            raise ValueError(
                f"reflection {self.reflection} needs mode position: force times the rate that the"
                " handle asks for is no power that a line could keep"
            )
        return self
