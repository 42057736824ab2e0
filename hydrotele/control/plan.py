"""Conversion of a scenario's pilot to a plan: commands and joint references at every control tick.

`make_plan` computes a `Plan` with either an open-loop command or a joint reference for each axis.
The check functions compare it with joint ranges, command limits and the length of the run.
"""

import dataclasses
import math
from itertools import zip_longest

import numpy as np

from hydrotele.control.arm_kinematics import arm_axes, pose_to_joints
from hydrotele.control.resolved_motion import ResolvedMotion
from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.machine.machine import Machine
from hydrotele.scenario.pilots import (
    ConstantPilot,
    FourierPilot,
    LinesPilot,
    Pilot,
    PolicyPilot,
    TablePilot,
    TipMove,
    Waypoint,
    WaypointsPilot,
)
from hydrotele.scenario.teleoperation import TeleopPilot

_UNLIMITED_POSITION = 1.0e6  # rad or m, limit of a joint without a range
_COMMAND_TOLERANCE = 1.0e-3  # tolerance of a command, for the rounding of real loggers


def check_reference(machine: Machine, name: str, time: np.ndarray, reference: np.ndarray) -> None:
    """Raise InputError if a joint reference is not finite or leaves the joint's range.

    Args:
        machine: the machine.
        name: axis name.
        time: (n,) times [s].
        reference: (n,) joint reference [rad] or [m].

    Raises:
        InputError: the message states axis, value, time and range.
    """
    low, high = machine.joints[machine.axes[name].joint].range or (
        -_UNLIMITED_POSITION,
        _UNLIMITED_POSITION,
    )
    outside = np.flatnonzero(~((low - 1e-9 <= reference) & (reference <= high + 1e-9)))
    if len(outside):
        row = outside[0]
        raise InputError(
            "pilot",
            f"the reference of {name} is {reference[row]:.4g} at {time[row]:.4g} s; its joint range"
            f" is {low:.4g} .. {high:.4g}",
        )


def check_command(machine: Machine, name: str, command: np.ndarray) -> None:
    """Raise InputError if a command exceeds the limit of the drive.

    Args:
        machine: the machine.
        name: axis name.
        command: (n,) valve command [1], or in the force drive's unit.

    Raises:
        InputError: the message states axis, value and limit.
    """
    force = machine.axes[name].force
    limit, unit = (force.command_limit, force.command_unit) if force else (1.0, "1")
    if len(outside := np.flatnonzero(~(np.abs(command) <= limit + _COMMAND_TOLERANCE))):
        raise InputError(
            "pilot",
            f"the command of {name} is {command[outside[0]]:g}; its drive accepts -{limit:g} .. {limit:g} [{unit}]",
        )


def note_early_end(time: np.ndarray, pilot_duration: float) -> tuple[str, ...]:
    """Return a message if a run ends before all motions of its pilot (the intended motion) are finished.

    Args:
        time: (n,) times of the control ticks [s].
        pilot_duration: time that the pilot needs [s].

    Returns:
        A tuple with one sentence, or an empty tuple.
    """
    missing = pilot_duration - (2 * time[-1] - time[-2])
    return (f"the run ends {missing:.3g} s before its pilot",) if missing > 1e-6 else ()


@dataclasses.dataclass(frozen=True)
class Plan:
    """Open-loop command or joint reference of every axis at every control tick.

    Attributes:
        time: (n,) times of the control ticks [s].
        axes: axis names in the order of the columns.
        command: (n, k) open-loop commands [1], or in the drive's unit; used where `closed_loop` is
            False.
        reference: (n, k) joint references [rad] or [m]; used where `closed_loop` is True.
        rate: (n, k) rates of the references [rad/s] or [m/s].
        closed_loop: (k,) whether the servo moves the axis along its reference.
        pose: (n, 4 or 5) reference r [m], theta [rad], z [m], attitude [rad] and head angle [rad]
            of the tip; None if the pilot has no tip motion.
        notes: sentences about motions that cannot be followed.
        goal: (n, k) positions that a policy is to follow [rad] or [m], None without a policy or reference.
        goal_rate: (n, k) their rates [rad/s] or [m/s], None likewise.
    """

    time: np.ndarray
    axes: tuple[str, ...]
    command: np.ndarray
    reference: np.ndarray
    rate: np.ndarray
    closed_loop: np.ndarray
    pose: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    goal: np.ndarray | None = None
    goal_rate: np.ndarray | None = None


def make_plan(machine: Machine, axes: tuple[str, ...], pilot: Pilot, start: dict[str, float], time: np.ndarray) -> Plan:
    """Convert a scenario's pilot to commands and joint references at every control tick.

    Args:
        machine: the machine.
        axes: axis names in column order.
        pilot: the scenario's pilot, which describes the intended motion.
        start: joint name -> position at t = 0 [rad] or [m].
        time: (n,) times of the control ticks [s].

    Returns:
        The plan.

    Raises:
        InputError: the pilot names an unknown axis, starts out of reach, or exceeds a joint range
            or a command limit.
    """
    plan = _build_plan(machine, axes, pilot, start, time)
    for column, name in enumerate(axes):
        if plan.closed_loop[column]:
            check_reference(machine, name, plan.time, plan.reference[:, column])
        else:
            check_command(machine, name, plan.command[:, column])
    return plan


def _build_plan(
    machine: Machine, axes: tuple[str, ...], pilot: Pilot, start: dict[str, float], time: np.ndarray
) -> Plan:
    n, k = len(time), len(axes)
    home = np.array([start.get(machine.axes[a].joint, 0.0) for a in axes])
    plan = Plan(time, axes, np.zeros((n, k)), np.tile(home, (n, 1)), np.zeros((n, k)), np.zeros(k, bool))
    match pilot:
        case ConstantPilot():
            for name, value in pilot.commands.items():
                plan.command[:, _find_column(axes, name, "pilot.commands")] = value
            return plan
        case TablePilot():
            return _plan_from_table(plan, pilot)
        case FourierPilot():
            return _plan_fourier(plan, pilot)
        case LinesPilot():
            return _plan_straight_tip_moves(plan, machine, pilot)
        case WaypointsPilot():
            return _plan_waypoints(plan, machine, pilot)
        case TeleopPilot():
            return _plan_teleoperation(plan, machine, pilot)
        case PolicyPilot():
            return _plan_policy(plan, machine, pilot, start)


def _plan_policy(plan: Plan, machine: Machine, pilot: PolicyPilot, start: dict[str, float]) -> Plan:
    """Return the plan of a run with a policy: arrays for its commands or references, and the reference to follow.

    The axes that the policy does not drive keep their commands: their valves stay closed.
    """
    driven = [_find_column(plan.axes, name, "pilot.axes") for name in pilot.axes] or list(range(len(plan.axes)))
    closed = np.zeros(len(plan.axes), bool)
    closed[driven] = pilot.action in ("joint_rate", "resolved_motion")
    plan = dataclasses.replace(plan, closed_loop=closed)
    if pilot.reference is None:
        return plan
    goal = make_plan(machine, plan.axes, pilot.reference, start, plan.time)
    if not goal.closed_loop.any():  # commands are no reference
        return plan
    return dataclasses.replace(plan, pose=goal.pose, notes=goal.notes, goal=goal.reference, goal_rate=goal.rate)


def _plan_teleoperation(plan: Plan, machine: Machine, pilot: TeleopPilot) -> Plan:
    """Return the plan of a teleoperated run, with its open-loop commands and arrays for the references.

    Joint references and tip pose are written during the run. Buttons of the operator set open-loop
    commands of axes outside the arm, each from a given time on. All other axes except force drives
    follow references.
    """
    closed = np.array([machine.axes[a].force is None for a in plan.axes])
    for button in sorted(pilot.buttons, key=lambda button: button.start):
        column = _find_column(plan.axes, button.axis, "pilot.buttons")
        if button.axis in arm_axes(machine):
            raise InputError("pilot.buttons", f"{button.axis} is controlled by the joystick; name another axis")
        plan.command[plan.time >= button.start, column] = button.command
        closed[column] = False
    pose = np.zeros((len(plan.time), max(4, len(arm_axes(machine)))))
    return dataclasses.replace(plan, closed_loop=closed, pose=pose)


def _find_column(axes: tuple[str, ...], name: str, where: str) -> int:
    if name not in axes:
        raise InputError(where, f"{name!r} is not an axis of the machine; {suggest_valid_name(name, axes)}")
    return axes.index(name)


def _plan_from_table(plan: Plan, pilot: TablePilot) -> Plan:
    times = np.array(pilot.time)
    closed = plan.closed_loop.copy()
    for name, values in pilot.columns.items():
        column = _find_column(plan.axes, name, "pilot.columns")
        if pilot.interpolate == "linear":
            wanted = np.interp(plan.time, times, values)
        else:
            row = np.searchsorted(times, plan.time * (1 + 1e-12) + 1e-9, side="right") - 1
            wanted = np.array(values)[np.clip(row, 0, len(values) - 1)]
        if pilot.quantity == "command":
            plan.command[:, column] = wanted
        else:
            plan.reference[:, column] = wanted
            if pilot.interpolate == "linear":
                plan.rate[:, column] = np.gradient(wanted, plan.time)
    return dataclasses.replace(plan, closed_loop=closed | (pilot.quantity == "joint"))


def _plan_fourier(plan: Plan, pilot: FourierPilot) -> Plan:
    """Return a plan with Fourier series as joint references, faded in from the start position.

    `reference = start + s(t) (wave - start)` with the Fourier series `wave`, and the smooth step s
    of `quintic_step` with the duration `pilot.fade`. Axes in `pilot.closed_valves` have the
    open-loop command 0.
    """
    s, ds = quintic_step(plan.time, pilot.fade)
    omega = 2.0 * math.pi / pilot.period
    for name, harmonics in pilot.axes.items():
        column = _find_column(plan.axes, name, "pilot.axes")
        wave = np.full_like(plan.time, harmonics.mean)
        slope = np.zeros_like(plan.time)
        pairs = zip_longest(harmonics.sin, harmonics.cos, fillvalue=0.0)
        for order, (a, b) in enumerate(pairs, start=1):
            phase = order * omega * plan.time
            wave += a * np.sin(phase) + b * np.cos(phase)
            slope += order * omega * (a * np.cos(phase) - b * np.sin(phase))
        begin = plan.reference[0, column]
        plan.reference[:, column] = begin + s * (wave - begin)
        plan.rate[:, column] = s * slope + ds * (wave - begin)
    closed = np.ones(len(plan.axes), bool)
    for name in pilot.closed_valves:
        closed[_find_column(plan.axes, name, "pilot.closed_valves")] = False
    return dataclasses.replace(plan, closed_loop=closed)


def quintic_step(time: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a smooth step from 0 to 1 with zero speed and acceleration at both ends, and its rate.

    Args:
        time: (n,) times [s].
        duration: duration of the step [s]; below one microsecond the value is 1 everywhere.

    Returns:
        (s (n,) [1], ds/dt (n,) [1/s]).

    >>> quintic_step(np.array([0.0, 1.0, 2.0, 3.0]), 2.0)[0]
    array([0. , 0.5, 1. , 1. ])
    """
    if duration < 1.0e-6:
        return np.ones_like(time), np.zeros_like(time)
    x = np.clip(time / duration, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2 / duration


def _trapezoidal_speed(time: np.ndarray, distance: float, speed: float, acceleration: float):
    """Return the speed (n,) at given times of a move with a trapezoidal speed profile, and the move's duration [s].

    Args:
        time: (n,) times since the start of the move [s].
        distance: length of the move [m] or [rad], > 0.
        speed: largest speed [m/s] or [rad/s]; a short move does not reach it.
        acceleration: acceleration and deceleration [m/s^2] or [rad/s^2].
    """
    ramp = min(speed / acceleration, math.sqrt(distance / acceleration))
    cruise = distance / (ramp * acceleration) - ramp
    rise = np.clip(time / ramp, 0, 1) - np.clip((time - ramp - cruise) / ramp, 0, 1)
    return acceleration * ramp * rise, 2 * ramp + cruise


def _plan_straight_tip_moves(plan: Plan, machine: Machine, pilot: LinesPilot) -> Plan:
    motion = ResolvedMotion.from_joints(machine, dict(zip(plan.axes, plan.reference[0], strict=True)))
    rates = _tip_rate_commands(plan.time, pilot)
    dt = np.diff(plan.time, prepend=plan.time[0])
    pose = np.empty((len(plan.time), len(motion.pose)))
    wanted = np.cumsum(rates * dt[:, None], axis=0)
    wanted[:, : len(motion.pose)] += motion.pose
    blocked = 0
    for row in range(len(plan.time)):
        if pilot.mode == "rate":
            motion, joints, speeds = motion.step_by_rate(rates[row], dt[row])
        else:
            motion, joints, speeds = motion.step_to_pose(wanted[row], rates[row])
        blocked += motion.is_blocked
        pose[row] = motion.pose
        for name, value in joints.items():
            column = plan.axes.index(name)
            plan.reference[row, column] = value
            plan.rate[row, column] = speeds[name]
    notes = note_early_end(plan.time, tip_moves_duration(pilot))
    if blocked:
        seconds = blocked * (plan.time[1] - plan.time[0])
        notes += (f"resolved motion was held at the edge of the workspace for {seconds:.3g} s",)
    closed = np.ones(len(plan.axes), bool)
    return dataclasses.replace(plan, closed_loop=closed, pose=pose, notes=notes)


def _tip_rate_commands(time: np.ndarray, pilot: LinesPilot) -> np.ndarray:
    rates = np.zeros((len(time), 5))
    begin = pilot.settle
    for move in pilot.moves:
        way = np.array([move.r, move.theta, move.z, move.attitude, move.head])
        size = float(np.hypot(move.r, move.z)) or float(np.abs(way).max())
        if size == 0.0:
            begin += move.pause
            continue
        speed, duration = _trapezoidal_speed(time - begin, size, move.speed, pilot.acceleration)
        rates += speed[:, None] * way / size
        begin += duration + move.pause
    return rates


def tip_moves_duration(pilot: LinesPilot) -> float:
    """Return the time [s] that a lines pilot (straight moves of the tip) needs for all moves and pauses."""
    total = pilot.settle
    for move in pilot.moves:
        total += move.pause + _move_duration(move, pilot.acceleration)
    return total


def _move_duration(move: TipMove, acceleration: float) -> float:
    size = math.hypot(move.r, move.z) or max(abs(move.theta), abs(move.attitude), abs(move.head))
    return _trapezoidal_speed(np.zeros(1), size, move.speed, acceleration)[1] if size else 0.0


def _plan_waypoints(plan: Plan, machine: Machine, pilot: WaypointsPilot) -> Plan:
    begin = pilot.settle
    here = dict(zip(plan.axes, plan.reference[0], strict=True))
    for number, point in enumerate(pilot.points):
        inside = (plan.time >= begin) & (plan.time <= begin + point.duration)
        s, ds = quintic_step(plan.time[inside] - begin, point.duration)
        where = f"pilot.points.{number}"
        target = _waypoint_joints(machine, plan.axes, here, point, where)
        for name, value in target.items():
            check_reference(machine, name, np.array([begin]), np.array([value]))
        if point.pose:
            path, speeds = _pose_path(machine, plan.axes, here, target, s, ds, where)
        else:
            span = np.array([target[a] - here[a] for a in plan.axes])
            path = np.array([here[a] for a in plan.axes]) + s[:, None] * span
            speeds = ds[:, None] * span
        plan.reference[inside], plan.rate[inside] = path, speeds
        begin += point.duration
        plan.reference[plan.time > begin] = [target[a] for a in plan.axes]
        begin += point.pause
        here = target
    notes = note_early_end(plan.time, begin)
    return dataclasses.replace(plan, closed_loop=np.ones(len(plan.axes), bool), notes=notes)


def _waypoint_joints(machine, axes, current: dict, point: Waypoint, where: str) -> dict[str, float]:
    target = dict(current)
    if point.pose:
        target |= pose_to_joints(machine, point.pose, current, f"{where}.pose")
    for name, value in point.joints.items():
        target[axes[_find_column(axes, name, f"{where}.joints")]] = value
    return target


def _pose_path(machine, axes, current, target, s, ds, where: str) -> tuple[np.ndarray, np.ndarray]:
    order = arm_axes(machine)
    first = np.array(ResolvedMotion.from_joints(machine, current).pose)
    last = np.array(ResolvedMotion.from_joints(machine, target).pose)
    path = np.tile([current[a] for a in axes], (len(s), 1))
    speeds = np.zeros_like(path)
    for a in axes:
        if a not in order:
            path[:, axes.index(a)] += s * (target[a] - current[a])
            speeds[:, axes.index(a)] = ds * (target[a] - current[a])
    motion = ResolvedMotion.from_joints(machine, current)
    for row, (part, rate) in enumerate(zip(s, ds, strict=True)):
        motion, joints, velocity = motion.step_to_pose(first + part * (last - first), rate * (last - first))
        if motion.is_blocked:
            raise InputError(
                f"{where}.pose", f"the straight path leaves the workspace after {100 * part:.0f} %;"
                " add a waypoint, or give joints",
            )  # fmt: skip
        for name, value in joints.items():
            path[row, axes.index(name)] = value
            speeds[row, axes.index(name)] = velocity[name]
    return path, speeds
