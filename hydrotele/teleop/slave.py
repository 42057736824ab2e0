"""Slave side of teleoperation: converts packets from the joystick to safe joint references.

The slave is the remote machine, the master the joystick.

Under rate control the handle displacement beyond the dead band commands the rate of the task
coordinates, under position control their position. Limits of speed and acceleration keep the
references continuous. A valve-controlled machine does not give way to forces. With four channels or
a passive channel, the forces of hand or channel and of the task therefore move a virtual mass.

Parameters and state of the slave side are named tuples of arrays that are contiguous in memory.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.arm_kinematics import COORDINATES, arm_specification
from hydrotele.control.resolved_motion import step_references_by_rate, step_references_to_pose
from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import copy_to_contiguous_state, make_contiguous_state, split_array
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.scenario.teleoperation import CoordinateMapping, TeleopPilot
from hydrotele.teleop.axis_table import (
    AXIS_WAVE_IMPEDANCE,
    COORDINATE,
    COUPLING,
    COUPLING_DAMPING,
    DEADBAND,
    GAIN,
    HANDLE_RANGE,
    LEVER,
    MAX_REFLECTED_FORCE,
    REFLECTION_RATIO,
    SIGN,
)
from hydrotele.teleop.master import (
    CHANNEL_ENERGY,
    CHANNEL_SIGNAL,
    FOUR_CHANNEL,
    MAX_WINDUP,
    PASSIVITY_CONTROL,
    POSITION,
    RATE,
    REFERENCE_POSITION,
    REFERENCE_SPEED,
    SENT_SIGNAL,
    TIP_FORCE,
    TIP_POSITION,
    TIP_SPEED,
    WAVE_VARIABLES,
    MasterParameters,
)
from hydrotele.teleop.passive_channel import ENERGY_IN, step_passivity_slave, step_wave_slave

HELD_AT_EDGE, NO_PACKETS, VALVES_CLOSED, PACKET_AGE = range(4)  # indices into `SlaveState.flags`
USES_JACOBIAN = 4  # index into `SlaveParameters.kind`
# columns of `SlaveParameters.table`
(AXIS, AXIS_SIGN, AXIS_GAIN, DEADBAND_EDGE, HANDLE_STOP, SPRING, DAMPER, FORCE_RATIO, MASS_LEVER, MAX_SPEED, MAX_FORCE,
 WAVE_IMPEDANCE) = range(12)  # fmt: skip
TABLE_COLUMNS = WAVE_IMPEDANCE + 1
MAX_SILENCE, MAX_FOLLOWING_ERROR, ACCELERATION, VIRTUAL_MASS, LEAD = range(5)  # indices into `SlaveParameters.limits`
# rows of a command packet
HANDLE, HANDLE_SPEED, HAND = range(3)  # with a passive channel: handle, sum or position, energy


class SlaveParameters(NamedTuple):
    """Parameters of the slave side, for an arm with k joints and k task coordinates.

    Attributes:
        arm: (9,) geometry of the arm, from `kinematics.task_space.arm_parameters`.
        ranges: (k, 2) joint ranges [rad].
        start: (5,) pose at the start: r [m], theta [rad], z [m], attitude [rad], head [rad].
        table: (k, 12) parameters of every coordinate: joystick axis (-1 without), sign, gain, dead
            band, range, coupling stiffness, coupling damping, hand per machine force, lever of the
            virtual mass [1] or [m^2], maximum speed [m/s] or [rad/s], limit of the reflected force
            [N] or [N m], wave impedance [N s/m].
        limits: (5,) packet timeout [s], maximum following error of a joint [rad], maximum
            acceleration of a task coordinate [m/s^2] or [rad/s^2], virtual mass [kg], phase lead of
            the drives [s].
        kind: (5,) the four elements of `MasterParameters.kind`, then 1 if the inverse Jacobian
            resolves the motion.
    """

    arm: np.ndarray
    ranges: np.ndarray
    start: np.ndarray
    table: np.ndarray
    limits: np.ndarray
    kind: np.ndarray


class SlaveState(NamedTuple):
    """State of the slave side, with the references that it computes every control period.

    Attributes:
        pose: (5,) reference pose [m], [rad].
        rate: (5,) rate of the reference pose [m/s], [rad/s].
        joint: (k,) joint references [rad].
        joint_rate: (k,) rates of the joint references [rad/s].
        ahead: (k,) joint rates with phase lead, for the delay of the valves [rad/s].
        measured: (2, 5) measured pose of the tip [m], [rad] and its filtered rate [m/s], [rad/s].
        command: (3, 6) last packet from the master: displacement of the handle, its rate, hand
            force. With a passive channel the last two are the channel's signal and energy.
        force_integral: (5,) integral of the rate gain times the hand force, for four channels under
            rate control.
        asked: (5,) integral of the commanded rate, for four channels under rate control [m], [rad].
        flags: (4,) three flags, 0 or 1: the reference is held at the workspace edge, no packets
            arrive, the valves are closed permanently; then the time since the last packet arrived
            [s].
        line: (5, 10) slave's end of a passive channel for each coordinate, elements as in
            `MasterState.line`, in the scale of the handle.
    """

    pose: np.ndarray
    rate: np.ndarray
    joint: np.ndarray
    joint_rate: np.ndarray
    ahead: np.ndarray
    measured: np.ndarray
    command: np.ndarray
    force_integral: np.ndarray
    asked: np.ndarray
    flags: np.ndarray
    line: np.ndarray


@compiled
def unpack_slave_parameters(flat, k):
    """Return the fields of SlaveParameters as views of a flat array.

    Args:
        flat: (24 + 14 k,) array, as from `flat_view` of a SlaveParameters.
        k: number of joints, scalar.

    Returns:
        SlaveParameters.

    Source: order and shapes of SlaveParameters.
    """
    arm, rest = split_array(flat, 9)
    ranges, rest = split_array(rest, 2 * k)
    start, rest = split_array(rest, 5)
    table, rest = split_array(rest, TABLE_COLUMNS * k)
    limits, kind = split_array(rest, 5)
    return SlaveParameters(arm, ranges.reshape(k, 2), start, table.reshape(k, TABLE_COLUMNS), limits, kind)


@compiled
def unpack_slave_state(flat, k):
    """Return the fields of SlaveState as views of a flat array.

    Args:
        flat: (102 + 3 k,) array, as from `flat_view` of a SlaveState.
        k: number of joints, scalar.

    Returns:
        SlaveState.

    Source: order and shapes of SlaveState.
    """
    pose, rest = split_array(flat, 5)
    rate, rest = split_array(rest, 5)
    joint, rest = split_array(rest, k)
    joint_rate, rest = split_array(rest, k)
    ahead, rest = split_array(rest, k)
    measured, rest = split_array(rest, 10)
    command, rest = split_array(rest, 18)
    force_integral, rest = split_array(rest, 5)
    asked, rest = split_array(rest, 5)
    flags, line = split_array(rest, 4)
    return SlaveState(
        pose, rate, joint, joint_rate, ahead, measured.reshape(2, 5), command.reshape(3, 6),
        force_integral, asked, flags, line.reshape(5, SENT_SIGNAL + 2),
    )  # fmt: skip


SMOOTHING_BANDWIDTH = 15.0  # rad/s, smoothing of the 200 Hz command steps under position control
_MIN_POWER = 1e-3  # W of passivity control, not noticeable by a hand
_BRAKING_FRACTION = 0.8  # fraction of the acceleration limit; the rest compensates the filter's lag
LEAD_AVERAGING_TIME = 0.02  # s, averaging time of the rate's change for the phase lead
_RATE_BANDWIDTH = 30.0  # rad/s, bandwidth of the measured task rates


def build_slave(
    machine: Machine,
    pilot: TeleopPilot,
    numbers: MasterParameters,
    joints: np.ndarray,
    lead: float = 0.0,
) -> tuple[SlaveParameters, SlaveState]:
    """Build parameters and initial state of the slave side.

    Args:
        machine: machine with an arm.
        pilot: teleoperation settings of the scenario.
        numbers: parameters of the master.
        joints: (k,) initial positions of the arm's joints, from swing outwards [rad].
        lead: phase lead of the drives' velocities [s].

    Returns:
        Parameters, and a state with references at the initial pose.

    Raises:
        InputError: the machine has no arm.
    """
    arm, _, ranges = arm_specification(machine)
    k, pose = len(joints), np.zeros(5)
    compute_tip_pose(arm, joints, pose)
    table = np.zeros((k, TABLE_COLUMNS))
    table[:, 0] = -1.0
    for axis, row in enumerate(numbers.axis):
        if row[COORDINATE] >= 0.0:
            lever = 1.0 if axis < 3 else LEVER**2
            name = COORDINATES[int(row[COORDINATE])]
            speed = pilot.coordinates.get(name, CoordinateMapping()).speed  # pyright: ignore - a Coordinate
            table[int(row[COORDINATE])] = (
                axis, row[SIGN], row[GAIN], row[DEADBAND], row[HANDLE_RANGE], row[COUPLING],
                row[COUPLING_DAMPING], row[REFLECTION_RATIO], lever, speed, row[MAX_REFLECTED_FORCE],
                row[AXIS_WAVE_IMPEDANCE],
            )  # fmt: skip
    safety = pilot.safety
    limits = np.array([safety.packet_timeout, safety.following_error, pilot.acceleration, pilot.virtual_mass, lead])
    state = make_contiguous_state(SlaveState, [
        (5,), (5,), (k,), (k,), (k,), (2, 5), (3, 6), (5,), (5,), (4,), (5, SENT_SIGNAL + 2),
    ])  # fmt: skip
    state.pose[:], state.measured[0], state.joint[:] = pose, pose, joints
    kind = np.append(numbers.kind, float(pilot.resolved_motion == "inverse_jacobian"))
    return copy_to_contiguous_state(SlaveParameters(arm, ranges, pose, table, limits, kind)), state


@compiled
def measure_tip(parameters, joint, fresh, elapsed, s):
    """Compute pose and filtered rate of the tip from measured joint angles.

    Args:
        parameters: SlaveParameters.
        joint: (k,) measured joint angles [rad].
        fresh: whether there is a new sample, scalar.
        elapsed: time since the last sample, scalar [s].
        s: SlaveState; pose and rate are written to `measured`, unless there is no new sample or the
            pose is not finite.

    Returns:
        Nothing.

    Source: `kinematics.task_space`; first-order filter.
    """
    if not fresh:
        return
    pose = np.empty(5)
    compute_tip_pose(parameters.arm, joint, pose)
    for i in range(5):
        if not np.isfinite(pose[i]):
            return
    share = min(1.0, _RATE_BANDWIDTH * elapsed)
    for i in range(5):
        if elapsed > 0.0:
            s.measured[1, i] += share * ((pose[i] - s.measured[0, i]) / elapsed - s.measured[1, i])
        s.measured[0, i] = pose[i]


@compiled
def update_joint_references(parameters, packet, arrived, force, joint, period, s):
    """Compute the joint references of this control period from the master's packet.

    The handle commands rates of the task coordinates, which are limited in speed and acceleration
    and resolved to the joints. If no packet has arrived for longer than the packet timeout, the
    rates go to zero.

    Args:
        parameters: SlaveParameters.
        packet: (3, 6) handle's displacement [m], [rad], its rate, the hand's force [N], [N m].
        arrived: whether a packet arrived in this period, scalar.
        force: (k,) force of the environment on the tip, task coordinates [N], [N m].
        joint: (k,) measured joints, at which an inverse Jacobian is evaluated [rad].
        period: control period, scalar [s].
        s: SlaveState; references and flags are written.

    Returns:
        Nothing.

    Source: Zhu 1994, chapters 2 and 3; see this module's docstring.
    """
    k = len(s.joint)
    if arrived:
        for r in range(3):
            for i in range(6):
                s.command[r, i] = packet[r, i] if np.isfinite(packet[r, i]) else 0.0
        s.flags[PACKET_AGE] = 0.0
    else:
        s.flags[PACKET_AGE] += period
    s.flags[NO_PACKETS] = 1.0 if s.flags[PACKET_AGE] > parameters.limits[MAX_SILENCE] else 0.0
    wanted, rate = np.zeros(5), np.zeros(5)
    for c in range(5):
        wanted[c] = s.pose[c]
        if c >= k or (c == 3 and k < 4):
            continue
        row = parameters.table[c]
        goal = 0.0
        if row[AXIS] >= 0.0 and s.flags[NO_PACKETS] == 0.0:
            i = int(row[AXIS])
            x, v, hand = s.command[0, i], s.command[1, i], s.command[2, i]
            goal = _commanded_rate(
                parameters,
                row,
                c,
                row[AXIS_SIGN] * x,
                row[AXIS_SIGN] * v,
                row[AXIS_SIGN] * hand,
                force[c],
                period,
                s,
            )
        else:
            s.asked[c], s.force_integral[c] = s.pose[c] - parameters.start[c], 0.0
        goal = min(row[MAX_SPEED], max(-row[MAX_SPEED], goal))
        change = parameters.limits[ACCELERATION] * period
        rate[c] = min(s.rate[c] + change, max(s.rate[c] - change, goal))
        wanted[c] += period * rate[c]
    before = s.joint_rate.copy()
    arm, ranges = parameters.arm, parameters.ranges
    if parameters.kind[USES_JACOBIAN] > 0.0:
        held = step_references_by_rate(arm, ranges, joint, rate, period, s.pose, s.joint, s.joint_rate)
    else:
        blocked = s.flags[HELD_AT_EDGE] > 0.0
        held = step_references_to_pose(arm, ranges, wanted, rate, blocked, s.pose, s.joint, s.joint_rate)
    lead = parameters.limits[LEAD]
    for i in range(k):
        share = min(1.0, period / LEAD_AVERAGING_TIME)
        change = (s.joint_rate[i] - before[i]) / period
        late = s.ahead[i] - before[i]
        s.ahead[i] = s.joint_rate[i] + late + share * (lead * change - late)
    s.flags[HELD_AT_EDGE] = 1.0 if held else 0.0
    for c in range(5):
        s.rate[c] = 0.0 if held else rate[c]
        if held:
            s.asked[c], s.force_integral[c] = s.pose[c] - parameters.start[c], 0.0


@compiled
def _commanded_rate(numbers, row, c, x, v, hand, force, period, s):
    """Return the rate [m/s] or [rad/s] of task coordinate c that the master commands.

    `x` and `v` are displacement and rate of the handle and `hand` the force of the hand, with the
    sign of the coordinate; with a passive channel `v` is the channel's signal and `hand` its
    energy. `force` is the contact force. The control structure and the mode (rate or position)
    select the law. Under rate control the rate is proportional to the displacement beyond the dead
    band.
    """
    if numbers.kind[0] == FOUR_CHANNEL:
        return _four_channel_rate(numbers, row, c, x, v, hand, force, period, s)
    if numbers.kind[0] == WAVE_VARIABLES or numbers.kind[0] == PASSIVITY_CONTROL:
        return _passive_channel_rate(numbers, row, c, v, hand, force, period, s)
    if numbers.kind[1] == POSITION:
        return _position_control_rate(numbers, row, c, x, period, s)
    beyond = min(row[HANDLE_STOP], abs(x)) - row[DEADBAND_EDGE]
    if beyond <= 0.0:
        return 0.0
    return row[AXIS_GAIN] * beyond if x > 0.0 else -row[AXIS_GAIN] * beyond


@compiled
def _position_control_rate(numbers, row, c, x, period, s):
    """Return the rate of coordinate c that moves the tip to the position that the handle commands.

    It is that of a critically damped second-order filter of the handle. Over long distances it moves at
    maximum speed and brakes within the acceleration limit.
    """
    gap = row[AXIS_GAIN] * x - (s.pose[c] - numbers.start[c])
    size = abs(gap)
    speed = min(
        row[MAX_SPEED],
        0.5 * SMOOTHING_BANDWIDTH * size,
        np.sqrt(2.0 * _BRAKING_FRACTION * numbers.limits[ACCELERATION] * size),
    )
    speed = speed if gap > 0.0 else -speed
    return s.rate[c] + 2.0 * SMOOTHING_BANDWIDTH * period * (speed - s.rate[c])


@compiled
def _four_channel_rate(numbers, row, c, x, v, hand, force, period, s):
    """Return the rate of coordinate c with four channels: that of a virtual mass M.

    Hand force, contact force F and a spring K and damper B to the handle's position x move the mass.
    Under position control `M z'' = hand + ratio F + K (x - z) + B (x' - z')` with z = y / scale.
    Under rate control `M y'' = k_v int hand + ratio F + K (k_v int x - y) + B (k_v x - y')`; y is the
    position of the coordinate, k_v the rate gain, and `int` the integral over time.
    """
    gain, spring, damper = row[AXIS_GAIN], row[SPRING], row[DAMPER]
    mass = numbers.limits[VIRTUAL_MASS] * row[MASS_LEVER]
    scale = gain if numbers.kind[1] == POSITION else 1.0
    place, speed = (s.pose[c] - numbers.start[c]) / scale, s.rate[c] / scale
    felt = row[FORCE_RATIO] * min(row[MAX_FORCE], max(-row[MAX_FORCE], force)) if np.isfinite(force) else 0.0
    ahead, ahead_speed, push = x, v, hand
    if numbers.kind[1] == RATE:
        most = row[FORCE_RATIO] * row[MAX_FORCE] + mass * numbers.limits[ACCELERATION]
        total = s.force_integral[c] + period * gain * hand
        s.force_integral[c] = min(most, max(-most, total))
        asked = s.asked[c] + period * gain * x
        s.asked[c] = min(place + MAX_WINDUP, max(place - MAX_WINDUP, asked))
        ahead, ahead_speed, push = s.asked[c], gain * x, s.force_integral[c]
    push += felt + spring * (ahead - place) + damper * (ahead_speed - speed)
    return scale * (speed + period * push / mass)


@compiled
def _passive_channel_rate(numbers, row, c, total, budget, force, period, s):
    """Return the rate of coordinate c with a passive channel: that of a virtual mass M.

    The force `pull` of the channel's slave end and the scaled contact force F move the mass:
    `M z'' = pull + ratio F`, with z the motion in the scale of the handle. The received packet gives
    `total`, the time integral of the master's waves or the handle position, and `budget`, the
    energy that the master has put into the channel, with the sign of the coordinate.
    """
    gain, spring, damper, end = row[AXIS_GAIN], row[SPRING], row[DAMPER], s.line[c]
    speed, mass = s.rate[c] / gain, numbers.limits[VIRTUAL_MASS] * row[MASS_LEVER]
    if numbers.kind[0] == WAVE_VARIABLES:
        pull, wave = step_wave_slave(
            speed, total, row[AXIS_SIGN] * budget, spring, damper, row[WAVE_IMPEDANCE], period, end
        )
        end[SENT_SIGNAL] += period * wave
        end[SENT_SIGNAL + 1] += period * wave * wave
    else:
        budget = row[AXIS_SIGN] * budget
        pull = step_passivity_slave(speed, total, budget, spring, damper, _MIN_POWER, period, end)
        end[SENT_SIGNAL], end[SENT_SIGNAL + 1] = pull, end[ENERGY_IN]
    push = pull
    if np.isfinite(force):
        push += row[FORCE_RATIO] * min(row[MAX_FORCE], max(-row[MAX_FORCE], force))
    return gain * (speed + period * push / mass)


@compiled
def check_following_error(parameters, joint, s):
    """Set the flag that closes the valves permanently if a joint is too far from its reference.

    The limit is the maximum following error of `parameters`.

    Args:
        parameters: SlaveParameters.
        joint: (k,) measured joint angles [rad]; a value that is not finite also closes the valves.
        s: SlaveState; the flag VALVES_CLOSED in `flags` is set, never reset.

    Returns:
        Nothing.

    Source: following-error monitor, common in servo drives.
    """
    for i in range(len(joint)):
        if not abs(joint[i] - s.joint[i]) <= parameters.limits[MAX_FOLLOWING_ERROR]:
            s.flags[VALVES_CLOSED] = 1.0


@compiled
def write_machine_packet(parameters, force, s, packet):
    """Write the packet from the machine to the master: tip force, positions and speeds.

    Positions are relative to the start. The rows are tip force, measured position and speed of the tip,
    and its reference position and speed. With four channels the reference is sent in place of the
    measured motion. With wave variables or passivity control the returned signal (sum of waves or force)
    and its energy are sent in place of the reference.

    Args:
        parameters: SlaveParameters.
        force: (k,) tip force in task coordinates [N], [N m].
        s: SlaveState.
        packet: (8, k) written, except for the last three rows, the task impedance.

    Returns:
        Nothing.

    Source: rows TIP_FORCE to REFERENCE_SPEED of `teleop.master`.
    """
    for c in range(len(force)):
        packet[TIP_FORCE, c] = force[c]
        packet[TIP_POSITION, c] = s.measured[0, c] - parameters.start[c]
        packet[TIP_SPEED, c] = s.measured[1, c]
        packet[REFERENCE_POSITION, c] = s.pose[c] - parameters.start[c]
        packet[REFERENCE_SPEED, c] = s.rate[c]
    if parameters.kind[0] == WAVE_VARIABLES or parameters.kind[0] == PASSIVITY_CONTROL:
        for c in range(len(force)):
            packet[CHANNEL_SIGNAL, c], packet[CHANNEL_ENERGY, c] = (
                s.line[c, SENT_SIGNAL],
                s.line[c, SENT_SIGNAL + 1],
            )
    if parameters.kind[0] == FOUR_CHANNEL:
        for c in range(len(force)):
            packet[TIP_POSITION, c], packet[TIP_SPEED, c] = (
                packet[REFERENCE_POSITION, c],
                packet[REFERENCE_SPEED, c],
            )


@compiled
def step_slave(parameters, packet, arrived, force, joint, period, s):
    """Run one control period of the slave side: joint references and following-error check.

    Args:
        parameters: SlaveParameters.
        packet: (3, 6) displacement of the handle [m], [rad], its rate, and the hand's force [N], [N m].
        arrived: whether a packet arrived in this period, scalar.
        force: (k,) force of the environment on the tip, task coordinates [N], [N m].
        joint: (k,) measured joint angles [rad].
        period: control period, scalar [s].
        s: SlaveState, written.

    Returns:
        Nothing.

    Source: `update_joint_references` and `check_following_error` in turn.
    """
    update_joint_references(parameters, packet, arrived, force, joint, period, s)
    check_following_error(parameters, joint, s)
