"""External forces on the coordinates of an arm along a log, with their uncertainty.

`compute_external_forces` evaluates the force balance of `control.tip_balance` in every block of rows
of a run. The result contains the variance of each cause: pressure noise, noise of the motion, the
unknown friction of drives at rest, and the sensitivity to constant errors of the machine's parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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

BLOCK_SECONDS = 0.1  # [s] rows that are averaged; contact is detected with this resolution
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
        jacobian: (b, m, n) derivatives of the tip's pose (r, theta, z, attitude, head) by the coordinates.
        radius: (b,) distance of the tip from the swing axis [m].
    """

    time: np.ndarray
    force: np.ndarray
    covariance: np.ndarray
    parameter_effect: np.ndarray
    load_effect: np.ndarray
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
    """Smoothed motion and pressures of the rows of a run: positions, rates, accelerations (3, rows, n)."""

    value: np.ndarray
    std: np.ndarray
    pressure: np.ndarray
    pressure_std: np.ndarray

    def forces(self, arm: ArmBalance, change: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return external forces (rows, n) and moment arms (rows, h, n) with a changed motion."""
        rows, n = self.value.shape[1:]
        force, moment_arm = np.zeros((rows, n)), np.zeros((rows, self.pressure.shape[1], n))
        moved = np.ascontiguousarray(self.value + change)
        compute_balance_of_rows(arm, moved, self.pressure, np.ascontiguousarray(self.std[1]), force, moment_arm)
        return force, moment_arm


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
    average = _block_average(motion, record.period)
    force, moment_arm = motion.forces(arm)
    known = np.isfinite(average(force)).all(axis=1)

    def effect(changed: Machine, step: float) -> np.ndarray:
        return (average(motion.forces(create_arm_balance(changed, where))[0] - force) / step)[known]

    covariance = _noise_covariance(machine, motion, arm, moment_arm, force, average)[known]
    size = np.sqrt(np.einsum("bii->bi", covariance))
    columns = [column for changed, step in _changed_machines(machine)
               if np.abs(column := effect(changed, step)).max(initial=0.0)
               > _MIN_FORCE_CHANGE * size.min(initial=np.inf)]  # fmt: skip
    loads = [effect(changed, -_TEST_MASS_KG) for changed in _loaded_machines(machine)]
    pose = average(motion.value[0])[known]
    jacobian, radius = _tip_jacobians(arm, pose, len(free))
    time = average(run.start + record.period * (record.first_row + np.arange(len(force)))[:, None])[known, 0]
    return ExternalForces(
        time, average(force)[known], covariance, np.stack(columns, axis=2), np.stack(loads, axis=2), jacobian, radius,
    )  # fmt: skip


def _smooth_motion(dataset, run, record: IdentificationRecord, free: tuple[str, ...], where: str) -> _Motion:
    """Return the smoothed motion of the coordinates and the corrected pressures of a run."""
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
            if channel not in stated:
                raise InputError(where, f"{channel} is not in the logs: the force at the tip follows from both pressures of"
                                 " every drive of the arm")  # fmt: skip
            column = run.reading[rows, dataset.channels.index(channel)]
            error = machine.sensor_errors.get(channel, SensorError())
            pressure[:, i, side] = correct_sensor_error(column, error, run.period, run.start)
            std[i, side] = stated[channel] / error.scale
            if np.isnan(std[i, side]) and np.isfinite(column).sum() > 10:
                std[i, side] = smooth_and_differentiate(column, run.period).noise[0]
    value = np.stack([moved.value, moved.rate, moved.acceleration])
    spread = np.stack([moved.value_std, moved.rate_std, moved.acceleration_std])
    return _Motion(value, spread, pressure, std)


def _block_average(motion: _Motion, period: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that averages rows (rows, ...) over blocks; NaN for blocks without a complete row."""
    rows = motion.value.shape[1]
    count = max(1, round(BLOCK_SECONDS / period))
    known = np.isfinite(motion.pressure).all(axis=(1, 2))
    block = np.arange(rows) // count
    total = np.bincount(block, known)

    def average(values: np.ndarray) -> np.ndarray:
        flat = np.where(known[:, None], values.reshape(rows, -1), 0.0)
        sums = np.zeros((len(total), flat.shape[1]))
        np.add.at(sums, block, flat)
        with np.errstate(invalid="ignore"):
            return (sums / total[:, None]).reshape(len(total), *values.shape[1:])

    return average


def _noise_covariance(machine, motion: _Motion, arm: ArmBalance, moment_arm, force, average) -> np.ndarray:
    """Return the covariance (b, n, n) of the mean force of a block by noise and by friction at rest.

    The noise of pressures is independent between rows. That of the smoothed motion and the friction of a
    drive at rest are the same in all rows of a block. The friction of a drive at rest has the breakaway
    friction as its standard deviation.
    """
    n, count = force.shape[1], len(force) / len(average(force))
    causes = []
    for order in range(3):
        for f in range(n):
            change = np.zeros_like(motion.value)
            change[order, :, f] = motion.std[order, :, f]
            causes.append(average(motion.forces(arm, change)[0] - force))
    valves = actuator_order(machine)[: motion.pressure.shape[1]]
    for i, axis in enumerate(valves):
        for side, area in enumerate(machine.axes[axis].hydraulic_drive.effective_areas):
            causes.append(average(moment_arm[:, i]) * area * motion.pressure_std[i, side] / np.sqrt(count))
        causes.append(average(moment_arm[:, i] * _unknown_friction(arm, motion, moment_arm, i)[:, None]))
    return sum(np.einsum("bi,bj->bij", cause, cause) for cause in causes)  # pyright: ignore[reportReturnType]


def _unknown_friction(arm: ArmBalance, motion: _Motion, moment_arm: np.ndarray, i: int) -> np.ndarray:
    """Return the standard deviation (rows,) of the friction of valve i's drive, whose motion is uncertain [N] or [N m]."""
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
        link = Link(parent=tip.link, position=tuple(place), mass=_TEST_MASS_KG, inertia=(1e-3,) * 3)
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
