"""A valve-controlled machine as its tip feels along one task coordinate, linear about a pose.

Oil is a spring: at held valves a drive's force changes by `K (v_valve - v)` per second, with
`K = beta (A_h^2 / V_A + A_r^2 / V_B)` and the velocity v_valve that the valve lets through. The
servo asks for `v_ref + g (y_ref - y) - p (F - mean F) / K` (`control.servo`), which the valve
follows with its lag V. For one joint that is

    F = K / (s + p V L) [(V + g V / s) v_ref - (1 + g V / s) v],   L = T s / (T s + 1)

The arm adds the compliances of its joints at the tip, each with its own lag: `1 / C_s` is the sum
of `J_i^2 / C_i`, and the tip follows its reference by the mean of the joints' `(V + g V / s) /
(1 + g V / s)`, weighted with what each contributes to the reference's rate.

Left out: dead bands, flow limits, leakage, friction, flexible transmissions, and what the other
coordinates move meanwhile.
"""

from dataclasses import dataclass

import numpy as np

from hydrotele.control.resolved_motion import COORDINATES, arm_axes
from hydrotele.control.tip_balance import Arm, arm_tables
from hydrotele.core.errors import InputError
from hydrotele.dynamics.forces import gather_forces
from hydrotele.dynamics.integrate import place_mechanism
from hydrotele.dynamics.model import X
from hydrotele.hydraulics.circuit import SLOTS, Kind, Slot
from hydrotele.kinematics.task import task_jacobian
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.teleop.slave import AHEAD


@dataclass(frozen=True)
class TipDrive:
    """What the tip of an arm of k joints is along one coordinate, linear about a pose.

    Attributes:
        coordinate: `r`, `theta`, `z`, `attitude` or `head`.
        mass: effective mass, `1 / (J M^-1 J')` [kg], [kg m^2].
        compliance: (k,) of every joint at the tip, valves shut [m/N], [rad/(N m)].
        share: (k,) of the reference's rate that every joint makes; their sum is 1.
        gain: (k,) g of the servo [1/s].
        bandwidth: (k,) of the valves [rad/s].
        damping: (k,) ratios of the valves [1].
        delay: (k,) of the commands [s].
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
        """Hydraulic stiffness at the tip, valves shut [N/m], [N m/rad]."""
        return 1.0 / float(self.compliance.sum())


@dataclass(frozen=True)
class Clocks:
    """When things happen: control period and period of the sensors' samples [s]."""

    control: float
    samples: float


def tip_drive(
    machine: Machine, joints: dict[str, float], coordinate: str, servo: Servo
) -> TipDrive:
    """The tip of a machine along one coordinate.

    Args:
        machine: the machine, all of whose arm's joints are driven by valves.
        joints: axis -> position of the pose [rad]; the others stand at home.
        coordinate: of the arm.
        servo: gains.

    Returns:
        Its numbers.

    Raises:
        InputError: the arm cannot be felt, or does not move along the coordinate there.

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


def _inertia(arm: Arm, row: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Effective mass, Jacobian row (k,), and joint rates (k,) for a unit rate of the coordinate."""
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


def _turning_stiffness(arm: Arm, valve: int) -> float:
    """Stiffness of a joint on its drive's oil [N m/rad], after `place`."""
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
    """C_s: force at the tip per velocity of the tip against its reference.

    Args:
        tip: the machine.
        servo: gains.
        clocks: periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [N s/m], [N m s/rad].

    Source: this module's docstring.
    """
    valve, place_lag, rubbing = _lags(tip, servo, clocks, s)
    single = (1.0 + tip.gain * valve * place_lag / s[..., None]) / (s[..., None] + rubbing)
    return 1.0 / (tip.compliance / single).sum(axis=-1)


def drive_follows(tip: TipDrive, servo: Servo, clocks: Clocks, s: np.ndarray) -> np.ndarray:
    """Velocity of the unloaded tip per velocity that is asked for.

    Args:
        tip: the machine.
        servo: gains.
        clocks: periods.
        s: (...) complex frequencies [rad/s].

    Returns:
        (...) [1].

    Source: this module's docstring; `teleop.slave.ask` for the look ahead.
    """
    valve, place_lag, _ = _lags(tip, servo, clocks, s)
    held = np.exp(-0.5 * clocks.control * s)
    ahead = servo.feedforward * held * (1.0 + servo.lead * s / (AHEAD * s + 1.0))
    back = tip.gain * place_lag / s[..., None]
    return (tip.share * valve * (ahead[..., None] + back) / (1.0 + valve * back)).sum(axis=-1)


def _lags(tip: TipDrive, servo: Servo, clocks: Clocks, s: np.ndarray):
    """(..., k) valves with their delay, hold of the sensors, and pressure feedback [1/s]."""
    at = s[..., None]
    valve = tip.bandwidth**2 / (at**2 + 2.0 * tip.damping * tip.bandwidth * at + tip.bandwidth**2)
    valve = valve * np.exp(-tip.delay * at)
    held = np.exp(-0.5 * clocks.samples * at)
    passed = servo.load_time * at / (servo.load_time * at + 1.0)
    return valve, held, servo.pressure_feedback * passed * valve * held
