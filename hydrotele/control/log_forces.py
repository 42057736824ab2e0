"""External forces on the coordinates of an arm along a log, with their uncertainty.

`compute_external_forces` evaluates the force balance of `control.tip_balance` in every block of rows
of a run. The result contains the variance of each cause: pressure noise, noise of the motion, the
unknown friction of drives at rest, and the sensitivity to constant errors of the machine's parameters.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from hydrotele.control.tip_balance import (
    ArmBalance,
    compute_dynamic_external_forces,
    create_arm_balance,
    independent_axes,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.effects.mass import PAYLOAD
from hydrotele.estimate.hypothesis import Hypothesis, calibration, hypotheses
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT, Slot, actuator_order
from hydrotele.identify.optimal_smoother import smooth_and_differentiate
from hydrotele.identify.record import IdentificationRecord, correct_sensor_error
from hydrotele.kinematics.task_space import compute_tip_pose, task_jacobian
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Link, Machine
from hydrotele.machine.sensors import SensorError

BLOCK_SECONDS = 0.1  # [s] time between blocks; contact is detected with this resolution
FILTER_SECONDS = 0.3  # [s] window of the low-pass filter; shorter ones have larger noise of the acceleration
_MIN_FORCE_CHANGE = 1e-3  # of the noise: a parameter with a smaller effect per standard deviation is omitted
_TEST_MASS_KG = 100.0  # [kg] of the point masses by which the effect of a load is computed
_LOAD_EFFECT = "payload"  # effect of the library that is treated as a load that may change


@dataclass(frozen=True)
class ExternalForces:
    """External forces on n coordinates in b blocks of a run, and the causes of their errors.

    Attributes:
        time: (b,) mean time of each block [s].
        force: (b, n) external forces, by the model and the pressures [N m] or [N].
        covariance: (b, n, n) of errors that are independent between blocks: noise and friction at rest.
        parameter_effect: (b, n, p) change per standard deviation of each constant parameter error.
        load_effect: (b, n, l) change per kilogram of a point mass at l places of the tool.
        load_inertia: (b, n) part of it that is caused by rates and accelerations, mean of the places.
        moment_arm: (b, h, n) derivatives of the strokes of the h valves' drives by the coordinates.
        jacobian: (b, m, n) derivatives of the tip's pose (r, theta, z, attitude, head) by the coordinates.
        radius: (b,) distance of the tip from the swing axis [m].
    """

    time: np.ndarray
    force: np.ndarray
    covariance: np.ndarray
    parameter_effect: np.ndarray
    load_effect: np.ndarray
    load_inertia: np.ndarray
    moment_arm: np.ndarray
    jacobian: np.ndarray
    radius: np.ndarray


@compiled
def compute_balance_of_rows(arm, motion, pressure, rate_std, force, moment_arm):
    """Compute external forces and moment arms of the drives for every row of a motion.

    Args:
        arm: ArmBalance; its state is overwritten.
        motion: (3, rows, n) positions, rates and accelerations of the coordinates.
        pressure: (rows, h, 2) head and rod pressures of the valves [Pa].
        rate_std: (rows, n) standard deviations of the rates.
        force: (rows, n) written: external forces [N m] or [N].
        moment_arm: (rows, h, n) written: derivatives of the drives' strokes by the coordinates.

    Returns:
        Nothing.
    """
    n, h = force.shape[1], pressure.shape[1]
    for t in range(len(force)):
        for f in range(n):
            arm.z[f], arm.z[n + f] = motion[0, t, f], motion[1, t, f]
            arm.acceleration[f] = motion[2, t, f]
            arm.rate_noise[f] = rate_std[t, f]
        for i in range(h):
            arm.z[2 * n + 4 * i + 2], arm.z[2 * n + 4 * i + 3] = pressure[t, i, 0], pressure[t, i, 1]
        compute_dynamic_external_forces(arm, force[t])
        moment_arm[t] = arm.space.row[:h]


@dataclass(frozen=True)
class _Motion:
    """Motion and pressures of the rows of a run.

    Attributes:
        value: (3, rows, n) smoothed positions and rates, and low-pass filtered accelerations.
        std: (3, rows, n) their standard deviations.
        pressure: (rows, h, 2) head and rod pressures [Pa], NaN where unknown.
        pressure_std: (h, 2) noise of one reading [Pa].
        weights: (w,) weights of the low-pass filter of the accelerations; the sum is 1.
        centres: (b,) rows at the centres of the blocks, whose windows have complete readings.
    """

    value: np.ndarray
    std: np.ndarray
    pressure: np.ndarray
    pressure_std: np.ndarray
    weights: np.ndarray
    centres: np.ndarray

    def forces(self, arm: ArmBalance, change: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the external forces (b, n) in the blocks with a changed motion.

        All terms pass the low-pass filter of the accelerations, so that the balance holds at every frequency.
        """
        moved = self.value + change
        still = moved * np.array([1.0, 1.0, 0.0])[:, None, None]
        without = self.balance(arm, still)[0]
        inertia = self.balance(arm, moved[:, self.centres], self.centres)[0] - without[self.centres]
        return self.average(without) + inertia

    def balance(self, arm: ArmBalance, value: np.ndarray, rows: np.ndarray | slice = slice(None)):
        """Return external forces (rows, n) and moment arms (rows, h, n) of single rows."""
        count, n = value.shape[1:]
        force, moment_arm = np.zeros((count, n)), np.zeros((count, self.pressure.shape[1], n))
        parts = (np.ascontiguousarray(part) for part in (value, self.pressure[rows], self.std[1, rows]))
        compute_balance_of_rows(arm, *parts, force, moment_arm)
        return force, moment_arm

    def average(self, values: np.ndarray) -> np.ndarray:
        """Return the values (rows, ...) in the blocks (b, ...), averaged by the low-pass filter."""
        half = len(self.weights) // 2
        window = self.centres[:, None] + np.arange(-half, half + 1)
        return np.einsum("w,bw...->b...", self.weights, values[window])


def compute_external_forces(dataset: Dataset, run: RunData, record: IdentificationRecord) -> ExternalForces:
    """Compute the external forces on an arm along a run, with their uncertainty.

    Args:
        dataset: the dataset of the run.
        run: the run.
        record: its joint positions, see `identify.record.build_records`.

    Returns:
        The forces in blocks of 0.1 s; blocks without readings are left out.

    Raises:
        InputError: a pressure is not measured, or the machine's tip force cannot be estimated.
    """
    machine = dataset.machine
    where = f"contact of {machine.name}"
    arm, free = create_arm_balance(machine, where), independent_axes(machine, where)
    motion = _smooth_motion(dataset, run, record, free, where)
    force = motion.forces(arm)
    moment_arm = motion.balance(arm, motion.value)[1]

    def effect(changed: Machine, step: float) -> np.ndarray:
        return (motion.forces(create_arm_balance(changed, where)) - force) / step

    covariance = _noise_covariance(machine, motion, arm, moment_arm, force)
    size = np.sqrt(np.einsum("bii->bi", covariance))
    columns = [column for changed, step in _changed_machines(machine)
               if (np.abs(column := effect(changed, step)) > _MIN_FORCE_CHANGE * size).any()]  # fmt: skip
    loads = np.stack([effect(changed, -_TEST_MASS_KG) for changed in _loaded_machines(machine)], axis=2)
    pose = -motion.value * np.array([0.0, 1.0, 1.0])[:, None, None]  # removes all rates and accelerations
    at_rest = [motion.forces(create_arm_balance(changed, where), pose) for changed in _loaded_machines(machine)]
    static = np.mean(at_rest, axis=0) - motion.forces(arm, pose)
    jacobian, radius = _tip_jacobians(arm, motion.value[0, motion.centres], len(free))
    time = run.start + record.period * (record.first_row + motion.centres)
    return ExternalForces(
        time, force, covariance, np.stack(columns, axis=2), loads,
        loads.mean(axis=2) + static / _TEST_MASS_KG, motion.average(moment_arm), jacobian, radius,
    )  # fmt: skip


def _smooth_motion(dataset, run, record: IdentificationRecord, free: tuple[str, ...], where: str) -> _Motion:
    """Return the smoothed motion of the coordinates and the corrected pressures of a run.

    Accelerations are the second derivatives of parabolas fitted to a window. The weights with which they average the
    true acceleration have the coefficients of this filter as their second difference.
    """
    machine = dataset.machine
    places = [record.axes.index(name) for name in free]
    noise = record.position_noise[places]
    position = record.position[:, places]
    moved = smooth_and_differentiate(position, record.period, noise if np.isfinite(noise).all() else None)
    valves = actuator_order(machine)[: len(machine.hydraulic_axes)]
    rows = slice(record.first_row, record.first_row + len(position))
    pressure = np.full((len(position), len(valves), 2), np.nan)
    std = np.zeros((len(valves), 2))
    stated = dict(zip(dataset.channels, dataset.noise_of(run), strict=True))
    for i, axis in enumerate(valves):
        for side, name in enumerate(("head", "rod")):
            channel = f"pressure_{name}.{axis}"
            column = run.reading[rows, dataset.channels.index(channel)]
            error = machine.sensor_errors.get(channel, SensorError())
            pressure[:, i, side] = correct_sensor_error(column, error, run.period, run.start)
            std[i, side] = stated[channel] / error.scale
            if np.isnan(std[i, side]) and np.isfinite(column).sum() > 10:
                std[i, side] = smooth_and_differentiate(column, run.period).noise[0]
    half = max(2, round(0.5 * FILTER_SECONDS / record.period))
    if len(position) <= 2 * half:
        raise InputError(where, f"{run.name} is too short: it needs more than {2 * half} rows")
    second = np.asarray(savgol_coeffs(2 * half + 1, 2, deriv=2, delta=record.period, use="dot"))
    weights = np.append(0.0, np.cumsum(np.cumsum(second))[:-1]) * record.period**2  # its second difference is `second`
    rows_known = np.arange(len(position))
    filled = np.column_stack([np.interp(rows_known, rows_known[np.isfinite(c)], c[np.isfinite(c)]) for c in position.T])
    acceleration = np.asarray(savgol_filter(filled, 2 * half + 1, 2, deriv=2, delta=record.period, axis=0))
    value = np.stack([moved.value, moved.rate, acceleration])
    noise = np.broadcast_to(moved.noise * np.linalg.norm(second), position.shape)
    spread = np.stack([moved.value_std, moved.rate_std, noise])
    known = np.convolve(np.isfinite(pressure).all(axis=(1, 2)), np.ones(2 * half + 1), "same") > 2 * half + 0.5
    centres = np.arange(half, len(position) - half, max(1, round(BLOCK_SECONDS / record.period)))
    return _Motion(value, spread, pressure, std, weights, centres[known[centres]])


def _noise_covariance(machine: Machine, motion: _Motion, arm: ArmBalance, moment_arm, force) -> np.ndarray:
    """Return the covariance (b, n, n) of the force of a block by noise and by friction at rest.

    The noise of pressures is independent between rows. That of the smoothed motion and the friction of a
    drive at rest are the same in all rows of a block. The friction of a drive at rest has the breakaway
    friction as its standard deviation.
    """
    n, causes = force.shape[1], []
    for order in range(3):
        for f in range(n):
            change = np.zeros_like(motion.value)
            change[order, :, f] = motion.std[order, :, f]
            causes.append(motion.forces(arm, change) - force)
    valves = actuator_order(machine)[: motion.pressure.shape[1]]
    for i, axis in enumerate(valves):
        for side, area in enumerate(machine.axes[axis].hydraulic_drive.effective_areas):
            noise = area * motion.pressure_std[i, side] * np.linalg.norm(motion.weights)
            causes.append(motion.average(moment_arm[:, i]) * noise)
        causes.append(motion.average(moment_arm[:, i] * _unknown_friction(arm, motion, moment_arm, i)[:, None]))
    return sum(np.einsum("bi,bj->bij", cause, cause) for cause in causes)  # pyright: ignore[reportReturnType]


def _unknown_friction(arm: ArmBalance, motion: _Motion, moment_arm: np.ndarray, i: int) -> np.ndarray:
    """Return the standard deviation (rows,) of the friction of valve i's drive at uncertain velocity [N] or [N m]."""
    user, u = arm.model.user, i * SLOT_COUNT
    velocity = np.einsum("tn,tn->t", moment_arm[:, i], motion.value[1])
    variance = np.einsum("tn,tn->t", moment_arm[:, i] ** 2, motion.std[1] ** 2)
    rest = np.exp(-0.5 * velocity**2 / np.maximum(variance + user[u + Slot.COULOMB_VELOCITY] ** 2, 1e-30))
    return rest * (user[u + Slot.COULOMB] + user[u + Slot.STRIBECK])


def _changed_machines(machine: Machine):
    """Yield machines with one parameter changed by its standard deviation, or a part of it, and that part.

    The parameters are those that are uncertain by the machine file, and those of all effects that the
    library knows, except the payload. A payload is a load of the tool.
    """
    for one in (calibration(machine), *hypotheses(machine)):
        if one.name == _LOAD_EFFECT:
            continue
        for k in range(one.size):
            deviation = np.zeros(one.size)
            deviation[k] = _step_inside_bounds(one, k)
            try:
                changed = one.machine(machine, deviation)
                create_arm_balance(changed, "")
            except InputError:
                continue  # a machine that cannot have the effect
            if deviation[k]:
                yield changed, float(deviation[k])


def _step_inside_bounds(one: Hypothesis, k: int) -> float:
    """Return the step of parameter k from its nominal value in standard deviations, at most 0.1."""
    return float(max(min(0.1, one.high[k]), one.low[k])) if one.high[k] > 0.0 else float(max(-0.1, one.low[k]))


def _loaded_machines(machine: Machine):
    """Yield machines with a point mass on the tool: at its joint, at its tip, and as far to the side of the tip."""
    assert machine.arm
    tip = machine.arm.tip
    outer = np.array(tip.position)
    side = np.array([-outer[2], 0.0, outer[0]])
    for place in (np.zeros(3), outer, 0.5 * (outer + side)):
        x, y, z = map(float, place)
        link = Link(parent=tip.link, position=(x, y, z), mass=_TEST_MASS_KG, inertia=(1e-3, 1e-3, 1e-3))
        yield machine.model_copy(update={"links": {**machine.links, PAYLOAD: link}})


def _tip_jacobians(arm: ArmBalance, position: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives (b, m, n) of the tip's pose by the coordinates, and its radius (b,) [m]."""
    m = len(arm.joint)
    out, radius, table, pose = np.zeros((len(position), m, n)), np.zeros(len(position)), np.zeros((m, m)), np.zeros(5)
    for t, q in enumerate(position):
        angles = np.ascontiguousarray(q[arm.joint])
        task_jacobian(arm.task, angles, table)
        compute_tip_pose(arm.task, angles, pose)
        out[t][:, arm.joint], radius[t] = table, pose[0]
    return out, radius
