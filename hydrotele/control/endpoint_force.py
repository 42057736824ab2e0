"""Estimation of the force at the tip of an arm from the pressures of its drives.

The static estimate subtracts the gravity torque, which is linear in a few identified parameters,
from the drive torque (Zhu 1994, 6.1). The dynamic estimate uses the complete model with inertia,
Coriolis forces, friction and the closed chains of the cylinders.

A fast filter gives positions, rates, accelerations and pressures with equal delay, so that the
force balance between them holds and friction corresponds to the rate of the same time. The result passes a
slow filter, because the force error from angle noise grows with the fifth power of the frequency.

`EndpointForce` estimates online, `endpoint_force_of_log` from a log. `identify_gravity` identifies
the static model from a log of slow motion.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.control.state_filter import (
    LAST_READING,
    RATE,
    SECOND_DERIVATIVE,
    VALUE,
    filter_delay,
    filter_noise_gains,
    filter_signal,
    filter_step,
    filter_step_matrix,
)
from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.control.tip_balance import (
    arm_joints,
    arm_record,
    compute_dynamic_external_forces,
    compute_static_external_forces,
    create_arm_balance,
    gravity_parameter_count,
    independent_axes,
    joint_gravity_torque,
    read_arm_record,
    solve_tip_force,
)
from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, SensorSet, reading_noise_rms

_GRAVITY_NAMES = ("C2", "S2", "C23", "S23", "C234", "S234", "C5")
_POSES_PER_JOINT = 9  # poses per joint at which the static model is fitted to the masses
_INITIAL_GRAVITY_STD = 3.0e5  # N m, initial standard deviation of the gravity parameters: no prior knowledge
_INITIAL_FRICTION_STD = 3.0e4  # N, initial standard deviation of dry friction
EQUATION_PERIOD_S = 0.2
"""Time between the equations of an identification [s]."""
_SLOW_MOTION_BANDWIDTH_HZ = 1.0  # Hz, bandwidth of the filter of slow motion
_MIN_SLIDING_SPEED = 5.0e-3  # m/s or rad/s: slower drives may be at rest and give no friction equation
_MIN_EQUATIONS = 50  # equations before the parameters are a valid estimate (Zhu 1994, 6.1.3)
_NORMAL95 = 1.96


@dataclass(frozen=True)
class GravityModel:
    """Parameters of the static gravity model.

    Attributes:
        names: (p,) trigonometric factors of the parameters: C2, S2, C23, S23, C234, S234, C5, where C23 is
            cos(q2 + q3) and so on.
        value: (p,) parameters [N m].
        ci95_half_width: (p,) half width of the 95 % intervals [N m]; 0 if computed from masses.
        history: (r, p) parameters after every equation [N m]; empty if computed from masses.
        residual: (m - 1,) RMS of the residual torques, from the boom outwards [N m].
        outlier_indices: (q,) indices of equations removed as outliers, sorted.
    """

    names: tuple[str, ...]
    value: np.ndarray
    ci95_half_width: np.ndarray
    history: np.ndarray
    residual: np.ndarray
    outlier_indices: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def gravity_regressor(q: np.ndarray) -> np.ndarray:
    """Return the regressor Y of the static model `tau = Y(q) P` of an arm's gravity torques tau [N m].

    P are the gravity parameters [N m].

    Args:
        q: (m,) joint angles of the arm, swing first [rad].

    Returns:
        (m, p) regressor of m joints and p parameters [1].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    joint, size = np.arange(len(q)), gravity_parameter_count(len(q))
    units = np.eye(size)
    return np.array([[joint_gravity_torque(q, joint, units[p], i) for p in range(size)] for i in range(len(q))])


def fit_gravity_to_masses(machine: Machine) -> GravityModel:
    """Fit the static model to the gravity torques of a machine's masses.

    The complete model at rest is fitted over the ranges of the joints. The gravity torques of
    the links have the form of the static model. Those of cylinders and linkages do not, which causes the
    residual torques.

    Args:
        machine: machine with an arm whose joints are driven by valves.

    Returns:
        The gravity parameters and the residual torques of the fit.

    Raises:
        InputError: the arm's joints are not all driven.
    """
    arm = create_arm_balance(machine, f"gravity of {machine.name}")
    joints = arm_joints(machine)
    ranges = [machine.joints[j].range or (-math.pi, math.pi) for j in joints[1:]]
    grid = np.meshgrid(*(np.linspace(low, high, _POSES_PER_JOINT) for low, high in ranges), indexing="ij")
    poses = np.column_stack([np.zeros(grid[0].size), *(axis.ravel() for axis in grid)])
    torque = np.zeros((len(poses), len(joints)))
    _gravity_torques(arm, poses, torque)
    rows = np.array([gravity_regressor(q)[1:] for q in poses])
    value = np.linalg.lstsq(rows.reshape(-1, rows.shape[2]), torque[:, 1:].ravel(), rcond=None)[0]
    left = torque[:, 1:] - rows @ value
    size = len(value)
    return GravityModel(
        _GRAVITY_NAMES[:size],
        value,
        np.zeros(size),
        np.zeros((0, size)),
        np.sqrt(np.mean(left**2, axis=0)),
    )


@compiled
def _gravity_torques(arm, poses, torque):
    """Compute the gravity torques on the m joints of an arm in r `poses` (r, m) [rad].

    They are written to `torque` (r, m) [N m].
    """
    outside = np.zeros(len(arm.work))
    for row in range(len(poses)):
        for i in range(len(arm.joint)):
            arm.z[arm.joint[i]] = poses[row, i]
        compute_dynamic_external_forces(arm, outside)
        for i in range(len(arm.joint)):
            torque[row, i] = outside[arm.joint[i]]


class SlowMotion(NamedTuple):
    """Filtered signals of slow motion of an arm with m joints, r rows.

    Attributes:
        angle: (r, m) joint angles [rad].
        torque: (r, m) torques of the drives [N m].
        friction_torque: (r, m) torque per newton of dry friction of the drive, with the sign of the joint rate
            [m]; 0 if the drive may be at rest.
    """

    angle: np.ndarray
    torque: np.ndarray
    friction_torque: np.ndarray


def extract_slow_motion(machine: Machine, log: Log, period: float = EQUATION_PERIOD_S) -> SlowMotion:
    """Compute joint angles and drive torques of an arm from a log of slow motion.

    Cylinder forces are converted to torques by virtual work through the linkages.

    Args:
        machine: the machine.
        log: measured angles and pressures.
        period: time between rows [s], rounded to a multiple of the log's period.

    Returns:
        One row per period.

    Raises:
        InputError: a channel is missing, or a joint is not driven by a valve.

    Source: Zhu 1994, 6.12 and 6.13.
    """
    independent_axes(machine, f"torques of {machine.name}")
    driver = {axis.joint: name for name, axis in machine.axes.items()}
    table, every = (
        filter_step_matrix(_SLOW_MOTION_BANDWIDTH_HZ, 1.0 / log.rate),
        max(1, round(period * log.rate)),
    )
    columns = []
    for name in (driver[joint] for joint in arm_joints(machine)):
        head, rod = machine.axes[name].hydraulic_drive.effective_areas
        force = head * log[f"pressure_head.{name}"] - rod * log[f"pressure_rod.{name}"]
        moved, pushed = (filter_signal(table, x)[::every] for x in (log[f"angle.{name}"], force))
        lever = axis_linkage(machine, name).rate(moved[:, VALUE])
        speed = np.abs(lever * moved[:, RATE])
        way = np.where(speed > _MIN_SLIDING_SPEED, np.sign(moved[:, RATE]), 0.0)
        columns.append((moved[:, VALUE], lever * pushed[:, VALUE], np.abs(lever) * way))
    return SlowMotion(*(np.column_stack(part) for part in zip(*columns, strict=True)))


def identify_gravity(
    machine: Machine, log: Log, friction: bool = True, *, remove_outliers: bool = False,
    period: float = EQUATION_PERIOD_S,
) -> GravityModel:  # fmt: skip
    """Identify the static gravity model from a log of slow motion by recursive least squares.

    With `remove_outliers`, equations with large residuals, as during a temporary sensor failure,
    are removed and the estimation is repeated until none is left. By Chauvenet's criterion, a
    residual is large if less than half an equation is expected to exceed it. The expected normal
    distribution has the scale of the median absolute residual of the joint.

    Args:
        machine: the machine; its masses are not used.
        log: measured angles and pressures of joints that move slowly back and forth over their
            ranges.
        friction: whether dry friction of every drive is estimated as well. If not, it averages out
            in the torques, as in Zhu.
        remove_outliers: whether equations with large residuals are removed.
        period: time between equations [s].

    Returns:
        The parameters with their history.

    Raises:
        InputError: a channel is missing, the log is too short, or too few equations are left after
            removing outliers.

    Source: Zhu 1994, 6.1.3; Chauvenet 1863, A manual of spherical and practical astronomy, vol. 2.
    """
    moves = extract_slow_motion(machine, log, period)
    size, joints = gravity_parameter_count(moves.angle.shape[1]), moves.angle.shape[1]
    rows = np.array([gravity_regressor(q)[1:] for q in moves.angle])
    if friction:
        rubbing = moves.friction_torque[:, 1:, None] * np.eye(joints - 1)
        rows = np.concatenate([rows, rubbing], axis=2)
    torque, kept = moves.torque[:, 1:], np.ones(len(rows), bool)
    while True:
        if np.count_nonzero(kept) < _MIN_EQUATIONS:
            raise InputError(log.source, f"at least {_MIN_EQUATIONS * period:g} s of slow motion are needed")
        found, history = _solve_recursively(rows[kept], torque[kept], size)
        left = torque - rows @ found.value
        outside = kept & _are_outliers(left, kept)
        if not remove_outliers or not outside.any():
            break
        kept &= ~outside
    left = left[kept]
    usual = math.sqrt(float(np.sum(left**2)) / (left.size - rows.shape[2]))
    return GravityModel(
        _GRAVITY_NAMES[:size],
        found.value[:size],
        _NORMAL95 * usual * np.sqrt(np.diag(found.covariance)[:size]),
        np.array(history),
        np.sqrt(np.mean(left**2, axis=0)),
        np.flatnonzero(~kept),
    )


def _solve_recursively(
    rows: np.ndarray, torque: np.ndarray, size: int
) -> tuple[RecursiveLeastSquares, list[np.ndarray]]:
    """Solve the equations `rows @ P = torque` by recursive least squares.

    Args:
        rows: (r, m - 1, p) regressors of r instants, without the swing joint.
        torque: (r, m - 1) torques of the drives [N m].
        size: number of gravity parameters, which come first; the others are dry friction.

    Returns:
        The estimator with the final parameters P, and the gravity parameters (size,) after every
        instant [N m].
    """
    spread = np.append(np.full(size, _INITIAL_GRAVITY_STD), np.full(rows.shape[2] - size, _INITIAL_FRICTION_STD))
    found, history = RecursiveLeastSquares(np.zeros(rows.shape[2]), spread), []
    for table, torques in zip(rows, torque, strict=True):
        for row, one in zip(table, torques, strict=True):
            found.update(row, one)
        history.append(found.value[:size])
    return found, history


def _are_outliers(residuals: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return for each instant (r,) whether a residual `residuals` (r, m - 1) is an outlier (Chauvenet's criterion).

    The scale of the residuals is computed only from the instants with `kept` (r,) True, the others having been
    removed as outliers before.
    """
    from scipy.special import ndtri  # imported here, because runs do not need it

    scale = np.median(np.abs(residuals[kept]), axis=0) / ndtri(0.75)
    most = -ndtri(0.25 / np.count_nonzero(kept))
    return np.asarray((np.abs(residuals) > most * scale).any(axis=1))


STATUS_WAITING, STATUS_GOOD, STATUS_BAD, STATUS_SINGULAR = range(4)
_JOINT_ROW, _HEAD_ROW, _ROD_ROW = range(3)  # rows of `DriveReadings.last`


class DriveReadings(NamedTuple):
    """Filters and last valid readings of the force estimator: n coordinates, h valves, k axes, m task forces.

    Attributes:
        period: time between two readings of the sensors [s].
        settle: number of initial readings that are averaged.
        tables: (2, 3, 5) tables of the reading filter and the force filter.
        position: (n,) column of the axis of each coordinate.
        valve: (h,) column of the axis of each valve.
        state: (n + 2 h + m, 4) filter states: positions, pressures, force at the tip.
        outside: (n,) external forces on the coordinates [N m] or [N].
        last: (3, k) last valid readings of joint, head and rod; NaN before the first.
        still: (3, k) number of readings since the last change.
    """

    period: float
    settle: int
    tables: np.ndarray
    position: np.ndarray
    valve: np.ndarray
    state: np.ndarray
    outside: np.ndarray
    last: np.ndarray
    still: np.ndarray


@compile_without_allocation
def endpoint_force_step(arm, readings, dynamic, count, joint, head, rod, out):
    """Filter new sensor readings and estimate the force of the environment on the arm's tip.

    Args:
        arm: ArmBalance.
        readings: DriveReadings.
        dynamic: whether the complete model is used, or gravity only; scalar.
        count: number of previous readings; scalar. The first ones are averaged, assuming a machine
            at rest.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: force at the tip along r [N], theta [N m], z [N], then attitude and head [N m].

    Returns:
        STATUS_WAITING until every channel has a reading, STATUS_GOOD, STATUS_BAD if a reading was not
        finite and was replaced by the last one, STATUS_SINGULAR if the arm is singular and `out` is
        unchanged.

    Source: Zhu 1994, 6.1.
    """
    r, n = readings, len(readings.position)
    good = _store_readings(r.last[_JOINT_ROW], r.still[_JOINT_ROW], r.position, joint)
    good = _store_readings(r.last[_HEAD_ROW], r.still[_HEAD_ROW], r.valve, head) and good
    good = _store_readings(r.last[_ROD_ROW], r.still[_ROD_ROW], r.valve, rod) and good
    if not _has_all_readings(r):
        return STATUS_WAITING
    places = n + 2 * len(r.valve)
    for c in range(places):
        place, value = _get_reading(r, c)
        if count < r.settle:
            before = r.state[c, VALUE] if count > 0 else value
            _reset_filter(r.state[c], before + (value - before) / (count + 1))
        else:
            filter_step(r.tables[0], r.state[c], value)
        arm.z[place] = r.state[c, VALUE]
        if c < n:
            arm.z[n + c] = r.state[c, RATE]
            arm.acceleration[c] = r.state[c, SECOND_DERIVATIVE]
    if dynamic:
        compute_dynamic_external_forces(arm, r.outside)
    else:
        compute_static_external_forces(arm, r.outside)
    if not solve_tip_force(arm, r.outside, out):
        return STATUS_SINGULAR
    for i in range(len(out)):
        if count < r.settle:
            _reset_filter(r.state[places + i], out[i])
        else:
            filter_step(r.tables[1], r.state[places + i], out[i])
        out[i] = r.state[places + i, VALUE]
    return STATUS_GOOD if good else STATUS_BAD


@compile_without_allocation
def _reset_filter(state, value):
    """Set the state of a filter as if its input had always been `value`; both derivatives are 0."""
    state[VALUE], state[RATE], state[SECOND_DERIVATIVE], state[LAST_READING] = (
        value,
        0.0,
        0.0,
        value,
    )


@compile_without_allocation
def _get_reading(r, c):
    """Return the index of signal c in the arm's state vector, and the last valid reading of its sensor.

    The signals are the joint positions, then head and rod pressure of every valve.
    """
    n = len(r.position)
    if c < n:
        return c, r.last[_JOINT_ROW, r.position[c]]
    i, side = (c - n) // 2, (c - n) % 2
    return 2 * n + 4 * i + 2 + side, r.last[_HEAD_ROW + side, r.valve[i]]


@compile_without_allocation
def _store_readings(last, still, used, values):
    """Store the finite ones of new readings, and count how long each channel has not changed.

    Args:
        last: (k,) last valid readings, updated.
        still: (k,) number of readings since the last change, updated.
        used: indices of the channels that are used.
        values: (k,) new readings.

    Returns:
        Whether all used readings are finite.
    """
    good = True
    for c in range(len(used)):
        i = used[c]
        if not math.isfinite(values[i]):
            good = False
            still[i] += 1
        elif values[i] == last[i]:
            still[i] += 1
        else:
            last[i] = values[i]
            still[i] = 0
    return good


@compile_without_allocation
def _has_all_readings(readings):
    """Return whether all used channels have had a finite reading."""
    for i in readings.position:
        if math.isnan(readings.last[_JOINT_ROW, i]):
            return False
    for i in readings.valve:
        if math.isnan(readings.last[_HEAD_ROW, i]) or math.isnan(readings.last[_ROD_ROW, i]):
            return False
    return True


_READINGS_DTYPE = np.dtype(
    [("period", np.float64)]
    + [(name, np.int64) for name in ("settle", "free", "valves", "signals", "axes")]
    + [(name, np.int64) for name in ("tables", "position", "valve")]  # addresses from here on
    + [(name, np.int64) for name in ("state", "outside", "last", "still")],
    align=True,
)


def _readings_record(r: DriveReadings) -> np.ndarray:
    """Pack DriveReadings into a record (1,) of sizes and array addresses; the arrays must outlive it."""
    arrays = {name: part for name, part in r._asdict().items() if isinstance(part, np.ndarray)}
    record = address_record(_READINGS_DTYPE, arrays)
    (record["signals"], _), (_, record["axes"]) = r.state.shape, r.last.shape
    record["free"], record["valves"] = len(r.position), len(r.valve)
    record["period"], record["settle"] = r.period, r.settle
    return record


@compiled
def _update_force_from_records(arm, kept, dynamic, count, joint, head, rod, out):
    """Unpack the records of arm and readings and update the force at the tip (`endpoint_force_step`).

    Returns:
        Status of the update, and the number of readings since the longest constant channel changed.
    """
    r = kept[0]
    still = int64_view(r.still, 3 * r.axes).reshape((3, r.axes))
    readings = DriveReadings(
        r.period, r.settle, float64_view(r.tables, 30).reshape((2, 3, 5)), int64_view(r.position, r.free),
        int64_view(r.valve, r.valves), matrix_view(r.state, r.signals, 4), float64_view(r.outside, r.free),
        matrix_view(r.last, 3, r.axes), still,
    )  # fmt: skip
    status = endpoint_force_step(read_arm_record(arm[0]), readings, dynamic, count, joint, head, rod, out)
    return status, still.max()


EstimatorKind = Literal["static", "dynamic"]
FORCE_BANDWIDTH_HZ = 0.7  # Hz, of the force estimate
MOTION_BANDWIDTH_HZ = 2.5  # Hz, of the filter of positions and pressures
_SETTLING_PERIODS = 0.5  # periods of the fast filter over which the first readings are averaged
_TASK_COORDINATES = ("r", "theta", "z", "attitude", "head")


class EndpointForce:
    """Online estimator of the force of the environment on the tip of an arm.

    Attributes:
        axes: axes of the readings.
        task: task coordinates of the force: r [N], theta [N m], z [N], attitude, head [N m].
        bandwidth: bandwidth of the estimate [Hz].
        delay: delay of the estimate for slow changes [s].
        force: (m,) last estimate; 0 until every channel has a reading.
        is_healthy: whether the last readings were finite and the arm was not singular.
    """

    def __init__(
        self, machine: Machine, axes: Sequence[str], kind: EstimatorKind = "dynamic",
        period: float = 0.005, *, every: int = 1, sensors: SensorSet | None = None,
        gravity: GravityModel | None = None, bandwidth: float = FORCE_BANDWIDTH_HZ,
        motion_bandwidth: float = MOTION_BANDWIDTH_HZ,
    ):  # fmt: skip
        """Prepare the model and the filters.

        Args:
            machine: machine with an arm whose joints are driven by valves.
            axes: order of the readings, as in `Feedback.joint`.
            kind: `static` models gravity only, `dynamic` uses the complete model.
            period: time between two updates [s].
            every: updates per sample of the sensors, as in `Feedback.ticks_per_sample`. The first update uses
                a new sample, the following ones have no effect.
            sensors: sensor set of the machine; its noise affects friction in the dynamic estimate.
                None for ideal sensors.
            gravity: parameters of the static model; None to compute them from the machine's masses.
            bandwidth: bandwidth of the estimate [Hz].
            motion_bandwidth: bandwidth of the motion from which friction and inertia are computed [Hz].

        Raises:
            InputError: a joint is not driven by a valve or not measured, or a value is invalid.
        """
        where = f"end-point force of {machine.name}"
        if kind not in ("static", "dynamic"):
            raise InputError(where, f"kind must be static or dynamic, got {kind!r}")
        if not (period > 0.0 and every >= 1 and 0.0 < bandwidth < 0.25 / (period * every)):
            rate = 1.0 / (period * every) if period > 0.0 and every >= 1 else float("nan")
            raise InputError(
                where,
                f"the bandwidth, {bandwidth:g} Hz, must be below a quarter of the sensor rate, {rate:g} Hz",
            )
        self.axes, self.bandwidth, self.is_healthy = tuple(axes), bandwidth, False
        self._dynamic, self._count, self._every, self._tick = kind == "dynamic", 0, every, 0
        self._arm = create_arm_balance(machine, where)
        if not self._dynamic:
            found = gravity or fit_gravity_to_masses(machine)
            if len(found.value) != len(self._arm.gravity):
                raise InputError(where, f"gravity needs {len(self._arm.gravity)} parameters")
            self._arm.gravity[:] = found.value
        self._readings = _create_reading_filters(machine, self.axes, period * every, bandwidth, motion_bandwidth, where)
        noise = filter_noise_gains(self._readings.tables[0])[1]
        for i, name in enumerate(independent_axes(machine, where)):
            channel = f"{machine.position_kind(name)}.{name}"
            self._arm.rate_noise[i] = noise * reading_noise_rms(machine, sensors, channel)
        self.delay = filter_delay(motion_bandwidth) + filter_delay(bandwidth)
        self.task = _TASK_COORDINATES[: len(self._arm.joint)]
        self.force, self._max_constant_readings = np.zeros(len(self.task)), 0
        self._records = arm_record(self._arm), _readings_record(self._readings)

    def update(self, joint: np.ndarray, head: np.ndarray, rod: np.ndarray) -> np.ndarray:
        """Update the estimate of the force at the tip with the sensor readings of one instant.

        A reading that is not finite is replaced by the last valid one of its channel, and `is_healthy`
        is then False.

        Args:
            joint: (k,) measured joint positions [rad] or [m], in the order of `axes`.
            head: (k,) head-side pressures [Pa]; ignored for axes without valve.
            rod: (k,) rod-side pressures [Pa]; ignored for axes without valve.

        Returns:
            (m,) force of the environment on the machine along `task`; always the same array.
        """
        held, self._tick = self._tick % self._every, self._tick + 1
        if held:
            return self.force
        status, self._max_constant_readings = _update_force_from_records(
            *self._records, self._dynamic, self._count, joint, head, rod, self.force
        )
        self._count += status != STATUS_WAITING
        self.is_healthy = status == STATUS_GOOD
        return self.force

    def find_constant_channels(self, duration: float = 0.5) -> tuple[str, ...]:
        """Return the channels whose readings have not changed, as with a stuck sensor.

        Args:
            duration: time without change [s]. Readings of real sensors do not stay constant for
                long; those of ideal sensors of a machine at rest do.

        Returns:
            Names such as `joint.boom`, `pressure_head.boom`.
        """
        r, calls = self._readings, duration / self._readings.period
        if self._max_constant_readings < calls:  # the usual case; unused channels are never counted
            return ()
        kinds = (("joint", r.position), ("pressure_head", r.valve), ("pressure_rod", r.valve))
        return tuple(
            f"{kind}.{self.axes[i]}"
            for row, (kind, used) in enumerate(kinds)
            for i in sorted(used)
            if r.still[row, i] >= calls
        )


def _create_reading_filters(
    machine: Machine,
    axes: tuple[str, ...],
    period: float,
    bandwidth: float,
    motion_bandwidth: float,
    context: str,
) -> DriveReadings:
    """Create the filters of the force estimator, and find the columns of the readings that it uses.

    Args:
        machine: the machine.
        axes: order of the readings.
        period: time between two readings [s].
        bandwidth: of the force filter [Hz].
        motion_bandwidth: of the filter of positions and pressures [Hz].
        context: name of the caller, for messages.

    Returns:
        The filters in their initial state, without readings.
    """
    free, valves = (
        independent_axes(machine, context),
        actuator_order(machine)[: len(machine.hydraulic_axes)],
    )
    if missing := [name for name in free if name not in axes]:
        raise InputError(context, f"readings of {', '.join(missing)} are missing")
    n, h, k = len(free), len(valves), len(axes)
    return DriveReadings(
        period=period,
        settle=max(1, round(_SETTLING_PERIODS / (motion_bandwidth * period))),
        tables=np.array([filter_step_matrix(motion_bandwidth, period), filter_step_matrix(bandwidth, period)]),
        position=np.array([axes.index(name) for name in free]),
        valve=np.array([axes.index(name) for name in valves]),
        state=np.zeros((n + 2 * h + len(arm_joints(machine)), 4)),
        outside=np.zeros(n),
        last=np.full((3, k), np.nan),
        still=np.zeros((3, k), int),
    )


def endpoint_force_of_log(
    machine: Machine, log: Log, kind: EstimatorKind = "dynamic", gravity: GravityModel | None = None,
    bandwidth: float = FORCE_BANDWIDTH_HZ, motion_bandwidth: float = MOTION_BANDWIDTH_HZ,
    sensors: SensorSet | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Estimate the force at the arm's tip over a log by the online estimator, one update per row.

    Args:
        machine: the machine.
        log: positions and pressures of all its axes, measured.
        kind: `static` models gravity only, `dynamic` uses the complete model.
        gravity: parameters of the static model; None to compute them from the machine's masses.
        bandwidth: of the force estimate [Hz].
        motion_bandwidth: of the filter of positions and pressures [Hz].
        sensors: sensor set, whose noise affects friction in the dynamic estimate; None for ideal ones.

    Returns:
        Force along the task coordinates `r` [N], `theta` [N m], `z` [N] and, as the arm has them,
        `attitude` and `head` [N m]; and `healthy`, 1 where the estimate is valid [1]; (n,) each.

    Raises:
        InputError: a channel is missing, or the tip force of the arm cannot be estimated.
    """
    axes = tuple(machine.axes)
    joint = np.column_stack([log[f"{machine.position_kind(a)}.{a}"] for a in axes])
    head, rod = np.zeros_like(joint), np.zeros_like(joint)
    for i, name in enumerate(axes):
        if name in machine.hydraulic_axes:
            head[:, i], rod[:, i] = log[f"pressure_head.{name}"], log[f"pressure_rod.{name}"]
    felt = EndpointForce(
        machine,
        axes,
        kind,
        1.0 / log.rate,
        sensors=sensors,
        gravity=gravity,
        bandwidth=bandwidth,
        motion_bandwidth=motion_bandwidth,
    )
    out, healthy = np.empty((len(log), len(felt.task))), np.empty(len(log))
    for row in range(len(log)):
        out[row] = felt.update(joint[row], head[row], rod[row])
        healthy[row] = felt.is_healthy
    return {**dict(zip(felt.task, out.T, strict=True)), "healthy": healthy}
