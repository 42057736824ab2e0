"""Linear model of one axis of a teleoperated scenario, built from its simulation parameters.

Hand and flotor are `(M_m + M_h) s + B_h + K_h / s`. The coils add spring and damper of the
scenario's gains, sampled: a control period T holds them for T / 2 on average, and the damper's
difference quotient adds another T / 2. An operator who answers a directly reflected force with a
force does not control the position: the spring of the arm follows the handle,
`K_h (1 - exp(-s t)) / s`, with t the reflex time and half a decision period. Under rate control the
handle beyond its dead band commands `k_v x`, so that the tip follows `k_v V_h / s`. Under position
control the tip follows the filtered position. The force at the tip returns through the estimator's
two filters, a hold of one sensor sample and the channel's delay, multiplied by the ratio.

Neglected: dead bands, stops, limits of force and acceleration, loss of contact, sensor noise, and
the other axes of the handle, which are at rest.

The valve-controlled machine is linearised at its tip along one task coordinate about a pose.
Oil is a spring: at held valves a drive's force changes by `K (v_valve - v)` per second, with
`K = beta (A_h^2 / V_A + A_r^2 / V_B)` and the velocity v_valve that the valve flow produces. The
servo commands `v_ref + g (y_ref - y) - p (F - mean F) / K` (`control.servo`), which the valve
follows with its lag V. For one joint this is

    F = K / (s + p V L) [(V + g V / s) v_ref - (1 + g V / s) v],   L = T s / (T s + 1)

The arm adds the compliances of its joints at the tip, each with its own lag: `1 / C_s` is the sum
of `J_i^2 / C_i`, and the tip follows its reference by the mean of the joints' `(V + g V / s) /
(1 + g V / s)`, weighted with the joints' contributions to the reference rate.

Also neglected: flow limits, leakage, friction, flexible transmissions, and the motion of the other
coordinates.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_axes, pose_to_joints
from hydrotele.control.state_filter import butterworth
from hydrotele.control.tip_balance import ArmBalance, arm_tables
from hydrotele.core.errors import InputError
from hydrotele.estimate.reduced_model import X, place_mechanism
from hydrotele.hydraulics.circuit import SLOTS, Kind, Slot
from hydrotele.kinematics.task import task_jacobian
from hydrotele.machine.joystick import AXES, Joystick
from hydrotele.machine.machine import Machine, sensor_set
from hydrotele.multibody.reduced_mechanism import gather_forces
from hydrotele.scenario.scenario import Plate, Scenario, Servo
from hydrotele.scenario.teleoperation import Regulate, TeleopPilot, Track
from hydrotele.teleop.axis_table import (
    COORDINATE,
    COUPLING,
    COUPLING_DAMPING,
    DAMPING,
    DEADBAND,
    GAIN,
    LEAST,
    LIMIT,
    MOST,
    NOMINAL,
    RATIO,
    REACH,
    REFLECTED_MOST,
)
from hydrotele.teleop.master import Master, master
from hydrotele.teleop.operator_model import DECISIONS, REFLEX
from hydrotele.teleop.operator_parameters import held_joystick
from hydrotele.teleop.slave import AHEAD, SMOOTH
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import Impedance, TwoPort


@dataclass(frozen=True)
class TipDrive:
    """Linear model of the tip of an arm with k joints along one coordinate, about a pose.

    Attributes:
        coordinate: `r`, `theta`, `z`, `attitude` or `head`.
        mass: effective mass, `1 / (J M^-1 J')` [kg], [kg m^2].
        compliance: (k,) of every joint at the tip, with closed valves [m/N], [rad/(N m)].
        share: (k,) contribution of every joint to the reference rate; their sum is 1.
        gain: (k,) servo gains g [1/s].
        bandwidth: (k,) bandwidths of the valves [rad/s].
        damping: (k,) damping ratios of the valves [1].
        delay: (k,) delays of the commands [s].
    """

    coordinate: str
    mass: float
    compliance: np.ndarray
    share: np.ndarray
    gain: np.ndarray
    bandwidth: np.ndarray
    damping: np.ndarray
    delay: np.ndarray

    @property
    def stiffness(self) -> float:
        """Hydraulic stiffness at the tip with closed valves [N/m], [N m/rad]."""
        return 1.0 / float(self.compliance.sum())


@dataclass(frozen=True)
class Clocks:
    """Control period and sampling period of the sensors [s]."""

    control: float
    samples: float


def tip_drive(
    machine: Machine, joints: dict[str, float], coordinate: str, servo: Servo
) -> TipDrive:
    """Linearise the tip of a machine along one coordinate.

    Args:
        machine: machine with valve-controlled drives in all joints of its arm.
        joints: axis -> position of the pose [rad]; the other axes are at their home position.
        coordinate: task coordinate of the arm.
        servo: gains of the servo.

    Returns:
        Parameters of the linear tip model.

    Raises:
        InputError: the arm has no tip force model, or does not move along the coordinate in this
        pose.

    Source: this module's docstring; effective mass after Khatib 1987.
    """
    where, axes = f"linear model of {machine.name}", arm_axes(machine)
    arm = arm_tables(machine, where)
    for i, name in zip(arm.joint, axes, strict=True):
        arm.z[i] = joints.get(name, arm.z[i])
    mass, lever, blend = _inertia(arm, COORDINATES.index(coordinate))
    valves = [list(machine.hydraulic_axes).index(name) for name in axes]
    turning = np.array([_turning_stiffness(arm, valve) for valve in valves])
    if not np.any(lever):
        raise InputError(where, f"no joint moves {coordinate} in this pose")
    user = arm.model.user.reshape(-1, SLOTS)[valves]
    return TipDrive(
        coordinate, mass, lever**2 / turning, lever * blend,
        np.array([servo.axis_gains.get(name, servo.position_gain) for name in axes]),
        user[:, Slot.BANDWIDTH], user[:, Slot.DAMPING],
        np.array([machine.axes[name].command_delay for name in axes], float),
    )  # fmt: skip


def _inertia(arm: ArmBalance, row: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Return effective mass, Jacobian row (k,), and joint rates (k,) per unit coordinate rate."""
    motion, k = arm.space.motion, len(arm.joint)
    place_mechanism(arm.model, arm.space, arm.z)
    gather_forces(arm.model.mech, motion)
    full = motion.basis.T @ motion.mass @ motion.basis
    own = full[np.ix_(arm.joint, arm.joint)]
    table = np.zeros((k, k))
    task_jacobian(arm.task, arm.z[arm.joint], table)
    lever = table[row].copy()
    mass = 1.0 / float(lever @ np.linalg.solve(own, lever))
    return mass, lever, np.linalg.solve(table, np.eye(k)[row])


def _turning_stiffness(arm: ArmBalance, valve: int) -> float:
    """Return the stiffness of a joint due to its drive's oil [N m/rad], after `place_mechanism`.

    Air content is neglected: it lowers the stiffness in a way that depends on the unknown
    pressures.
    """
    user = arm.model.user[valve * SLOTS : (valve + 1) * SLOTS]
    head, rod = user[Slot.VOLUME_HEAD], user[Slot.VOLUME_ROD]
    if user[Slot.KIND] == Kind.CYLINDER:
        x = arm.space.drive[X, valve]
        head = head + user[Slot.AREA_HEAD] * x
        rod = rod + user[Slot.AREA_ROD] * (user[Slot.STROKE] - x)
    hose = user[Slot.BULK_MODULUS] * user[Slot.HOSE_COMPLIANCE]
    oil = user[Slot.AREA_HEAD] ** 2 / (head + hose) + user[Slot.AREA_ROD] ** 2 / (rod + hose)
    lever = float(np.abs(arm.space.row[valve]).max())
    return float(user[Slot.BULK_MODULUS] * oil * lever**2)


def drive_control(tip: TipDrive, servo: Servo, clocks: Clocks, s: np.ndarray) -> np.ndarray:
    """Return C_s: force at the tip per velocity error of the tip.

    Args:
        tip: linear tip model.
        servo: gains of the servo.
        clocks: control and sensor periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [N s/m], [N m s/rad].

    Source: this module's docstring.
    """
    valve, place_lag, rubbing = _lags(tip, servo, clocks, s)
    single = (1.0 + tip.gain * valve * place_lag / s[..., None]) / (s[..., None] + rubbing)
    return 1.0 / (tip.compliance / single).sum(axis=-1)


def drive_follows(tip: TipDrive, servo: Servo, clocks: Clocks, s: np.ndarray) -> np.ndarray:
    """Return the velocity of the unloaded tip per reference velocity.

    Args:
        tip: linear tip model.
        servo: gains of the servo.
        clocks: control and sensor periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [1].

    Source: this module's docstring; `teleop.slave.update_references` for the phase lead.
    """
    valve, place_lag, _ = _lags(tip, servo, clocks, s)
    held = np.exp(-0.5 * clocks.control * s)
    ahead = servo.feedforward * held * (1.0 + servo.lead * s / (AHEAD * s + 1.0))
    back = tip.gain * place_lag / s[..., None]
    return (tip.share * valve * (ahead[..., None] + back) / (1.0 + valve * back)).sum(axis=-1)


def _lags(tip: TipDrive, servo: Servo, clocks: Clocks, s: np.ndarray):
    """Return (..., k) valves with delay, hold of the sensors, and pressure feedback [1/s]."""
    at = s[..., None]
    valve = tip.bandwidth**2 / (at**2 + 2.0 * tip.damping * tip.bandwidth * at + tip.bandwidth**2)
    valve = valve * np.exp(-tip.delay * at)
    held = np.exp(-0.5 * clocks.samples * at)
    passed = servo.load_time * at / (servo.load_time * at + 1.0)
    return valve, held, servo.pressure_feedback * passed * valve * held


_WHERE = "linear case"
FAST = 2.0  # bandwidth of the motion estimate over that of the force estimate (`station`)
STRUCTURES = ("rate_force", "position_force", "rate_position", "position_position")


@dataclass(frozen=True)
class LinearCase:
    """Linear loop of one axis with hand, machine and task; usable like `teleop.analysis.Case`.

    Attributes:
        pilot: teleoperation settings of the scenario.
        row: (17,) parameters of the joystick axis, see `teleop.master.Master.axis`.
        master: mass of the flotor [kg] or its moment of inertia about the handle [kg m^2].
        held: mass, damper and spring of the hand.
        tip: linear tip model of the machine.
        servo: gains of the servo.
        clocks: control and sensor periods.
        task: impedance of the environment along the coordinate.
        delay_forward: delay from the master to the machine [s].
        delay_back: delay from the machine to the master [s].
    """

    pilot: TeleopPilot
    row: np.ndarray
    master: Impedance
    held: Impedance
    tip: TipDrive
    servo: Servo
    clocks: Clocks
    task: Impedance
    delay_forward: float = 0.0
    delay_back: float = 0.0

    @property
    def ratio(self) -> float:
        """Ratio of the reflected force at the hand to the machine's force [N/N], [N m/(N m)]."""
        return float(self.row[RATIO])

    @property
    def force_limit(self) -> float:
        """Machine force at which the reflected force saturates [N], [N m]."""
        return float(self.row[REFLECTED_MOST])

    @property
    def deadband(self) -> float:
        """Displacement of the handle up to which nothing is commanded [m], [rad]."""
        return float(self.row[DEADBAND])

    @property
    def reach(self) -> float:
        """Displacement of the handle at its stop [m], [rad]."""
        return float(self.row[REACH])

    @property
    def spring(self) -> Spring:
        """Joystick axis under stiffness feedback, without the hand."""
        r = self.row
        return Spring(
            self.master.mass, float(r[DAMPING]), float(r[NOMINAL]), float(r[LEAST]), float(r[MOST])
        )

    @property
    def leans(self) -> bool:
        """Whether the operator controls the force, not the position, under direct reflection."""
        pressing = isinstance(self.pilot.operator, Regulate | Track)
        return pressing and self.pilot.reflection != "coordinating_force"

    def with_delay(self, delay: float) -> "LinearCase":
        """Return the case with a delay [s] in each direction."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def hand(self, s: np.ndarray) -> np.ndarray:
        """Return the hand's impedance [N s/m], [N m s/rad] at complex frequencies [rad/s]."""
        if not self.leans:
            return self.held(s)
        late = REFLEX + 0.5 / DECISIONS + 0.5 * self.clocks.control
        own = self.held.stiffness / s * np.exp(-late * s)
        return self.held(s) - own

    def port(self, structure: str, reflected: float = 1.0) -> TwoPort:
        """Return the two-port of a structure with the parameters of this case.

        Args:
            structure: `rate_force`, `position_force`, `rate_position` or `position_position`.
            reflected: factor on the return channels, and on the coupling at the master [1].

        Returns:
            The two-port.

        Raises:
            InputError: the structure is not known.
        """
        if structure not in STRUCTURES:
            raise InputError(_WHERE, f"{structure!r}; valid structures: {', '.join(STRUCTURES)}")
        rate, feels_force = structure.startswith("rate"), structure.endswith("force")
        slave = Impedance(self.tip.mass)

        def nothing(s: np.ndarray) -> np.ndarray:
            return np.zeros_like(s)

        def control(s: np.ndarray) -> np.ndarray:
            return drive_control(self.tip, self.servo, self.clocks, s)

        def forward(s: np.ndarray) -> np.ndarray:
            follows = drive_follows(self.tip, self.servo, self.clocks, s)
            return (self.tip.mass * s + control(s)) * follows * self._asked(rate, s)

        def back(s: np.ndarray) -> np.ndarray:
            return reflected * self.ratio * self._felt(s)

        def coupled(s: np.ndarray) -> np.ndarray:
            return -reflected * self._coupling(rate, s)

        def own(s: np.ndarray) -> np.ndarray:
            if feels_force:
                return self._centred(rate, s)
            if self.pilot.coordinating == "handle":
                asked = self.row[GAIN] / s if rate else self.row[GAIN]
                linked = self._coupling(rate, s, self.clocks.control) * asked
            else:
                late = self.delay_forward + self.delay_back
                asked = np.exp(-s * late) * self._asked(rate, s)
                linked = self._coupling(rate, s) * asked
            return self._centred(rate, s) + reflected * linked

        return TwoPort(
            self.master, slave, own, control, forward, back if feels_force else nothing, nothing,
            nothing if feels_force else coupled, self.delay_forward, self.delay_back,
        )  # fmt: skip

    def _asked(self, rate: bool, s: np.ndarray) -> np.ndarray:
        """Return the commanded tip velocity per velocity of the handle."""
        if rate:
            return self.row[GAIN] / s
        return self.row[GAIN] * (SMOOTH / (s + SMOOTH)) ** 2

    def _centred(self, rate: bool, s: np.ndarray) -> np.ndarray:
        """Return the sampled spring and damper of the coils; no spring under position control."""
        held = np.exp(-0.5 * self.clocks.control * s)
        return held * ((self.row[NOMINAL] if rate else 0.0) / s + self.row[DAMPING] * held)

    def _coupling(self, rate: bool, s: np.ndarray, period: float | None = None) -> np.ndarray:
        """Return the coordinating force on the hand per velocity difference of the machine.

        The force is held for `period`; by default for the sum of the control and the sensor period.
        """
        scale = 1.0 if rate else 1.0 / self.row[GAIN]
        held = np.exp(-0.5 * (period or self.clocks.control + self.clocks.samples) * s)
        return scale * held * (self.row[COUPLING] / s + self.row[COUPLING_DAMPING])

    def _felt(self, s: np.ndarray) -> np.ndarray:
        """Return the reflected force per task force: filters, sensor sample, and control period."""
        held = np.exp(-0.5 * self.clocks.control * s)
        if self.pilot.force == "true":
            return held
        hertz = self.pilot.bandwidth / (2.0 * math.pi)
        late = butterworth(hertz, s) * butterworth(FAST * hertz, s)
        return held * np.exp(-0.5 * self.clocks.samples * s) * late


def linear_case(
    pilot: TeleopPilot, joystick: Joystick, numbers: Master, tip: TipDrive, servo: Servo,
    clocks: Clocks, task: Impedance,
) -> LinearCase:  # fmt: skip
    """Build the linear case of one coordinate.

    Args:
        pilot: teleoperation settings of the scenario.
        joystick: the joystick.
        numbers: parameters of the master's control.
        tip: linear tip model along the coordinate.
        servo: gains of the servo.
        clocks: control and sensor periods.
        task: impedance of the environment.

    Returns:
        The linear case.

    Raises:
        InputError: no joystick axis moves the coordinate.
    """
    place = np.flatnonzero(numbers.axis[:, COORDINATE] == COORDINATES.index(tip.coordinate))
    if not len(place):
        raise InputError(_WHERE, f"no joystick axis moves {tip.coordinate}")
    axis, channel = int(place[0]), pilot.channel
    turns = AXES[axis].startswith("r")
    flotor = float(numbers.turning[axis - 3]) if turns else float(numbers.mass[0])
    held = Impedance(*joystick.hand.along(axis))
    return LinearCase(
        pilot, numbers.axis[axis].copy(), Impedance(flotor), held, tip, servo, clocks, task,
        channel.delay_forward, channel.delay_back,
    )  # fmt: skip


def local_ratio(case: LinearCase, displacement: float) -> float:
    """Return the reflection ratio of stiffness feedback for small force changes.

    Args:
        case: the case.
        displacement: constant displacement of the handle, scalar [m], [rad].

    Returns:
        `K_r |x|`, hand force per machine force [N/N]; K_r is the stiffness per force.

    Source: derivative of `K(f) x` by f; Zhu 1994, 4.1.
    """
    spring = case.spring
    return (spring.most - spring.nominal) / float(case.row[LIMIT]) * math.fabs(displacement)


DEFAULT_TASK = Impedance(damping=3.0e4, stiffness=1.0e6)  # stiff ground, a plate's default
_NORMALS = {"z": ("z",), "r": ("x", "-x")}
_PLACE = {"z": 2, "r": 0}


class Contact(NamedTuple):
    """Contact pose and impedance of the environment.

    Attributes:
        joints: axis -> position [rad].
        task: impedance along the coordinate.
        source: source of the impedance.
    """

    joints: dict[str, float]
    task: Impedance
    source: str


def scenario_case(
    scenario: Scenario, machine: Machine, joystick: Joystick, coordinate: str | None = None
) -> tuple[LinearCase, Contact]:
    """Build the linear case of a scenario, with the hand of its simulated operator.

    Args:
        scenario: scenario with a teleoperated pilot.
        machine: machine of the scenario.
        joystick: joystick; the operator's grip, posture and co-contraction replace its hand.
        coordinate: task coordinate; by default that of the operator's force target, otherwise z.

    Returns:
        The case, and the contact pose and impedance.

    Raises:
        InputError: the scenario is not teleoperated, the arm has no such coordinate, no force is
            reflected, or the operator's grip or posture is not known.
    """
    pilot = scenario.pilot
    if not isinstance(pilot, TeleopPilot):
        raise InputError(f"scenario {scenario.name}", "has no teleoperated pilot to analyse")
    if not pilot.ratio > 0.0:
        raise InputError("pilot.ratio", "no force is reflected; set a ratio, such as 1e-5")
    coordinates = COORDINATES[: len(arm_axes(machine))]
    wanted = coordinate or _pressed(pilot)
    if wanted not in coordinates:
        message = f"no {wanted!r}; the arm has {', '.join(coordinates)}"
        raise InputError("--coordinate", message)
    contact = _contact(scenario, machine, wanted)
    sensors, period = sensor_set(machine, scenario.sensors), 1.0 / scenario.control_rate
    clocks = Clocks(period, max(period, 1.0 / sensors.rate) if sensors else period)
    joystick = held_joystick(joystick, pilot.perception, scenario.folder)
    numbers, _ = master(joystick, pilot, coordinates)
    tip = tip_drive(machine, contact.joints, wanted, scenario.servo)
    case = linear_case(pilot, joystick, numbers, tip, scenario.servo, clocks, contact.task)
    return case, contact


def joystick_of(scenario: Scenario) -> str:
    """Return the name or file of a scenario's joystick, relative to the scenario's file."""
    name = scenario.pilot.joystick if isinstance(scenario.pilot, TeleopPilot) else "joystick"
    path = Path(scenario.folder, name)
    return str(path) if name != "joystick" and path.is_file() else name


def _pressed(pilot: TeleopPilot) -> str:
    operator = pilot.operator
    return operator.target.coordinate if isinstance(operator, Regulate | Track) else "z"


def _contact(scenario: Scenario, machine: Machine, coordinate: str) -> Contact:
    """Return the contact at the start pose, moved along the coordinate to the plate."""
    joints = machine.home | scenario.start.joints
    here = {name: joints.get(axis.joint, 0.0) for name, axis in machine.axes.items()}
    pose, plate = scenario.start.pose, _plate(scenario, coordinate)
    if pose and plate:
        pose = pose.model_copy(update={coordinate: plate.position[_PLACE[coordinate]]})
    if pose:
        here |= pose_to_joints(machine, pose, here, "start.pose")
    if plate:
        task = Impedance(plate.mass, plate.damping, plate.stiffness)
        return Contact(here, task, "the scenario's plate")
    if coordinate in ("r", "z"):
        return Contact(here, DEFAULT_TASK, "default, stiff ground")
    lever = pose.r if pose and coordinate == "theta" else 1.0
    turned = Impedance(0.0, *(lever**2 * v for v in (DEFAULT_TASK.damping, DEFAULT_TASK.stiffness)))
    return Contact(here, turned, f"default, stiff ground {lever:g} m from the axis")


def _plate(scenario: Scenario, coordinate: str) -> Plate | None:
    """Return the first plate whose normal is along a coordinate."""
    ways = _NORMALS.get(coordinate, ())
    for thing in scenario.surroundings:
        if isinstance(thing, Plate) and thing.normal in ways:
            return thing
    return None
