"""Linear model of one axis of a teleoperated scenario, built from its simulation parameters.

Hand (h) and flotor (m), the moving part of the joystick, have the impedance
`(M_m + M_h) s + B_h + K_h / s` with masses M, damper B and spring K. The coils add spring and damper of the
scenario's gains, sampled: a control period T holds them for T / 2 on average, and the damper's
difference quotient adds another T / 2. An operator who answers a directly reflected force with a
force does not control the position: the spring of the arm follows the handle,
`K_h (1 - exp(-s t)) / s`, with t the reflex time and half a decision period. Under rate control the
handle displacement x beyond the dead band commands the tip rate `k_v x`, so that the tip follows
`k_v V_h / s` with the handle's velocity V_h. Under position
control the tip follows the filtered position. The force at the tip returns through the estimator's
two filters, a hold of one sensor sample and the channel's delay, multiplied by the ratio.

Neglected: dead bands, stops, limits of force and acceleration, loss of contact, sensor noise, and
the other axes of the handle, which are at rest.

The valve-controlled machine is linearised at its tip along one task coordinate about a pose.
Oil is a spring: at held valves a drive's force F changes by `K (v_valve - v)` per second, with
`K = beta (A_h^2 / V_A + A_r^2 / V_B)` (bulk modulus beta, piston areas A and chamber volumes V_A, V_B)
and the velocity v_valve that the valve flow produces. The servo commands
`v_ref + g (y_ref - y) - p (F - mean F) / K` (`control.servo`) with the reference position y_ref and
velocity v_ref, the position gain g and the pressure feedback p. The valve follows with its lag V. For
one joint this is

    F = K / (s + p V L) [(V + g V / s) v_ref - (1 + g V / s) v],   L = T s / (T s + 1)

with the averaging time T of the drive's force.

The arm adds the compliances of its joints at the tip, each with its own lag: `1 / C_s` is the sum
of `J_i^2 / C_i`, and the tip follows its reference by the mean of the joints' `(V + g V / s) /
(1 + g V / s)`, weighted with the joints' contributions to the reference rate.

Also neglected: flow limits, leakage, friction, flexible transmissions, and the motion of the other
coordinates.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_axes, pose_to_joints
from hydrotele.control.state_filter import butterworth_response
from hydrotele.control.tip_balance import ArmBalance, create_arm_balance
from hydrotele.core.errors import InputError
from hydrotele.estimate.reduced_model import X, place_mechanism
from hydrotele.hydraulics.circuit import SLOT_COUNT, ActuatorKind, Slot
from hydrotele.kinematics.task_space import task_jacobian
from hydrotele.machine.joystick import AXES, Joystick
from hydrotele.machine.machine import Machine, get_sensor_set
from hydrotele.multibody.reduced_dynamics import compute_mass_and_bias
from hydrotele.scenario.scenario import Scenario, Servo
from hydrotele.scenario.surrounding_objects import Plate
from hydrotele.scenario.teleoperation import RegulateForce, TeleopPilot, TrackForce
from hydrotele.teleop.axis_table import (
    COORDINATE,
    COUPLING,
    COUPLING_DAMPING,
    DAMPING,
    DEADBAND,
    FORCE_LIMIT,
    GAIN,
    HANDLE_RANGE,
    MAX_REFLECTED_FORCE,
    MAX_STIFFNESS,
    MIN_STIFFNESS,
    NOMINAL_STIFFNESS,
    REFLECTION_RATIO,
)
from hydrotele.teleop.hand_impedance import attach_operator_hand
from hydrotele.teleop.master import MasterParameters, build_master
from hydrotele.teleop.neuromuscular_dynamics import REFLEX_DELAY
from hydrotele.teleop.operator_model import DECISION_RATE
from hydrotele.teleop.slave import LEAD_AVERAGING_TIME, SMOOTHING_BANDWIDTH
from hydrotele.teleop.stiffness_switching import StiffnessAxis
from hydrotele.teleop.two_port import Impedance, TwoPort


@dataclass(frozen=True)
class TipModel:
    """Linear model of the tip of an arm with k joints along one coordinate, about a pose.

    Attributes:
        coordinate: `r`, `theta`, `z`, `attitude` or `head`.
        mass: effective mass `1 / (J M^-1 J')` with the Jacobian row J of the coordinate and the mass
            matrix M of the joints [kg], [kg m^2].
        compliance: (k,) compliance at the tip due to the oil of each joint's drive, with closed valves
            [m/N], [rad/(N m)].
        rate_fractions: (k,) fraction of the tip's reference rate that each joint contributes; their
            sum is 1.
        gain: (k,) servo gains g [1/s].
        bandwidth: (k,) bandwidths of the valves [rad/s].
        damping: (k,) damping ratios of the valves [1].
        delay: (k,) delays of the commands [s].
    """

    coordinate: str
    mass: float
    compliance: np.ndarray
    rate_fractions: np.ndarray
    gain: np.ndarray
    bandwidth: np.ndarray
    damping: np.ndarray
    delay: np.ndarray

    @property
    def stiffness(self) -> float:
        """Stiffness of the oil at the tip along the coordinate, with closed valves [N/m], [N m/rad]."""
        return 1.0 / float(self.compliance.sum())


@dataclass(frozen=True)
class SamplingPeriods:
    """Control period and sampling period of the sensors [s]."""

    control_period: float
    sensor_period: float


def linearise_tip(machine: Machine, joints: dict[str, float], coordinate: str, servo: Servo) -> TipModel:
    """Build the linear model of a machine's tip along one task coordinate, about a pose.

    Args:
        machine: machine with valve-controlled drives in all joints of its arm.
        joints: axis -> joint position [rad]; the other axes are at their home position.
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
    arm = create_arm_balance(machine, where)
    for i, name in zip(arm.joint, axes, strict=True):
        arm.z[i] = joints.get(name, arm.z[i])
    mass, lever, blend = _tip_mass_and_lever_arms(arm, COORDINATES.index(coordinate))
    valves = [list(machine.hydraulic_axes).index(name) for name in axes]
    turning = np.array([_joint_oil_stiffness(arm, valve) for valve in valves])
    if not np.any(lever):
        raise InputError(where, f"no joint moves {coordinate} in this pose")
    user = arm.model.user.reshape(-1, SLOT_COUNT)[valves]
    return TipModel(
        coordinate, mass, lever**2 / turning, lever * blend,
        np.array([servo.axis_gains.get(name, servo.position_gain) for name in axes]),
        user[:, Slot.BANDWIDTH], user[:, Slot.DAMPING],
        np.array([machine.axes[name].command_delay for name in axes], float),
    )  # fmt: skip


def _tip_mass_and_lever_arms(arm: ArmBalance, row: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Compute the effective mass of the tip along a task coordinate, and the joints' lever arms.

    Args:
        arm: model of the arm in the pose `arm.z`.
        row: number of the task coordinate.

    Returns:
        Effective mass [kg] or [kg m^2], Jacobian row (k,) of the coordinate by the joint angles, and
        joint rates (k,) that move the coordinate at unit rate and keep the others constant.
    """
    motion, k = arm.space.motion, len(arm.joint)
    place_mechanism(arm.model, arm.space, arm.z)
    compute_mass_and_bias(arm.model.mech, motion)
    full = motion.basis.T @ motion.mass @ motion.basis
    own = full[np.ix_(arm.joint, arm.joint)]
    table = np.zeros((k, k))
    task_jacobian(arm.task, arm.z[arm.joint], table)
    lever = table[row].copy()
    mass = 1.0 / float(lever @ np.linalg.solve(own, lever))
    return mass, lever, np.linalg.solve(table, np.eye(k)[row])


def _joint_oil_stiffness(arm: ArmBalance, valve: int) -> float:
    """Return the stiffness of a joint due to the oil in its drive's chambers [N m/rad].

    The pose is the present one of the model `arm`, and `valve` is the number of the drive. Air in
    the oil is neglected: it lowers the stiffness in a way that depends on the unknown pressures.
    """
    user = arm.model.user[valve * SLOT_COUNT : (valve + 1) * SLOT_COUNT]
    head, rod = user[Slot.VOLUME_HEAD], user[Slot.VOLUME_ROD]
    if user[Slot.KIND] == ActuatorKind.CYLINDER:
        x = arm.space.drive[X, valve]
        head = head + user[Slot.AREA_HEAD] * x
        rod = rod + user[Slot.AREA_ROD] * (user[Slot.STROKE] - x)
    hose = user[Slot.BULK_MODULUS] * user[Slot.HOSE_COMPLIANCE]
    oil = user[Slot.AREA_HEAD] ** 2 / (head + hose) + user[Slot.AREA_ROD] ** 2 / (rod + hose)
    lever = float(np.abs(arm.space.row[valve]).max())
    return float(user[Slot.BULK_MODULUS] * oil * lever**2)


def tip_controller_impedance(tip: TipModel, servo: Servo, clocks: SamplingPeriods, s: np.ndarray) -> np.ndarray:
    """Return the servo's impedance at the tip: force per velocity error of the tip.

    It results from the stiffness of the oil, the valves' lag, the servo's gains and sensor sampling.

    Args:
        tip: linear tip model.
        servo: gains of the servo.
        clocks: control and sensor periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [N s/m], [N m s/rad].

    Source: this module's docstring.
    """
    valve, place_lag, rubbing = _drive_frequency_responses(tip, servo, clocks, s)
    single = (1.0 + tip.gain * valve * place_lag / s[..., None]) / (s[..., None] + rubbing)
    return 1.0 / (tip.compliance / single).sum(axis=-1)


def tip_tracking_response(tip: TipModel, servo: Servo, clocks: SamplingPeriods, s: np.ndarray) -> np.ndarray:
    """Return the frequency response of the unloaded tip: its velocity per reference velocity.

    Args:
        tip: linear tip model.
        servo: gains of the servo.
        clocks: control and sensor periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [1].

    Source: this module's docstring; `teleop.slave.update_references` for the phase lead.
    """
    valve, place_lag, _ = _drive_frequency_responses(tip, servo, clocks, s)
    held = np.exp(-0.5 * clocks.control_period * s)
    ahead = servo.feedforward * held * (1.0 + servo.lead * s / (LEAD_AVERAGING_TIME * s + 1.0))
    back = tip.gain * place_lag / s[..., None]
    return (tip.rate_fractions * valve * (ahead[..., None] + back) / (1.0 + valve * back)).sum(axis=-1)


def _drive_frequency_responses(tip: TipModel, servo: Servo, clocks: SamplingPeriods, s: np.ndarray):
    """Return three frequency responses of the k drives at complex frequencies s (...).

    The first (..., k) is the velocity that the valve flow produces per commanded velocity, with the
    command's delay [1]. The second (..., 1) is the delay of half a sensor period [1]. The third
    (..., k) is the gain of the servo's pressure feedback with its high-pass filter, times the first
    and the second response [1/s].
    """
    at = s[..., None]
    valve = tip.bandwidth**2 / (at**2 + 2.0 * tip.damping * tip.bandwidth * at + tip.bandwidth**2)
    valve = valve * np.exp(-tip.delay * at)
    held = np.exp(-0.5 * clocks.sensor_period * at)
    passed = servo.load_time * at / (servo.load_time * at + 1.0)
    return valve, held, servo.pressure_feedback * passed * valve * held


_WHERE = "linear case"
# bandwidth of the motion estimate over that of the force estimate, as in `teleoperation_system`
MOTION_BANDWIDTH_RATIO = 2.0
STRUCTURES = ("rate_force", "position_force", "rate_position", "position_position")


@dataclass(frozen=True)
class LinearCase:
    """Linear loop of one axis with hand, joystick, machine and task.

    It provides `task`, `hand`, `with_delay` and `make_port`, so that the functions of
    `teleop.linear_analysis` can analyse it.

    Attributes:
        pilot: teleoperation settings of the scenario.
        axis_parameters: (18,) parameters of the joystick axis, a row of `build_axis_table`.
        master: mass of the flotor [kg] or its moment of inertia about the handle [kg m^2].
        hand_impedance: mass, damper and spring of the hand.
        tip: linear tip model of the machine.
        servo: gains of the servo.
        periods: control and sensor periods.
        task: impedance of the environment along the coordinate.
        delay_forward: delay from the master to the machine [s].
        delay_back: delay from the machine to the master [s].
    """

    pilot: TeleopPilot
    axis_parameters: np.ndarray
    master: Impedance
    hand_impedance: Impedance
    tip: TipModel
    servo: Servo
    periods: SamplingPeriods
    task: Impedance
    delay_forward: float = 0.0
    delay_back: float = 0.0

    @property
    def ratio(self) -> float:
        """Ratio of the reflected force at the hand to the machine's force [N/N], [N m/(N m)]."""
        return float(self.axis_parameters[REFLECTION_RATIO])

    @property
    def force_limit(self) -> float:
        """Machine force above which the reflected force no longer increases [N], [N m]."""
        return float(self.axis_parameters[MAX_REFLECTED_FORCE])

    @property
    def deadband(self) -> float:
        """Handle displacement up to which no rate is commanded under rate control [m], [rad]."""
        return float(self.axis_parameters[DEADBAND])

    @property
    def reach(self) -> float:
        """Displacement of the handle at its stop [m], [rad]."""
        return float(self.axis_parameters[HANDLE_RANGE])

    @property
    def spring(self) -> StiffnessAxis:
        """Mass, damping and stiffness range of the joystick axis under stiffness feedback, no hand."""
        r = self.axis_parameters
        return StiffnessAxis(
            self.master.mass,
            float(r[DAMPING]),
            float(r[NOMINAL_STIFFNESS]),
            float(r[MIN_STIFFNESS]),
            float(r[MAX_STIFFNESS]),
        )

    @property
    def operator_controls_force(self) -> bool:
        """Whether the simulated operator controls a contact force instead of a position.

        This is the case if the scenario gives the operator a target force, unless the force reflection
        is `coordinating_force`, a spring between handle and machine.
        """
        pressing = isinstance(self.pilot.operator, RegulateForce | TrackForce)
        return pressing and self.pilot.reflection != "coordinating_force"

    def with_delay(self, delay: float) -> "LinearCase":
        """Return a copy of the case with the same delay [s] in each direction."""
        return replace(self, delay_forward=delay, delay_back=delay)

    def hand(self, s: np.ndarray) -> np.ndarray:
        """Return the hand's impedance [N s/m], [N m s/rad] at complex frequencies [rad/s].

        An operator who controls a force moves the rest position of the arm's spring to the handle's
        position after the reflex delay. The spring force then vanishes for slow motions.
        """
        if not self.operator_controls_force:
            return self.hand_impedance(s)
        late = REFLEX_DELAY + 0.5 / DECISION_RATE + 0.5 * self.periods.control_period
        own = self.hand_impedance.stiffness / s * np.exp(-late * s)
        return self.hand_impedance(s) - own

    def make_port(self, structure: str, return_gain: float = 1.0) -> TwoPort:
        """Return the linear two-port of joystick and machine with a given control structure.

        Args:
            structure: control mode and reflected quantity. In `rate_force` and `position_force` the
                contact force acts on the handle, in `rate_position` and `position_position` a spring and
                damper to the machine's position.
            return_gain: factor on the reflected force, or on that spring and damper [1].

        Returns:
            The two-port.

        Raises:
            InputError: the structure is not known.
        """
        if structure not in STRUCTURES:
            raise InputError(_WHERE, f"{structure!r}; valid structures: {', '.join(STRUCTURES)}")
        rate, feels_force = structure.startswith("rate"), structure.endswith("force")
        slave = Impedance(self.tip.mass)

        def zero_block(s: np.ndarray) -> np.ndarray:
            return np.zeros_like(s)

        def slave_control_block(s: np.ndarray) -> np.ndarray:
            return tip_controller_impedance(self.tip, self.servo, self.periods, s)

        def velocity_forward_block(s: np.ndarray) -> np.ndarray:
            follows = tip_tracking_response(self.tip, self.servo, self.periods, s)
            return (self.tip.mass * s + slave_control_block(s)) * follows * self._commanded_velocity(rate, s)

        def force_back_block(s: np.ndarray) -> np.ndarray:
            return return_gain * self.ratio * self._reflected_force_response(s)

        def coupling_block(s: np.ndarray) -> np.ndarray:
            return -return_gain * self._coupling_impedance(rate, s)

        def master_block(s: np.ndarray) -> np.ndarray:
            if feels_force:
                return self._centring_impedance(rate, s)
            if self.pilot.coordinating_position == "handle":
                asked = self.axis_parameters[GAIN] / s if rate else self.axis_parameters[GAIN]
                linked = self._coupling_impedance(rate, s, self.periods.control_period) * asked
            else:
                late = self.delay_forward + self.delay_back
                asked = np.exp(-s * late) * self._commanded_velocity(rate, s)
                linked = self._coupling_impedance(rate, s) * asked
            return self._centring_impedance(rate, s) + return_gain * linked

        return TwoPort(
            self.master, slave, master_block, slave_control_block, velocity_forward_block,
            force_back_block if feels_force else zero_block, zero_block,
            zero_block if feels_force else coupling_block, self.delay_forward, self.delay_back,
        )  # fmt: skip

    def _commanded_velocity(self, rate: bool, s: np.ndarray) -> np.ndarray:
        """Return the commanded tip velocity per velocity of the handle, as a frequency response.

        It is the gain of the axis times an integrator under rate control (`rate` true), otherwise
        times a second-order low-pass filter.
        """
        if rate:
            return self.axis_parameters[GAIN] / s
        return self.axis_parameters[GAIN] * (SMOOTHING_BANDWIDTH / (s + SMOOTHING_BANDWIDTH)) ** 2

    def _centring_impedance(self, rate: bool, s: np.ndarray) -> np.ndarray:
        """Return the impedance of the coils' centring spring and damper, with delays [N s/m].

        Under position control (`rate` false) there is no spring, only the damper.
        """
        held = np.exp(-0.5 * self.periods.control_period * s)
        return held * (
            (self.axis_parameters[NOMINAL_STIFFNESS] if rate else 0.0) / s + self.axis_parameters[DAMPING] * held
        )

    def _coupling_impedance(self, rate: bool, s: np.ndarray, period: float | None = None) -> np.ndarray:
        """Return the force on the hand per difference of commanded and actual tip velocity [N s/m].

        This is the impedance of the spring and damper of the reflection `coordinating_force`, which
        act on the difference between commanded and actual tip position. The force is held for
        `period` [s]; by default for the sum of the control and the sensor period.
        """
        scale = 1.0 if rate else 1.0 / self.axis_parameters[GAIN]
        held = np.exp(-0.5 * (period or self.periods.control_period + self.periods.sensor_period) * s)
        return scale * held * (self.axis_parameters[COUPLING] / s + self.axis_parameters[COUPLING_DAMPING])

    def _reflected_force_response(self, s: np.ndarray) -> np.ndarray:
        """Return the frequency response from contact to reflected force, without the ratio [1].

        It contains the delays of half a sensor period and half a control period, and the two
        filters with which the contact force is estimated. An exactly known force has only the delay
        of the control period.
        """
        held = np.exp(-0.5 * self.periods.control_period * s)
        if self.pilot.force == "true":
            return held
        hertz = self.pilot.bandwidth / (2.0 * math.pi)
        late = butterworth_response(hertz, s) * butterworth_response(MOTION_BANDWIDTH_RATIO * hertz, s)
        return held * np.exp(-0.5 * self.periods.sensor_period * s) * late


def build_linear_case(
    pilot: TeleopPilot, joystick: Joystick, numbers: MasterParameters, tip: TipModel, servo: Servo,
    clocks: SamplingPeriods, task: Impedance,
) -> LinearCase:  # fmt: skip
    """Build the linear loop of one task coordinate from joystick, machine and environment.

    Args:
        pilot: teleoperation settings of the scenario, of which the channel gives the delays.
        joystick: the joystick; its hand holds the handle.
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
    flotor = float(numbers.inertia[axis - 3]) if turns else float(numbers.mass[0])
    held = Impedance(*joystick.hand.axis_impedance(axis))
    return LinearCase(
        pilot, numbers.axis[axis].copy(), Impedance(flotor), held, tip, servo, clocks, task,
        channel.delay_forward, channel.delay_back,
    )  # fmt: skip


def stiffness_feedback_ratio(case: LinearCase, displacement: float) -> float:
    """Return the change of hand force per change of machine force under stiffness feedback.

    Args:
        case: linear case with the parameters of the joystick axis.
        displacement: constant displacement of the handle, scalar [m], [rad].

    Returns:
        `K_r |x|`, hand force per machine force [N/N]; K_r is the stiffness per force.

    Source: derivative by the machine force f of the hand force `K(f) x`; Zhu 1994, 4.1.
    """
    spring = case.spring
    return (
        (spring.max_stiffness - spring.nominal_stiffness)
        / float(case.axis_parameters[FORCE_LIMIT])
        * math.fabs(displacement)
    )


DEFAULT_TASK = Impedance(damping=3.0e4, stiffness=1.0e6)  # stiff ground, a plate's default
_PLATE_NORMALS = {"z": ("z",), "r": ("x", "-x")}
_POSITION_INDEX = {"z": 2, "r": 0}


class Contact(NamedTuple):
    """Pose of the arm at which it touches the environment, and the environment's impedance.

    Attributes:
        joints: axis -> joint position [rad].
        task: impedance of the environment along the coordinate.
        source: text that states where the impedance comes from.
    """

    joints: dict[str, float]
    task: Impedance
    source: str


def build_scenario_case(
    scenario: Scenario, machine: Machine, joystick: Joystick, coordinate: str | None = None
) -> tuple[LinearCase, Contact]:
    """Build the linear loop of a teleoperated scenario, with the hand of its simulated operator.

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
        raise InputError(
            f"scenario {scenario.name}",
            "has no pilot of kind teleop (an operator at a joystick) to analyse; choose a teleoperated scenario",
        )
    if not pilot.ratio > 0.0:
        raise InputError("pilot.ratio", "no force is reflected; set a ratio, such as 1e-5")
    coordinates = COORDINATES[: len(arm_axes(machine))]
    wanted = coordinate or _default_coordinate(pilot)
    if wanted not in coordinates:
        message = f"no {wanted!r}; the arm has {', '.join(coordinates)}"
        raise InputError("--coordinate", message)
    contact = _determine_contact_pose(scenario, machine, wanted)
    sensors, period = get_sensor_set(machine, scenario.sensors), 1.0 / scenario.control_rate
    clocks = SamplingPeriods(period, max(period, 1.0 / sensors.rate) if sensors else period)
    joystick = attach_operator_hand(joystick, pilot.perception, scenario.folder)
    numbers, _ = build_master(joystick, pilot, coordinates)
    tip = linearise_tip(machine, contact.joints, wanted, scenario.servo)
    case = build_linear_case(pilot, joystick, numbers, tip, scenario.servo, clocks, contact.task)
    return case, contact


def _default_coordinate(pilot: TeleopPilot) -> str:
    operator = pilot.operator
    return operator.target.coordinate if isinstance(operator, RegulateForce | TrackForce) else "z"


def _determine_contact_pose(scenario: Scenario, machine: Machine, coordinate: str) -> Contact:
    """Return the contact with the scenario's plate, or else with stiff ground at the start pose.

    For a plate, the start pose is moved along the coordinate to the plate's position.
    """
    joints = machine.home | scenario.start.joints
    here = {name: joints.get(axis.joint, 0.0) for name, axis in machine.axes.items()}
    pose, plate = scenario.start.pose, _find_plate(scenario, coordinate)
    if pose and plate:
        pose = pose.model_copy(update={coordinate: plate.position[_POSITION_INDEX[coordinate]]})
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


def _find_plate(scenario: Scenario, coordinate: str) -> Plate | None:
    """Return the scenario's first plate whose normal is along a coordinate, None without one."""
    ways = _PLATE_NORMALS.get(coordinate, ())
    for thing in scenario.surroundings:
        if isinstance(thing, Plate) and thing.normal in ways:
            return thing
    return None
