"""Estimation of the force at the tip of an arm from the pressures of its drives.

The static estimate subtracts the gravity torque, which is linear in a few identified parameters,
from the drive torque (Zhu 1994, 6.1). The dynamic estimate uses the complete model with inertia,
Coriolis forces, friction and the closed chains of the cylinders.

A fast filter gives positions, rates, accelerations and pressures with equal delay, so that their
balance holds and friction corresponds to the rate of the same time. The resulting force passes a
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
    CHANGE,
    LAST,
    LOW,
    RATE,
    filter_delay,
    filter_step,
    filter_table,
    filtered,
    noise_gains,
)
from hydrotele.control.task_impedance import RecursiveLeastSquares
from hydrotele.control.tip_balance import (
    arm_joints,
    arm_of,
    arm_record,
    arm_tables,
    dynamic_balance,
    free_axes,
    gravity_size,
    static_balance,
    static_torque,
    tip_force,
)
from hydrotele.core.compiled import allocation_free, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, SensorSet, noise_rms

_NAMES = ("C2", "S2", "C23", "S23", "C234", "S234", "C5")
_GRID = 9  # poses per joint at which the static model is fitted to the masses
_SPREAD = 3.0e5  # N m, initial standard deviation of the gravity parameters: no prior knowledge
_RUBBING = 3.0e4  # N, initial standard deviation of dry friction
PERIOD = 0.2
"""Time between the equations of an identification [s]."""
_SMOOTH = 1.0  # Hz, bandwidth of the filter of slow motion
_CREEP = 5.0e-3  # m/s or rad/s: slower drives may be at rest and give no friction equation
_START = 50  # equations before the parameters are a valid estimate (Zhu 1994, 6.1.3)
_NORMAL = 1.96


@dataclass(frozen=True)
class Gravity:
    """Parameters of the static gravity model.

    Attributes:
        names: (p,) trigonometric factors of the parameters: C2, S2, C23, S23, C234, S234, C5.
        value: (p,) parameters [N m].
        interval: (p,) half width of the 95 % intervals [N m]; 0 if computed from masses.
        history: (r, p) parameters after every equation [N m]; empty if computed from masses.
        residual: (m - 1,) RMS of the residual torques, from the boom outwards [N m].
        removed: (q,) indices of equations removed as outliers, sorted.
    """

    names: tuple[str, ...]
    value: np.ndarray
    interval: np.ndarray
    history: np.ndarray
    residual: np.ndarray
    removed: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def gravity_rows(q: np.ndarray) -> np.ndarray:
    """Return the regressor Y of the static model `tau = Y(q) P`.

    Args:
        q: (m,) joint angles of the arm, swing first [rad].

    Returns:
        (m, p) regressor [1].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    joint, size = np.arange(len(q)), gravity_size(len(q))
    units = np.eye(size)
    return np.array(
        [[static_torque(q, joint, units[p], i) for p in range(size)] for i in range(len(q))]
    )


def gravity_from_masses(machine: Machine) -> Gravity:
    """Fit the static model to the gravity torques of a machine's masses.

    The complete model at rest is fitted over the ranges of the joints. The weight of the links has
    the form of the static model; that of cylinders and linkages has not and causes `residual`.

    Args:
        machine: machine with an arm whose joints are driven by valves.

    Returns:
        The parameters.

    Raises:
        InputError: the arm's joints are not all driven.
    """
    arm = arm_tables(machine, f"gravity of {machine.name}")
    joints = arm_joints(machine)
    ranges = [machine.joints[j].range or (-math.pi, math.pi) for j in joints[1:]]
    grid = np.meshgrid(*(np.linspace(low, high, _GRID) for low, high in ranges), indexing="ij")
    poses = np.column_stack([np.zeros(grid[0].size), *(axis.ravel() for axis in grid)])
    torque = np.zeros((len(poses), len(joints)))
    _weights(arm, poses, torque)
    rows = np.array([gravity_rows(q)[1:] for q in poses])
    value = np.linalg.lstsq(rows.reshape(-1, rows.shape[2]), torque[:, 1:].ravel(), rcond=None)[0]
    left = torque[:, 1:] - rows @ value
    size = len(value)
    return Gravity(
        _NAMES[:size], value, np.zeros(size), np.zeros((0, size)), np.sqrt(np.mean(left**2, axis=0))
    )


@compiled
def _weights(arm, poses, torque):
    """Compute the gravity torques (r, m) on the arm's joints in poses (r, m)."""
    outside = np.zeros(len(arm.work))
    for row in range(len(poses)):
        for i in range(len(arm.joint)):
            arm.z[arm.joint[i]] = poses[row, i]
        dynamic_balance(arm, outside)
        for i in range(len(arm.joint)):
            torque[row, i] = outside[arm.joint[i]]


class SlowMoves(NamedTuple):
    """Filtered signals of slow motion of an arm with m joints, r rows.

    Attributes:
        angle: (r, m) joint angles [rad].
        torque: (r, m) torques of the drives [N m].
        rubbing: (r, m) torque per newton of dry friction of the drive [m]; 0 if it may be at rest.
    """

    angle: np.ndarray
    torque: np.ndarray
    rubbing: np.ndarray


def slow_moves(machine: Machine, log: Log, period: float = PERIOD) -> SlowMoves:
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
    free_axes(machine, f"torques of {machine.name}")
    driver = {axis.joint: name for name, axis in machine.axes.items()}
    table, every = filter_table(_SMOOTH, 1.0 / log.rate), max(1, round(period * log.rate))
    columns = []
    for name in (driver[joint] for joint in arm_joints(machine)):
        head, rod = machine.axes[name].hydraulic_drive.areas
        force = head * log[f"pressure_head.{name}"] - rod * log[f"pressure_rod.{name}"]
        moved, pushed = (filtered(table, x)[::every] for x in (log[f"angle.{name}"], force))
        lever = axis_linkage(machine, name).rate(moved[:, LOW])
        speed = np.abs(lever * moved[:, RATE])
        way = np.where(speed > _CREEP, np.sign(moved[:, RATE]), 0.0)
        columns.append((moved[:, LOW], lever * pushed[:, LOW], np.abs(lever) * way))
    return SlowMoves(*(np.column_stack(part) for part in zip(*columns, strict=True)))


def identify_gravity(
    machine: Machine, log: Log, friction: bool = True, *, remove_outliers: bool = False,
    period: float = PERIOD,
) -> Gravity:  # fmt: skip
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
    moves = slow_moves(machine, log, period)
    size, joints = gravity_size(moves.angle.shape[1]), moves.angle.shape[1]
    rows = np.array([gravity_rows(q)[1:] for q in moves.angle])
    if friction:
        rubbing = moves.rubbing[:, 1:, None] * np.eye(joints - 1)
        rows = np.concatenate([rows, rubbing], axis=2)
    torque, kept = moves.torque[:, 1:], np.ones(len(rows), bool)
    while True:
        if np.count_nonzero(kept) < _START:
            raise InputError(
                log.source, f"at least {_START * period:g} s of slow motion are needed"
            )
        found, history = _solve_recursively(rows[kept], torque[kept], size)
        left = torque - rows @ found.value
        outside = kept & _are_outliers(left, kept)
        if not remove_outliers or not outside.any():
            break
        kept &= ~outside
    left = left[kept]
    usual = math.sqrt(float(np.sum(left**2)) / (left.size - rows.shape[2]))
    return Gravity(
        _NAMES[:size],
        found.value[:size],
        _NORMAL * usual * np.sqrt(np.diag(found.covariance)[:size]),
        np.array(history),
        np.sqrt(np.mean(left**2, axis=0)),
        np.flatnonzero(~kept),
    )


def _solve_recursively(
    rows: np.ndarray, torque: np.ndarray, size: int
) -> tuple[RecursiveLeastSquares, list[np.ndarray]]:
    """Process equations (r, m - 1, p); return the estimate and the parameter history."""
    spread = np.append(np.full(size, _SPREAD), np.full(rows.shape[2] - size, _RUBBING))
    found, history = RecursiveLeastSquares(np.zeros(rows.shape[2]), spread), []
    for table, torques in zip(rows, torque, strict=True):
        for row, one in zip(table, torques, strict=True):
            found.update(row, one)
        history.append(found.value[:size])
    return found, history


def _are_outliers(left: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return for each equation (r,) whether its residuals (r, m - 1) fail Chauvenet's criterion."""
    from scipy.special import ndtri  # imported here, because runs do not need it

    scale = np.median(np.abs(left[kept]), axis=0) / ndtri(0.75)
    most = -ndtri(0.25 / np.count_nonzero(kept))
    return np.asarray((np.abs(left) > most * scale).any(axis=1))


WAITING, GOOD, BAD, SINGULAR = range(4)
_JOINT, _HEAD, _ROD = range(3)  # rows of `DriveReadings.last`


class DriveReadings(NamedTuple):
    """State of the reading filters: n independent coordinates, h valves, k axes.

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


@allocation_free
def endpoint_force_step(arm, readings, dynamic, count, joint, head, rod, out):
    """Process new readings and update the force at the tip.

    Args:
        arm: ArmBalance.
        readings: DriveReadings.
        dynamic: whether the complete model is used, or gravity only; scalar.
        count: number of previous readings; scalar. The first ones are averaged, assuming a machine
            at rest.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m].

    Returns:
        WAITING until every channel has a reading, GOOD, BAD if a reading was not finite and was
        replaced by the last one, SINGULAR if the arm is singular and `out` is unchanged.

    Source: Zhu 1994, 6.1.
    """
    r, n = readings, len(readings.position)
    good = _take(r.last[_JOINT], r.still[_JOINT], r.position, joint)
    good = _take(r.last[_HEAD], r.still[_HEAD], r.valve, head) and good
    good = _take(r.last[_ROD], r.still[_ROD], r.valve, rod) and good
    if not _known(r):
        return WAITING
    places = n + 2 * len(r.valve)
    for c in range(places):
        place, value = _reading(r, c)
        if count < r.settle:
            before = r.state[c, LOW] if count > 0 else value
            _stand(r.state[c], before + (value - before) / (count + 1))
        else:
            filter_step(r.tables[0], r.state[c], value)
        arm.z[place] = r.state[c, LOW]
        if c < n:
            arm.z[n + c] = r.state[c, RATE]
            arm.acceleration[c] = r.state[c, CHANGE]
    if dynamic:
        dynamic_balance(arm, r.outside)
    else:
        static_balance(arm, r.outside)
    if not tip_force(arm, r.outside, out):
        return SINGULAR
    for i in range(len(out)):
        if count < r.settle:
            _stand(r.state[places + i], out[i])
        else:
            filter_step(r.tables[1], r.state[places + i], out[i])
        out[i] = r.state[places + i, LOW]
    return GOOD if good else BAD


@allocation_free
def _stand(state, value):
    """Set a filter to a constant value."""
    state[LOW], state[RATE], state[CHANGE], state[LAST] = value, 0.0, 0.0, value


@allocation_free
def _reading(r, c):
    """Return the index in the arm's state and the last valid value of signal c.

    Positions come first, then pressures.
    """
    n = len(r.position)
    if c < n:
        return c, r.last[_JOINT, r.position[c]]
    i, side = (c - n) // 2, (c - n) % 2
    return 2 * n + 4 * i + 2 + side, r.last[_HEAD + side, r.valve[i]]


@allocation_free
def _take(last, still, used, values):
    """Store finite readings; return False if a used reading is not finite."""
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


@allocation_free
def _known(readings):
    """Return whether all used channels have a reading."""
    for i in readings.position:
        if math.isnan(readings.last[_JOINT, i]):
            return False
    for i in readings.valve:
        if math.isnan(readings.last[_HEAD, i]) or math.isnan(readings.last[_ROD, i]):
            return False
    return True


_READINGS = np.dtype(
    [("period", np.float64)]
    + [(name, np.int64) for name in ("settle", "free", "valves", "signals", "axes")]
    + [(name, np.int64) for name in ("tables", "position", "valve")]  # addresses from here on
    + [(name, np.int64) for name in ("state", "outside", "last", "still")],
    align=True,
)


def _readings_record(r: DriveReadings) -> np.ndarray:
    """Return a record (1,) of DriveReadings; their arrays must outlive it."""
    arrays = {name: part for name, part in r._asdict().items() if isinstance(part, np.ndarray)}
    record = address_record(_READINGS, arrays)
    (record["signals"], _), (_, record["axes"]) = r.state.shape, r.last.shape
    record["free"], record["valves"] = len(r.position), len(r.valve)
    record["period"], record["settle"] = r.period, r.settle
    return record


@compiled
def _update(arm, kept, dynamic, count, joint, head, rod, out):
    """Call `endpoint_force_step` with records.

    Returns:
        Its status, and the largest number of readings since a channel changed.
    """
    r = kept[0]
    still = integers(r.still, 3 * r.axes).reshape((3, r.axes))
    readings = DriveReadings(
        r.period, r.settle, floats(r.tables, 30).reshape((2, 3, 5)), integers(r.position, r.free),
        integers(r.valve, r.valves), rows_of(r.state, r.signals, 4), floats(r.outside, r.free),
        rows_of(r.last, 3, r.axes), still,
    )  # fmt: skip
    status = endpoint_force_step(arm_of(arm[0]), readings, dynamic, count, joint, head, rod, out)
    return status, still.max()


Kind = Literal["static", "dynamic"]
BANDWIDTH = 0.7  # Hz, of the force estimate
FAST = 2.5  # Hz, of the filter of positions and pressures
_SETTLE = 0.5  # periods of the fast filter over which the first readings are averaged
_TASK = ("r", "theta", "z", "attitude", "head")


class EndpointForce:
    """Online estimator of the force of the environment on the tip of an arm.

    Attributes:
        axes: axes of the readings.
        task: task coordinates of the force: r [N], theta [N m], z [N], attitude, head [N m].
        bandwidth: bandwidth of the estimate [Hz].
        delay: delay of the estimate for slow changes [s].
        force: (m,) last estimate; 0 until every channel has a reading.
        healthy: whether the last readings were finite and the arm was not singular.
    """

    def __init__(
        self, machine: Machine, axes: Sequence[str], kind: Kind = "dynamic",
        period: float = 0.005, *, every: int = 1, sensors: SensorSet | None = None,
        gravity: Gravity | None = None, bandwidth: float = BANDWIDTH, fast: float = FAST,
    ):  # fmt: skip
        """Prepare the model and the filters.

        Args:
            machine: machine with an arm whose joints are driven by valves.
            axes: order of the readings, as in `Feedback.joint`.
            kind: `static` models gravity only, `dynamic` uses the complete model.
            period: time between two updates [s].
            every: updates per sample of the sensors, as in `Feedback.every`. The first update uses
                a new sample, the following ones have no effect.
            sensors: sensor set of the machine; its noise affects friction in the dynamic estimate.
                None for ideal sensors.
            gravity: parameters of the static model; None to compute them from the machine's masses.
            bandwidth: bandwidth of the estimate [Hz].
            fast: bandwidth of the motion from which friction and inertia are computed [Hz].

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
                f"the bandwidth, {bandwidth:g} Hz, must be below a quarter of the sensor"
                f" rate, {rate:g} Hz",
            )
        self.axes, self.bandwidth, self.healthy = tuple(axes), bandwidth, False
        self._dynamic, self._count, self._every, self._tick = kind == "dynamic", 0, every, 0
        self._arm = arm_tables(machine, where)
        if not self._dynamic:
            found = gravity or gravity_from_masses(machine)
            if len(found.value) != len(self._arm.gravity):
                raise InputError(where, f"gravity needs {len(self._arm.gravity)} parameters")
            self._arm.gravity[:] = found.value
        self._readings = _readings(machine, self.axes, period * every, bandwidth, fast, where)
        noise = noise_gains(self._readings.tables[0])[1]
        for i, name in enumerate(free_axes(machine, where)):
            channel = f"{machine.position_kind(name)}.{name}"
            self._arm.rate_noise[i] = noise * noise_rms(machine, sensors, channel)
        self.delay = filter_delay(fast) + filter_delay(bandwidth)
        self.task = _TASK[: len(self._arm.joint)]
        self.force, self._stillest = np.zeros(len(self.task)), 0
        self._records = arm_record(self._arm), _readings_record(self._readings)

    def update(self, joint: np.ndarray, head: np.ndarray, rod: np.ndarray) -> np.ndarray:
        """Process the readings of one instant.

        A reading that is not finite is replaced by the last valid one of its channel, and `healthy`
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
        status, self._stillest = _update(
            *self._records, self._dynamic, self._count, joint, head, rod, self.force
        )
        self._count += status != WAITING
        self.healthy = status == GOOD
        return self.force

    def frozen(self, duration: float = 0.5) -> tuple[str, ...]:
        """Return the channels whose readings have not changed, as with a stuck sensor.

        Args:
            duration: time without change [s]. Readings of real sensors do not stay constant for
                long; those of ideal sensors of a machine at rest do.

        Returns:
            Names such as `joint.boom`, `pressure_head.boom`.
        """
        r, calls = self._readings, duration / self._readings.period
        if self._stillest < calls:  # the usual case; unused channels are never counted
            return ()
        kinds = (("joint", r.position), ("pressure_head", r.valve), ("pressure_rod", r.valve))
        return tuple(
            f"{kind}.{self.axes[i]}"
            for row, (kind, used) in enumerate(kinds)
            for i in sorted(used)
            if r.still[row, i] >= calls
        )


def _readings(
    machine: Machine,
    axes: tuple[str, ...],
    period: float,
    bandwidth: float,
    fast: float,
    where: str,
) -> DriveReadings:
    """Create the reading filters and the columns of the used readings."""
    free, valves = free_axes(machine, where), actuator_order(machine)[: len(machine.hydraulic_axes)]
    if missing := [name for name in free if name not in axes]:
        raise InputError(where, f"readings of {', '.join(missing)} are missing")
    n, h, k = len(free), len(valves), len(axes)
    return DriveReadings(
        period=period,
        settle=max(1, round(_SETTLE / (fast * period))),
        tables=np.array([filter_table(fast, period), filter_table(bandwidth, period)]),
        position=np.array([axes.index(name) for name in free]),
        valve=np.array([axes.index(name) for name in valves]),
        state=np.zeros((n + 2 * h + len(arm_joints(machine)), 4)),
        outside=np.zeros(n),
        last=np.full((3, k), np.nan),
        still=np.zeros((3, k), int),
    )


def endpoint_force_of_log(
    machine: Machine, log: Log, kind: Kind = "dynamic", gravity: Gravity | None = None,
    bandwidth: float = BANDWIDTH, fast: float = FAST, sensors: SensorSet | None = None,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Run the online estimator over a log, one update per row.

    Args:
        machine: the machine.
        log: positions and pressures of all its axes, measured.
        kind: see `EndpointForce`.
        gravity: see `EndpointForce`.
        bandwidth: see `EndpointForce`.
        fast: see `EndpointForce`.
        sensors: see `EndpointForce`.

    Returns:
        `r` [N], `theta` [N m], `z` [N], `attitude` [N m] ... and `healthy` [1], (n,) each.

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
        fast=fast,
    )
    out, healthy = np.empty((len(log), len(felt.task))), np.empty(len(log))
    for row in range(len(log)):
        out[row] = felt.update(joint[row], head[row], rod[row])
        healthy[row] = felt.healthy
    return {**dict(zip(felt.task, out.T, strict=True)), "healthy": healthy}
