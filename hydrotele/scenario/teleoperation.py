"""Specification of teleoperated runs: joystick, force reflection, operator, channel, safety.

The joystick axes x, y, z [m], rx, ry, rz [rad] move the task coordinates of the arm: r, z [m],
theta, attitude and head [rad] (cylindrical coordinates about the swing axis, pitch and rotation of
the tool). All values are in SI units and frozen; keys may have units as suffixes.
"""

import math
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from hydrotele.core.datafile import Name, NonNegativeFloat, PositiveFloat, StrictModel

Coordinate = Literal["r", "theta", "z", "attitude", "head"]
JoystickAxis = Literal["x", "y", "z", "rx", "ry", "rz"]
Reflection = Literal[
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance",
    "wave_variables", "passivity_control",
]  # fmt: skip
_DEFAULT_AXES: dict[str, tuple[str, float]] = {
    "r": ("x", 1.0), "theta": ("y", 1.0), "z": ("z", 1.0), "attitude": ("ry", -1.0),
    "head": ("rx", 1.0),
}  # fmt: skip


class CoordinateMapping(StrictModel):
    """Mapping from the joystick to one task coordinate.

    Under rate control, the handle at its stop commands the rate `speed` [m/s] or [rad/s]. Under
    position control, the coordinate moves `scale` times as far as the handle ([m/m], [rad/rad]; theta
    is moved by a translation of the handle, [rad/m]), with at most `speed`. `axis` selects the
    joystick axis that moves the coordinate, and `sign` the direction.
    """

    axis: JoystickAxis | None = None
    sign: Literal[-1, 1] | None = None
    speed: PositiveFloat = 0.5
    scale: PositiveFloat = 100.0

    def resolve_axis(self, coordinate: str) -> tuple[str, float]:
        """Return the joystick axis that moves a coordinate, and the sign (+1 or -1) of its direction.

        If `axis` or `sign` is not set, the default of the coordinate is returned: x for r, y for theta,
        z for z, ry with sign -1 for attitude, and rx for head.
        """
        axis, sign = _DEFAULT_AXES[coordinate]
        return self.axis or axis, float(self.sign or sign)


class Channel(StrictModel):
    """Communication channel between operator and machine, with delays and packet loss.

    One packet is sent per control period in each direction. `delay_forward` (operator to machine) and
    `delay_back` (machine to operator) [s] are rounded to whole control periods. Every packet has an
    additional, exponentially distributed delay with the mean `jitter` [s]; a packet that arrives
    after a later one is discarded. From the time `loss_start` [s] on, every packet is lost with the
    probability `loss_probability`. `trace` is a CSV file of measured delays that replace these delays
    and the jitter. It has the columns `forward` and `back` [s] and one row per packet, empty for a
    lost packet. The trace repeats if the run is longer than it.
    """

    renamed = {"lost": "loss_probability", "lost_from": "loss_start"}

    delay_forward: Annotated[float, Field(ge=0, le=2)] = 0.0
    delay_back: Annotated[float, Field(ge=0, le=2)] = 0.0
    jitter: Annotated[float, Field(ge=0, le=1)] = 0.0
    trace: str | None = None
    loss_probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    loss_start: NonNegativeFloat = 0.0

    @model_validator(mode="after")
    def _check(self):
        if self.trace and (self.delay_forward or self.delay_back or self.jitter):
            raise ValueError("trace has the delays; remove delay_forward, delay_back and jitter")
        return self


class SafetyLimits(StrictModel):
    """Conditions under which the machine stops automatically.

    Without a new packet for `packet_timeout` [s], the commanded rates go to zero and the reflected force
    fades out. The valves close permanently if a joint is further than `following_error` [rad] or
    [m] from its reference. They also close permanently if the readings of a sensor, which normally
    vary by noise, stay the same for `frozen_time` [s].
    """

    renamed = {"silence": "packet_timeout", "frozen": "frozen_time"}

    packet_timeout: PositiveFloat = 0.15
    following_error: PositiveFloat = 0.2
    frozen_time: PositiveFloat = 0.5


class TipOver(StrictModel):
    """Tip-over protection: a force on the joystick's vertical axis that pushes the handle to its centre.

    The force acts if the contact force at the tip causes more than the fraction `moment_fraction` of
    the moment that tips the machine. The machine of `mass` [kg] has its centre of mass at
    `centre_of_mass_behind` [m] behind the swing axis. It tips about the edge of its tracks,
    `tipping_edge` [m] in front of or behind the axis. The force on the handle is that of a spring with
    `stiffness` [N/m] and a damper with `damping` [N s/m].
    """

    renamed = {
        "behind": "centre_of_mass_behind", "edge": "tipping_edge", "share": "moment_fraction",
    }  # fmt: skip

    mass: PositiveFloat
    centre_of_mass_behind: float = 0.0
    tipping_edge: PositiveFloat = 1.6
    moment_fraction: Annotated[float, Field(gt=0, lt=1)] = 0.7
    stiffness: PositiveFloat = 8.0e3
    damping: NonNegativeFloat = 100.0


class SensorFault(StrictModel):
    """Sensor fault: from the time `start` [s] on, a sensor repeats its last reading.

    `channel` is the log channel of the sensor, such as `angle.boom` or `pressure_rod.stick`.
    """

    renamed = {"at": "start"}

    channel: str
    start: NonNegativeFloat


class ButtonCommand(StrictModel):
    """Open-loop command that a joystick button gives to an axis that the joystick does not move.

    Such an axis is a saw or a grab. From the time `start` [s] on, until the next button command of the
    axis, its valve or drive gets `command` [1] or [V].
    """

    renamed = {"at": "start"}

    start: NonNegativeFloat
    axis: Name
    command: float


def _check_time_points(time: list[float]) -> None:
    rises = all(a < b for a, b in zip(time, time[1:], strict=False))
    if not time or time[0] != 0.0 or not rises:
        raise ValueError("time must start at 0 and rise strictly")


class FollowPath(StrictModel):
    """The operator moves the handle along a given path.

    `path` maps joystick axes to their displacements from the centre [m] or [rad] at each `time` [s].
    Between the times, `interpolate: hold` keeps the last value, and `linear` interpolates linearly.
    """

    kind: Literal["follow"]
    time: list[NonNegativeFloat] = [0.0]
    path: dict[JoystickAxis, list[float]] = {}
    interpolate: Literal["hold", "linear"] = "linear"

    @model_validator(mode="after")
    def _check(self):
        _check_time_points(self.time)
        for name, values in self.path.items():
            if len(values) != len(self.time):
                raise ValueError(f"path.{name} has {len(values)} values, time has {len(self.time)}")
        return self


class ForceTarget(StrictModel):
    """Target of the contact force along one task coordinate over time: `force` [N] at each `time` [s].

    The force is positive if the environment pushes the machine along the coordinate.
    """

    coordinate: Coordinate = "z"
    time: list[NonNegativeFloat]
    force: list[float]

    @model_validator(mode="after")
    def _check(self):
        _check_time_points(self.time)
        if len(self.time) != len(self.force):
            raise ValueError(f"force has {len(self.force)} values, time has {len(self.time)}")
        return self


class RegulateForce(StrictModel):
    """The operator regulates a contact force to its target by feel, with the reflected force alone.

    The operator knows how the joystick displays a contact force to the hand: with stiffness reflection,
    the joystick's nominal stiffness and its change per contact force; with direct reflection, the ratio
    of hand force to contact force. The operator corrects the force by pushes of the
    handle. Before contact the operator deflects the handle by `approach`, a fraction of the handle's
    range beyond the dead band.
    """

    kind: Literal["regulate"]
    target: ForceTarget
    approach: PositiveFloat = 0.35


class TrackForce(StrictModel):
    """The operator makes the contact force follow a target force that a screen displays.

    The operator sees the screen with delay and noise. `display: both` shows the target and the contact
    force from the machine's sensors. `display: target` shows the target alone, so that the operator has
    to feel or to estimate the contact force. Before contact the operator deflects the handle by
    `approach`, a fraction of the handle's range beyond the dead band.
    """

    kind: Literal["track"]
    target: ForceTarget
    approach: PositiveFloat = 0.35
    display: Literal["target", "both"] = "target"


class SteerToPoses(StrictModel):
    """The operator steers the tip by sight to one pose after the other.

    `points` maps task coordinates (r, z [m]; theta, attitude, head [rad]) to one goal value per entry of
    `time`. Each goal applies from its `time` [s] on, until the next one.
    """

    kind: Literal["steer"]
    time: list[NonNegativeFloat]
    points: Annotated[dict[Coordinate, list[float]], Field(min_length=1)]

    @model_validator(mode="after")
    def _check(self):
        _check_time_points(self.time)
        for name, values in self.points.items():
            if len(values) != len(self.time):
                raise ValueError(f"points.{name} has {len(values)} values, time has {len(self.time)}")
        return self


class LiveOperator(StrictModel):
    """A person moves the handle with an input device (`hydrotele drive`)."""

    kind: Literal["live"]


class RecordedMotion(StrictModel):
    """The handle repeats the recorded motion of a person; `recorded` is a CSV or Parquet file.

    The file's columns are `time` and `handle.x` ... `handle.rz` (or `x` ... `rz`), displacements in [m] or
    [rad]. A column name may contain a unit (`handle.z [mm]`). Joystick axes without a column stay centred.
    """

    kind: Literal["recorded"] = "recorded"
    recorded: str


RENAMED_OPERATOR_PARAMETERS = {
    "reaction": "visual_delay", "force_noise": "force_weber", "skill": "max_crossover_frequency",
    "sight": "visual_threshold", "sight_noise": "display_noise", "touch": "haptic_delay",
    "crossover": "max_crossover_frequency", "placing_margin": "positioning_margin",
    "largest_force": "max_force", "stiffening": "cocontraction_stiffness_factor",
    "usual_speed": "expected_speed", "usual_scale": "expected_scale",
    "surprise": "new_gain_log_std", "memory": "memory_time", "imagination": "unfelt_gain_std",
    "dwell": "correction_interval", "muscle": "handle_position_gain",
}  # fmt: skip
"""Former name of an operator parameter -> present name."""


class OperatorSettings(StrictModel):
    """Parameters of the simulated operator: perception, neuromuscular dynamics and arm impedance.

    `file` replaces `hydrotele/teleop/operator.yaml`, which documents every parameter. If the number
    `sample` is given, a random operator is drawn from the distributions in the file, with this number
    as seed. `grip` (relaxed, normal, firm) replaces the arm impedance of the joystick file; `posture`
    (near, mid, far) adds the stiffness ellipses of an arm. Parameters that are set here replace those
    of the file:

    visual_delay: delay from vision to action [s]; haptic_delay: delay from haptic perception to
    action [s]; max_crossover_frequency: maximum crossover frequency of loops that the operator
    closes by vision [rad/s]; force_weber, position_weber, integration_weber: Weber fractions of
    perceived forces, displacements and stiffnesses; remnant: noise-to-signal ratio of the
    operator's observations; visual_threshold: visual resolution of a position [m] or [rad];
    display_noise: noise of a displayed force, as a fraction of its maximum; tremor: noise of the
    muscle force [N]; handle_position_gain: gain of the position control of the handle [1/s];
    cocontraction: muscle cocontraction as a fraction of its maximum; unfelt_gain_std: relative
    standard deviation of the expected effect of a command without force feedback; task_stiffness:
    stiffness that the operator is used to [N/m]; correction_interval: time between corrective pushes
    [s]. `Operator` in `hydrotele.teleop.operator_parameters` documents all of them.
    """

    renamed = {"drawn": "sample"} | RENAMED_OPERATOR_PARAMETERS

    file: str | None = None
    sample: Annotated[int, Field(ge=0)] | None = None
    grip: Name | None = None
    posture: Name | None = None
    visual_delay: NonNegativeFloat | None = None
    max_crossover_frequency: PositiveFloat | None = None
    tracking_margin: PositiveFloat | None = None
    positioning_margin: PositiveFloat | None = None
    gain_margin: Annotated[float, Field(gt=0, lt=1)] | None = None
    neuromuscular_frequency: PositiveFloat | None = None
    neuromuscular_damping: PositiveFloat | None = None
    remnant: NonNegativeFloat | None = None
    visual_threshold: NonNegativeFloat | None = None
    display_noise: NonNegativeFloat | None = None
    haptic_delay: NonNegativeFloat | None = None
    force_weber: NonNegativeFloat | None = None
    position_weber: NonNegativeFloat | None = None
    integration_weber: NonNegativeFloat | None = None
    tremor: NonNegativeFloat | None = None
    handle_position_gain: PositiveFloat | None = None
    max_force: PositiveFloat | None = None
    cocontraction: Annotated[float, Field(ge=0, le=1)] | None = None
    expected_speed: PositiveFloat | None = None
    expected_scale: PositiveFloat | None = None
    task_stiffness: PositiveFloat | None = None
    new_gain_log_std: PositiveFloat | None = None
    memory_time: PositiveFloat | None = None
    unfelt_gain_std: NonNegativeFloat | None = None
    correction_interval: PositiveFloat | None = None


def _get_operator_kind(value: object) -> object:
    """Return the key `kind` of an operator's data, which selects the class that validates it.

    The kind is `recorded` if it is omitted and the key `recorded` is given, and otherwise None.
    """
    kind = value.get("kind") if isinstance(value, dict) else getattr(value, "kind", None)
    return "recorded" if kind is None and isinstance(value, dict) and "recorded" in value else kind


OperatorBehaviour = Annotated[
    Annotated[FollowPath, Tag("follow")]
    | Annotated[RegulateForce, Tag("regulate")]
    | Annotated[TrackForce, Tag("track")]
    | Annotated[SteerToPoses, Tag("steer")]
    | Annotated[LiveOperator, Tag("live")]
    | Annotated[RecordedMotion, Tag("recorded")],
    Discriminator(
        _get_operator_kind,
        custom_error_type="operator_kind",
        custom_error_message="needs kind: follow, regulate, track, steer, live; or recorded: FILE",
    ),
]


class TeleopPilot(StrictModel):
    """An operator controls the machine through the joystick, with force reflection.

    `mount: cab` mounts the joystick on the swinging link, whose motion excites it; `mount: table`
    mounts it on a fixed table. `reflection` selects the force reflection, under rate or position
    control (`mode`). `ratio` scales reflected forces: hand force per machine force [N/N], with the
    machine force limited to `force_limit` [N]. `coupling` [N/m] is the spring between handle and
    slave of coordinating force and four channels: per metre of the handle under position control
    (default 400), of the machine under rate control (default 40). `coupling_damping` [N s/m]
    defaults to 0.1 s times `coupling`. `virtual_mass` [kg] is the slave mass of four
    channels, wave variables and passivity control.
    `acceleration` [m/s^2] or [rad/s^2] limits the references. `force` selects the source of the
    contact force: the pressures with the `static` or `dynamic` model, through a filter with
    `bandwidth` [rad/s] (`bandwidth_hz`), or the exact force of the simulator (`true`).

    Stability and limits of the structures:

    - `stiffness`: proven stable with every environment and delay if `B^2 > 4 M K_max` and
      `K_min > 0`, with mass M, damping B and stiffness bounds K_min and K_max of joystick and hand
      together (Zhu 1994, theorem 4-2). The published gains do not meet this
      condition; they are stable by the bound for the worst switching (`hydrotele analyse teleop`).
    - `direct_force`: bounces if `ratio` times the environment stiffness (times `scale`) exceeds the
      stiffness of hand and joystick.
    - `coordinating_force`: reflects the lag of the machine; a stiff servo hides the environment
      from it, and under rate control it needs a smaller coupling with delay. It compares the
      position of the machine with that of the handle (`coordinating_position: handle`, Zhu 1994,
      3.52 and 3.53), or with the reference of the machine (`reference`), which channel delay retards.
    - `four_channel` under position control: in the mean, hand force = ratio x contact force and
      position = scale x handle. On a valve-controlled machine it bounces unless ratio x scale x
      environment stiffness is below the coupling, about 400 N/m. Under rate control it does not
      reflect a constant contact force, by design (F_h = s/k_v F_e, with hand force F_h, contact force
      F_e and rate gain k_v), and has no dead band.
    - `impedance`: adds the identified environment stiffness, times `ratio` and the gain of the
      coordinate, to the stiffness of the joystick, within its bounds. The gain is the coordinate's
      `scale`, or under rate control its rate per displacement, for one second. It likewise adds
      damping, at most that of the joystick, and mass, at most half of that of the flotor.
    - `wave_variables` (impedance `wave_impedance` [N s/m]) and `passivity_control`: make the channel passive
      with any delay and jitter, under position control. A virtual mass follows the handle through
      the coupling, whose force is sent back, and the contact force moves it. The channel cannot
      compensate a delayed estimate of the contact force.

    `compliance: springs` makes the joystick axes springs at the handle; `decoupled` gives each axis
    its own second-order system, without coupling by the inertia of the flotor (Zhu 1994, 5.9-5.11).

    `resolved_motion: inverse_kinematics` solves the joint references from the commanded pose;
    `inverse_jacobian` integrates joint rates `J^-1(q) V` at the measured angles, so that path
    errors accumulate (Zhu 1994, Eq. 2.1). The second is provided for comparison.
    """

    renamed = {"coordinating": "coordinating_position", "wave": "wave_impedance"}

    kind: Literal["teleop"]
    joystick: str = "joystick"
    gains: Name = "excavator"
    mount: Literal["cab", "table"] = "cab"
    mode: Literal["rate", "position"] = "rate"
    reflection: Reflection = "stiffness"
    detent: bool = False
    ratio: NonNegativeFloat = 2.0e-4
    force_limit: PositiveFloat | None = None
    coupling: NonNegativeFloat | None = None
    coupling_damping: NonNegativeFloat | None = None
    coordinating_position: Literal["handle", "reference"] = "handle"
    compliance: Literal["springs", "decoupled"] = "springs"
    resolved_motion: Literal["inverse_kinematics", "inverse_jacobian"] = "inverse_kinematics"
    wave_impedance: PositiveFloat | None = None
    virtual_mass: PositiveFloat = 2.0
    force: Literal["static", "dynamic", "true"] = "dynamic"
    bandwidth: Annotated[float, Field(gt=0, le=10.0 * math.pi)] = 3.0 * math.pi
    acceleration: PositiveFloat = 1.0
    coordinates: dict[Coordinate, CoordinateMapping] = {}
    stiffness: dict[JoystickAxis, dict[str, float]] = {}
    operator: OperatorBehaviour
    perception: OperatorSettings = OperatorSettings()
    channel: Channel = Channel()
    safety: SafetyLimits = SafetyLimits()
    tip_over: TipOver | None = None
    buttons: list[ButtonCommand] = []
    faults: list[SensorFault] = []

    @model_validator(mode="after")
    def _check_mode(self):
        if self.reflection in ("wave_variables", "passivity_control") and self.mode == "rate":
            raise ValueError(
                f"reflection {self.reflection} needs mode position: under rate control, force times"
                " commanded rate is not a power that the channel could preserve"
            )
        return self
