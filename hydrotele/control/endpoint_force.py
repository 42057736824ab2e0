"""Estimation of the force at the tip of an arm from the pressures of its drives.

The static estimate subtracts the gravity torque (`control.gravity_model`) from the drive torque (Zhu
1994, 6.1). The dynamic estimate uses the complete model with inertia, Coriolis forces, friction and
the closed chains of the cylinders.

A fast filter gives positions, rates, accelerations and pressures with equal delay, so that the
force balance between them holds and friction corresponds to the rate of the same time. The result passes a
slow filter, because the force error from angle noise grows with the fifth power of the frequency.

`EndpointForce` estimates online, `endpoint_force_of_log` from a log.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from hydrotele.control.gravity_model import GravityModel, fit_gravity_to_masses
from hydrotele.control.state_filter import (
    LAST_READING,
    RATE,
    SECOND_DERIVATIVE,
    VALUE,
    filter_delay,
    filter_noise_gains,
    filter_step,
    filter_step_matrix,
)
from hydrotele.control.tip_balance import (
    arm_joints,
    arm_record,
    compute_dynamic_external_forces,
    compute_static_external_forces,
    create_arm_balance,
    independent_axes,
    read_arm_record,
    solve_tip_force,
)
from hydrotele.core.compiled import compile_without_allocation, compiled
from hydrotele.core.errors import InputError
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.log import Log
from hydrotele.machine.machine import Machine, reading_noise_rms
from hydrotele.machine.sensors import SensorSet

STATUS_WAITING, STATUS_GOOD, STATUS_BAD, STATUS_SINGULAR = range(4)
_JOINT_ROW, _HEAD_ROW, _ROD_ROW = range(3)  # rows of `DriveReadings.last`


class DriveReadings(NamedTuple):
    """Filters and last valid readings of the force estimator: n coordinates, h valves, k axes, m task forces.

    Attributes:
        period: time between two readings of the sensors [s].
        settle: number of initial readings that are averaged instead of filtered.
        tables: (2, 3, 5) tables of the filter of positions and pressures, and of the filter of the
            force.
        position: (n,) index, in the readings, of the axis that drives each coordinate.
        valve: (h,) index, in the readings, of the axis of each valve.
        state: (n + 2 h + m, 4) filter states: positions, pressures, force at the tip.
        outside: (n,) external forces on the coordinates [N m] or [N].
        last: (3, k) last valid readings; rows joint position, head and rod pressure; NaN before the
            first.
        still: (3, k) number of readings since the last change of the reading, rows as for `last`.
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
        dynamic: whether the complete model is used; otherwise the static model of gravity only;
            scalar.
        count: number of previous readings; scalar. The first `settle` readings are averaged,
            assuming a machine at rest.
        joint: (k,) measured joint positions [rad] or [m].
        head: (k,) head-side pressures [Pa].
        rod: (k,) rod-side pressures [Pa].
        out: (m,) written: force at the tip along r [N], theta [N m], z [N], then attitude and head
            [N m].

    Returns:
        STATUS_WAITING until every channel has a reading, STATUS_GOOD, STATUS_BAD if a reading was
        not finite and was replaced by the last one, STATUS_SINGULAR if the arm is singular and
        `out` is unchanged.

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
    """Return the index of signal c in the arm's state vector `z`, and the last valid reading of its sensor.

    The signals are the positions of the n coordinates, then head and rod pressure of every valve.
    `r` is DriveReadings.
    """
    n = len(r.position)
    if c < n:
        return c, r.last[_JOINT_ROW, r.position[c]]
    i, side = (c - n) // 2, (c - n) % 2
    return 2 * n + 4 * i + 2 + side, r.last[_HEAD_ROW + side, r.valve[i]]


@compile_without_allocation
def _store_readings(last, still, used, values):
    """Store new readings if they are finite, and count for how many readings each channel has not changed.

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
        (status of `endpoint_force_step`, largest number of readings for which a channel has not
        changed).
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
            every: updates per sample of the sensors, as in `Feedback.ticks_per_sample`. Of each
                `every` updates the first uses a new sample, and the others have no effect.
            sensors: sensor set of the machine; its noise affects friction in the dynamic estimate.
                None for ideal sensors.
            gravity: parameters of the static model; None to compute them from the machine's masses.
            bandwidth: bandwidth of the estimate [Hz].
            motion_bandwidth: bandwidth of the motion from which friction and inertia are computed
                [Hz].

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
        """Return the names of the channels whose readings have not changed for a time, as with a stuck sensor.

        Args:
            duration: minimum time without change up to the last reading [s]. Noise changes the
                readings of real sensors; those of ideal sensors of a machine at rest stay constant.

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

    Examples:
        The bucket hangs free, so that the true force is zero. The estimate from the pressures and the complete
        model of the machine shows it. A payload of 500 kg appears as its weight.

        >>> import hydrotele as ht
        >>> machine = ht.load_machine("cat215", "bucket")
        >>> for payload in 0.0, 500.0:
        ...     overrides = {"duration": "3", "sensors": "ideal"}
        ...     if payload:
        ...         overrides["effects"] = f"[{{name: payload, location: tool, parameters: {{mass: {payload}}}}}]"
        ...     run = ht.run_scenario(ht.load_scenario("slow_moves", overrides))
        ...     force = ht.endpoint_force_of_log(machine, run.measured)
        ...     print(f"{payload} kg: {round(force['z'][-1] / 1e3)} kN")
        0.0 kg: 0 kN
        500.0 kg: -5 kN
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
