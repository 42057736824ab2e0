"""Force at the tip of an arm, felt through the pressures of its drives.

The static estimate takes the torque of gravity, linear in a few identified parameters, off that of
the drives (Zhu 1994, 6.1). The dynamic one takes off all that the complete model needs: inertia,
Coriolis forces, friction, and the closed chains with their cylinders.

Everything passes two filters. A fast one gives positions, rates, accelerations and pressures that
are equally late, so that their balance holds, and friction is that of the rate of its time. The
force that is left passes a slow one, since what noise of the angles makes of accelerations grows
with the fifth power of the frequency.

One step of the force at the tip: readings, two filters, a balance between them.

Static model of an arm: the torque of its weight, linear in a few parameters.
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
_GRID = 9  # poses per joint to which the masses' torques are fitted
_SPREAD = 3.0e5  # N m: nothing is known of the parameters before
_RUBBING = 3.0e4  # N: nor of friction
PERIOD = 0.2
"""Time between the equations of an identification [s]."""
_SMOOTH = 1.0  # Hz
_CREEP = 5.0e-3  # m/s or rad/s: slower drives may stand, and are asked nothing about friction
_START = 50  # equations whose parameters are no estimate yet (Zhu 1994, 6.1.3)
_NORMAL = 1.96


@dataclass(frozen=True)
class Gravity:
    """Parameters of the static model.

    Attributes:
        names: (p,) what every parameter multiplies: C2, S2, C23, S23, C234, S234, C5.
        value: (p,) parameters [N m].
        interval: (p,) half the width of their 95 % interval [N m]; 0 where they were computed.
        history: (r, p) parameters after every equation [N m]; empty where they were computed.
        residual: (m - 1,) RMS of the torques that are left, from the boom outwards [N m].
        removed: (q,) indices of the equations that were left out as outliers, sorted.
    """

    names: tuple[str, ...]
    value: np.ndarray
    interval: np.ndarray
    history: np.ndarray
    residual: np.ndarray
    removed: np.ndarray = field(default_factory=lambda: np.zeros(0, int))


def gravity_rows(q: np.ndarray) -> np.ndarray:
    """Rows Y of the static model `tau = Y(q) P`.

    Args:
        q: (m,) joint angles of the arm, swing first [rad].

    Returns:
        (m, p) [1].

    Source: Zhu 1994, 6.8 and 6.9.
    """
    joint, size = np.arange(len(q)), gravity_size(len(q))
    units = np.eye(size)
    return np.array(
        [[static_torque(q, joint, units[p], i) for p in range(size)] for i in range(len(q))]
    )


def gravity_from_masses(machine: Machine) -> Gravity:
    """The static model that comes nearest to the torques of all a machine's masses.

    Fitted to the complete model at rest over the joints' ranges. The links' own weight is of the
    form of the model; that of cylinders and linkages is not, which leaves `residual`.

    Args:
        machine: with an arm whose joints are driven by valves.

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
    """Torques (r, m) of gravity on the arm's joints in poses (r, m)."""
    outside = np.zeros(len(arm.work))
    for row in range(len(poses)):
        for i in range(len(arm.joint)):
            arm.z[arm.joint[i]] = poses[row, i]
        dynamic_balance(arm, outside)
        for i in range(len(arm.joint)):
            torque[row, i] = outside[arm.joint[i]]


class SlowMoves(NamedTuple):
    """What slow moves tell of an arm with m joints, r rows; all passed the same filter.

    Attributes:
        angle: (r, m) [rad].
        torque: (r, m) of the drives [N m].
        rubbing: (r, m) torque of a newton of dry friction of the drive; 0 where it may stand [m].
    """

    angle: np.ndarray
    torque: np.ndarray
    rubbing: np.ndarray


def slow_moves(machine: Machine, log: Log, period: float = PERIOD) -> SlowMoves:
    """Angles and torques of an arm's drives in a log, by virtual work through their linkages.

    Args:
        machine: the machine.
        log: measured angles and pressures.
        period: between rows [s], rounded to a multiple of the log's.

    Returns:
        One row for every period between equations.

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
    """Static model of a machine from a log of slow moves, by recursive least squares.

    With `remove_outliers` equations with a large residual, such as those of a sensor that failed
    for a moment, are left out and the estimation is repeated until none is left. Large is, by
    Chauvenet's criterion, a residual of which less than half a one is expected among all equations;
    its normal distribution has the scale of the median absolute residual of the joint.

    Args:
        machine: the machine; its masses are not used.
        log: measured angles and pressures of joints that move slowly to and fro over their ranges.
        friction: whether a dry friction of every drive is estimated along with it, or left in the
            torques as by Zhu, to average out.
        remove_outliers: whether equations with large residuals are left out.
        period: between equations [s].

    Returns:
        The parameters with their history.

    Raises:
        InputError: a channel is missing, or the log is too short or has too few equations that are
            no outliers.

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
            raise InputError(log.source, f"{_START * period:g} s of slow moves are needed at least")
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
    """Take in equations (r, m - 1, p); the estimate, and the first parameters after every one."""
    spread = np.append(np.full(size, _SPREAD), np.full(rows.shape[2] - size, _RUBBING))
    found, history = RecursiveLeastSquares(np.zeros(rows.shape[2]), spread), []
    for table, torques in zip(rows, torque, strict=True):
        for row, one in zip(table, torques, strict=True):
            found.update(row, one)
        history.append(found.value[:size])
    return found, history


def _are_outliers(left: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Whether residuals (r, m - 1) of an equation are too large for their number, (r,)."""
    from scipy.special import ndtri  # a run does without it

    scale = np.median(np.abs(left[kept]), axis=0) / ndtri(0.75)
    most = -ndtri(0.25 / np.count_nonzero(kept))
    return np.asarray((np.abs(left) > most * scale).any(axis=1))


WAITING, GOOD, BAD, SINGULAR = range(4)
_JOINT, _HEAD, _ROD = range(3)  # rows of `DriveReadings.last`


class DriveReadings(NamedTuple):
    """What is kept of the readings; n independent coordinates, h valves, k axes.

    Attributes:
        period: between two readings of the sensors [s].
        settle: number of readings that are averaged at first.
        tables: (2, 3, 5) of the readings' filter and of the force's.
        position: (n,) column of every coordinate's axis.
        valve: (h,) column of every valve's axis.
        state: (n + 2 h + m, 4) of the filters: positions, pressures, force at the tip.
        outside: (n,) forces on the coordinates from outside [N m] or [N].
        last: (3, k) last good readings of joint, head and rod; NaN before the first.
        still: (3, k) readings since one changed.
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
    """Take in new readings; force at the tip.

    Args:
        arm: Arm.
        readings: DriveReadings.
        dynamic: whether the complete model is used, or gravity alone; scalar.
        count: number of readings before; scalar. The first ones are averaged, as of a machine at
            rest.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: r [N], theta [N m], z [N], then attitude and head [N m].

    Returns:
        WAITING before every channel has read once, GOOD, BAD where a reading was not finite and the
        last one was taken, SINGULAR where the arm is singular and `out` is left alone.

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
    """Let a filter stand at a value."""
    state[LOW], state[RATE], state[CHANGE], state[LAST] = value, 0.0, 0.0, value


@allocation_free
def _reading(r, c):
    """Place in the arm's state and last good value of a signal: positions, then pressures."""
    n = len(r.position)
    if c < n:
        return c, r.last[_JOINT, r.position[c]]
    i, side = (c - n) // 2, (c - n) % 2
    return 2 * n + 4 * i + 2 + side, r.last[_HEAD + side, r.valve[i]]


@allocation_free
def _take(last, still, used, values):
    """Keep readings that are finite; False if one that is used is not."""
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
    """Whether all channels that are used have read once."""
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
    """(1,) record of DriveReadings whose arrays must outlive it."""
    arrays = {name: part for name, part in r._asdict().items() if isinstance(part, np.ndarray)}
    record = address_record(_READINGS, arrays)
    (record["signals"], _), (_, record["axes"]) = r.state.shape, r.last.shape
    record["free"], record["valves"] = len(r.position), len(r.valve)
    record["period"], record["settle"] = r.period, r.settle
    return record


@compiled
def _update(arm, kept, dynamic, count, joint, head, rod, out):
    """`endpoint_force_step` of records; its status, and most readings since a channel changed."""
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
BANDWIDTH = 0.7  # Hz
FAST = 2.5  # Hz
_SETTLE = 0.5  # periods of the fast filter
_TASK = ("r", "theta", "z", "attitude", "head")


class EndpointForce:
    """Online estimate of the force of the environment on the tip of an arm.

    Attributes:
        axes: axes of the readings.
        task: what the force acts along: r [N], theta [N m], z [N], attitude, head [N m].
        bandwidth: of the estimate [Hz].
        delay: by which it is late, for slow changes [s].
        force: (m,) last estimate; 0 until every channel has read once.
        healthy: whether the last readings were finite and the arm was not singular.
    """

    def __init__(
        self, machine: Machine, axes: Sequence[str], kind: Kind = "dynamic",
        period: float = 0.005, *, every: int = 1, sensors: SensorSet | None = None,
        gravity: Gravity | None = None, bandwidth: float = BANDWIDTH, fast: float = FAST,
    ):  # fmt: skip
        """Lay out what every update needs.

        Args:
            machine: with an arm whose joints are driven by valves.
            axes: order of the readings, as `Feedback.joint`.
            kind: `static` knows gravity only, `dynamic` the complete model.
            period: time between two updates [s].
            every: updates per sample of the sensors, as `Feedback.every`: the first brings a new
                sample, the following ones hold it and change nothing.
            sensors: of the machine, whose noise the dynamic estimate weighs; None for ideal ones.
            gravity: parameters of the static model; those of the machine's masses if None.
            bandwidth: of the estimate [Hz].
            fast: bandwidth of the motion that friction and inertia are computed of [Hz].

        Raises:
            InputError: a joint is not driven, not by a valve, or not measured; a number makes no
                sense.
        """
        where = f"end-point force of {machine.name}"
        if kind not in ("static", "dynamic"):
            raise InputError(where, f"kind must be static or dynamic, got {kind!r}")
        if not (period > 0.0 and every >= 1 and 0.0 < bandwidth < 0.25 / (period * every)):
            rate = 1.0 / (period * every) if period > 0.0 and every >= 1 else float("nan")
            raise InputError(
                where, f"{bandwidth:g} Hz must be less than a quarter of the sensors' {rate:g} Hz"
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
        """Take in the readings of one moment.

        A reading that is not finite is replaced by the last good one of its channel, and `healthy`
        is then False.

        Args:
            joint: (k,) measured joint positions [rad] or [m], in the order of `axes`.
            head: (k,) head-side pressures [Pa]; ignored where there is no valve.
            rod: (k,) rod-side pressures [Pa].

        Returns:
            (m,) force of the environment on the machine along `task`; the same array every time.
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
        """Channels whose readings have not changed for a while, as a stuck sensor's.

        Args:
            duration: for how long [s]. Real sensors never read the same twice for long; ideal ones
                of a machine at rest do.

        Returns:
            Names such as `joint.boom`, `pressure_head.boom`.
        """
        r, calls = self._readings, duration / self._readings.period
        if self._stillest < calls:  # as nearly always: what is not read never counts
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
    """Where the readings are and what they go through."""
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
    """The online estimate over a log, one update per row.

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
        InputError: a channel is missing, or the arm cannot be felt.
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
