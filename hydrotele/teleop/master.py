"""Control of the master, the levitated joystick: measure it, reflect forces, drive its coils.

The coils give every joystick axis a spring and damper to its centre, about the handle (remote
centre of compliance). Stiffness or force follows the data from the machine. One compiled function
implements all structures of force reflection at 200 Hz.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.contiguous_state import copy_to_contiguous_state, make_contiguous_state, split_array
from hydrotele.machine.joystick import Joystick
from hydrotele.scenario.teleoperation import TeleopPilot
from hydrotele.teleop.axis_table import (
    AXIS_WAVE_IMPEDANCE,
    COLUMNS,
    COORDINATE,
    COUPLING,
    COUPLING_DAMPING,
    DAMPING,
    DEADBAND,
    DETENT_DROP,
    DETENT_STIFFNESS,
    FORCE_LIMIT,
    GAIN,
    HANDLE_RANGE,
    MAX_REFLECTED_FORCE,
    MAX_STIFFNESS,
    MIN_STIFFNESS,
    NOMINAL_STIFFNESS,
    REFLECTION_RATIO,
    SIGN,
    STIFFNESS_PER_FORCE,
    build_axis_table,
)
from hydrotele.teleop.coils import make_three_station_coils
from hydrotele.teleop.compliance import (
    GRAVITY,
    free_flotor_wrench,
    held_flotor_wrench,
    quaternion_to_matrix,
)
from hydrotele.teleop.passive_channel import (
    END_SIZE,
    ENERGY_IN,
    step_passivity_master,
    step_wave_master,
)

(
    NONE,
    STIFFNESS,
    DIRECT_FORCE,
    COORDINATING,
    FOUR_CHANNEL,
    IMPEDANCE,
    WAVE_VARIABLES,
    PASSIVITY_CONTROL,
) = range(8)
REFLECTION_KINDS = (
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance",
    "wave_variables", "passivity_control",
)  # fmt: skip
RATE, POSITION = range(2)
# rows of `Packet`
(
    TIP_FORCE,
    TIP_POSITION,
    TIP_SPEED,
    REFERENCE_POSITION,
    REFERENCE_SPEED,
    TASK_STIFFNESS,
    TASK_DAMPING,
    TASK_MASS,
) = range(8)
# rows for a passive channel: sum of waves or force of the slave's controller, and its energy
CHANNEL_SIGNAL, CHANNEL_ENERGY = REFERENCE_POSITION, REFERENCE_SPEED
_OBSERVER_BANDWIDTH = 60.0  # rad/s, bandwidth of the hand force observer, stable at 200 Hz
_DERIVATIVE_BANDWIDTH = 20.0  # rad/s, bandwidth of the derivative of a force or speed
_MAX_ADDED_MASS_RATIO = 0.5  # maximum added apparent mass over the flotor's mass, because of the lag of _CHANGE
SENT_SIGNAL = END_SIZE  # index in a row of `MasterState.line`: data of the next packet, then its energy
MAX_WINDUP = 0.1  # m or rad at the machine, limit of the integral of the rate command


class MasterParameters(NamedTuple):
    """Parameters of the master's control.

    Attributes:
        axis: (6, 18) parameters of every joystick axis, columns as in `axis_table`; SI. GAIN is the
            coordinate's rate per displacement beyond the dead band [1/s], or its position per
            displacement.
        mass: (1,) mass of the flotor [kg].
        inertia: (3,) moments of inertia about the handle [kg m^2].
        centre_of_mass: (3,) centre of mass in the coils' frame [m].
        handle: (3,) the handle's point in the coils' frame [m].
        gravity: (3,) [m/s^2].
        to_currents: (6, 6) inverse of the coils' map [A/N], [A/(N m)].
        max_current: (1,) maximum current [A].
        resolution: (6,) resolution of the sensing [m], [rad].
        kind: (4,) structure of force reflection (NONE .. PASSIVITY_CONTROL), mode (RATE or POSITION),
            whether the coordinating force uses the handle's position, and whether the axes are
            decoupled.
    """

    axis: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    centre_of_mass: np.ndarray
    handle: np.ndarray
    gravity: np.ndarray
    to_currents: np.ndarray
    max_current: np.ndarray
    resolution: np.ndarray
    kind: np.ndarray


class MasterState(NamedTuple):
    """State of the master's control, updated every period.

    Attributes:
        handle: (6,) measured displacement of the handle [m] and its rotation vector [rad].
        speed: (6,) rate of `handle` [m/s], [rad/s].
        push: (6,) force of the coils on the handle, without the flotor's weight [N], [N m].
        stiffness: (6,) stiffness of every axis [N/m], [N m/rad].
        hand: (6,) estimated force of the hand [N], [N m].
        momentum: (6,) momentum of the hand force observer [N s], [N m s].
        integral: (6,) integral of the rate command, for four channels under rate control [m],
            [rad].
        before: (6,) low-pass filtered force from the machine, for its derivative [N], [N m]; or
            low-pass filtered speed of the handle when a task's mass is displayed [m/s], [rad/s].
        currents: (6,) [A].
        extra: (6,) additional force on the handle, such as tip-over protection [N], [N m].
        limited: (1,) factor by which the currents were scaled down; 1 if not, 0 if they are off
            because the reading is not finite.
        energy: (2,) energy that the hand has supplied to the handle since the start [J]: present
            value, and minimum so far.
        line: (6, 10) master's end of a passive channel for every handle axis: 8 elements as in
            `teleop.passive_channel`, then the signal and the energy for the next packet.
    """

    handle: np.ndarray
    speed: np.ndarray
    push: np.ndarray
    stiffness: np.ndarray
    hand: np.ndarray
    momentum: np.ndarray
    integral: np.ndarray
    before: np.ndarray
    currents: np.ndarray
    extra: np.ndarray
    limited: np.ndarray
    energy: np.ndarray
    line: np.ndarray


def build_master(
    joystick: Joystick, pilot: TeleopPilot, coordinates: tuple[str, ...]
) -> tuple[MasterParameters, MasterState]:
    """Build parameters and initial state of the master's control.

    Args:
        joystick: the joystick.
        pilot: teleoperation settings of the scenario.
        coordinates: task coordinates of the arm.

    Returns:
        The parameters, and a state with the handle at its centre.

    Raises:
        InputError: inconsistent gains, a coordinate that the arm does not have, or one joystick
            axis for two coordinates.
    """
    f, coils = joystick.flotor, joystick.coils
    com, handle, inertia = np.array(f.com), np.array(f.handle), np.diag(f.inertia)
    arm = com - handle
    turning = np.diag(inertia) + f.mass * (arm @ arm - arm**2)
    lorentz = make_three_station_coils(coils.radius, coils.force_per_ampere, coils.max_current)
    numbers = MasterParameters(
        axis=build_axis_table(joystick, pilot, coordinates),
        mass=np.array([f.mass]),
        inertia=turning,
        centre_of_mass=com,
        handle=handle,
        gravity=np.array(GRAVITY),
        to_currents=np.linalg.inv(lorentz.wrench_map),
        max_current=np.array([coils.max_current]),
        resolution=np.array([joystick.sensing.translation] * 3 + [joystick.sensing.rotation] * 3),
        kind=np.array([
            REFLECTION_KINDS.index(pilot.reflection), RATE if pilot.mode == "rate" else POSITION,
            pilot.coordinating_position == "handle", pilot.compliance == "decoupled",
        ]),
    )  # fmt: skip
    state = make_contiguous_state(MasterState, [(6,)] * 10 + [(1,), (2,), (6, SENT_SIGNAL + 2)])
    state.limited[:] = 1.0
    return copy_to_contiguous_state(numbers), state


@compiled
def unpack_master_parameters(flat):
    """Return the fields of MasterParameters as views of a flat array.

    Args:
        flat: (168,) array, as from `flat_view` of a MasterParameters.

    Returns:
        MasterParameters.

    Source: order and shapes of MasterParameters.
    """
    axis, rest = split_array(flat, 6 * COLUMNS)
    mass, rest = split_array(rest, 1)
    turning, rest = split_array(rest, 3)
    below, rest = split_array(rest, 3)
    handle, rest = split_array(rest, 3)
    gravity, rest = split_array(rest, 3)
    to_currents, rest = split_array(rest, 36)
    most, rest = split_array(rest, 1)
    step, kind = split_array(rest, 6)
    return MasterParameters(
        axis.reshape(6, COLUMNS), mass, turning, below, handle, gravity, to_currents.reshape(6, 6),
        most, step, kind,
    )  # fmt: skip


@compiled
def unpack_master_state(flat):
    """Return the fields of MasterState as views of a flat array.

    Args:
        flat: (123,) array, as from `flat_view` of a MasterState.

    Returns:
        MasterState.

    Source: order and shapes of MasterState.
    """
    handle, rest = split_array(flat, 6)
    speed, rest = split_array(rest, 6)
    push, rest = split_array(rest, 6)
    stiffness, rest = split_array(rest, 6)
    hand, rest = split_array(rest, 6)
    momentum, rest = split_array(rest, 6)
    integral, rest = split_array(rest, 6)
    before, rest = split_array(rest, 6)
    currents, rest = split_array(rest, 6)
    extra, rest = split_array(rest, 6)
    limited, rest = split_array(rest, 1)
    energy, line = split_array(rest, 2)
    return MasterState(
        handle, speed, push, stiffness, hand, momentum, integral, before, currents, extra, limited,
        energy, line.reshape(6, SENT_SIGNAL + 2),
    )  # fmt: skip


@compiled
def measure_handle(parameters, qpos, period, s):
    """Measure the handle's displacement, its rate, and the energy that the hand has supplied.

    The displacement is rounded to the sensing resolution. The rate is the difference of two
    successive displacements over the period. The energy follows from the change of kinetic energy
    and the work of the coils, and not from the estimated hand force, which lags.

    Args:
        parameters: MasterParameters.
        qpos: (7,) flotor position [m] and quaternion, scalar first.
        period: time since the last reading, scalar [s]; 0 for the first one.
        s: MasterState; `handle`, `speed` and `energy` are written.

    Returns:
        Nothing.

    Source: Zhu 1994, chapter 5 (optical sensing).
    """
    w = qpos[3]
    size = np.sqrt(qpos[4] ** 2 + qpos[5] ** 2 + qpos[6] ** 2)
    factor = 2.0 if w >= 0.0 else -2.0
    if size > 1e-9:
        factor = factor * np.arctan2(size, abs(w)) / size
    for i in range(6):
        value = qpos[i] if i < 3 else factor * qpos[i + 1]
        if parameters.resolution[i] > 0.0:
            value = np.rint(value / parameters.resolution[i]) * parameters.resolution[i]
        speed = (value - s.handle[i]) / period if period > 0.0 else 0.0
        if period > 0.0:
            own = parameters.mass[0] if i < 3 else parameters.inertia[i - 3]
            gained = 0.5 * own * (speed**2 - s.speed[i] ** 2)
            s.energy[0] += gained - _force_without_hand(parameters, s, i) * (value - s.handle[i])
        s.speed[i], s.handle[i] = speed, value
    s.energy[1] = min(s.energy[1], s.energy[0])


@compiled
def _force_without_hand(numbers, s, i):
    """Return the force on handle axis i since the last reading, without that of the hand [N], [N m].

    It is the force of the coils plus the part of the weight that limited currents do not carry.
    """
    given = s.limited[0] * s.push[i]
    if i < 3:  # part of the flotor's weight that the limited currents do not carry
        given += (1.0 - s.limited[0]) * numbers.mass[0] * numbers.gravity[i]
    return given


@compiled
def compute_reflected_forces(parameters, packet, packet_gain, period, s):
    """Compute the coils' force on every axis of the handle, which reflects the machine's force.

    It consists of spring, damper and detent of the joystick, and of the selected structure of force
    reflection.

    Args:
        parameters: MasterParameters.
        packet: (8, k) data from the machine in task units: tip force, position and speed of the tip
            and of its reference, stiffness, damping and mass of the task.
        packet_gain: factor on the packet, scalar: 1, falling to 0 while the channel is silent.
        period: control period, scalar [s].
        s: MasterState. The results are `push`, the force of the coils on every axis, and `stiffness`, that
            of its spring. The states of filters and channel ends are updated.

    Returns:
        Nothing.

    Source: Zhu 1994, 3.52-3.53, 3.59-3.62, 3.75, 4.1, Fig. 6.51; `teleop.passive_channel`.
    """
    kind, mode = parameters.kind[0], parameters.kind[1]
    for i in range(6):
        row, x, v = parameters.axis[i], s.handle[i], s.speed[i]
        c, sign, gain = int(row[COORDINATE]), row[SIGN], row[GAIN]
        stiff, rub, push = row[NOMINAL_STIFFNESS], row[DAMPING], 0.0
        way = 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)
        if c >= 0 and kind != NONE:
            force = packet_gain * sign * packet[TIP_FORCE, c]
            if not np.isfinite(force):
                force = 0.0
            kept = min(row[MAX_REFLECTED_FORCE], max(-row[MAX_REFLECTED_FORCE], force))
            if mode == POSITION and kind != STIFFNESS and kind != IMPEDANCE:
                stiff = 0.0  # the spring's rest position is the slave's position
            if kind == STIFFNESS:
                kept = min(row[FORCE_LIMIT], max(-row[FORCE_LIMIT], force))
                stiff = min(
                    row[MAX_STIFFNESS],
                    max(row[MIN_STIFFNESS], stiff - row[STIFFNESS_PER_FORCE] * kept * way),
                )
            elif kind == DIRECT_FORCE:
                push += row[REFLECTION_RATIO] * kept
            elif kind == COORDINATING and parameters.kind[2] > 0.0:
                push -= packet_gain * _coordinating_force(row, mode, packet, period, s, i)
            elif kind == COORDINATING:
                share = sign / gain if mode == POSITION else sign
                behind = share * (packet[REFERENCE_POSITION, c] - packet[TIP_POSITION, c])
                slower = share * (packet[REFERENCE_SPEED, c] - packet[TIP_SPEED, c])
                push -= packet_gain * (row[COUPLING] * behind + row[COUPLING_DAMPING] * slower)
            elif kind == FOUR_CHANNEL:
                push += _four_channel_force(row, mode, kept, packet, packet_gain, period, s, i)
            elif kind == IMPEDANCE:
                felt = packet_gain * row[REFLECTION_RATIO] * gain
                stiff = min(
                    row[MAX_STIFFNESS],
                    max(row[MIN_STIFFNESS], stiff + felt * packet[TASK_STIFFNESS, c]),
                )
                rub += min(rub, felt * packet[TASK_DAMPING, c])  # limited: sampling
                own = parameters.mass[0] if i < 3 else parameters.inertia[i - 3]
                change = _DERIVATIVE_BANDWIDTH * (v - s.before[i])
                s.before[i] += period * change
                heavier = felt * packet[TASK_MASS, c]
                if heavier > 0.0:  # false for NaN
                    push -= min(_MAX_ADDED_MASS_RATIO * own, heavier) * change
            elif kind == WAVE_VARIABLES or kind == PASSIVITY_CONTROL:
                push -= packet_gain * _passive_channel_force(parameters, row, packet, period, s, i)
        s.stiffness[i] = stiff
        beyond = abs(x) - row[DEADBAND]
        if row[DETENT_STIFFNESS] >= 0.0 and beyond > 0.0:
            stiff_out = row[DETENT_STIFFNESS] + max(stiff - row[NOMINAL_STIFFNESS], 0.0)
            push -= way * (max(stiff * row[DEADBAND] - row[DETENT_DROP], 0.0) + stiff_out * beyond)
        else:
            push -= stiff * x
        total = push - rub * v + packet_gain * s.extra[i]
        s.push[i] = (
            total if np.isfinite(total) else -row[NOMINAL_STIFFNESS] * x - row[DAMPING] * v
        )  # fallback: spring and damper only


@compiled
def _coordinating_force(row, mode, packet, period, s, i):
    """Return the coordinating force of handle axis i, a spring-damper to the machine [N], [N m].

    They act on the motion that the handle commands minus the measured motion of the tip. The force
    is positive against the handle's positive direction; the caller subtracts it.
    """
    gain, x, v, c, sign = row[GAIN], s.handle[i], s.speed[i], int(row[COORDINATE]), row[SIGN]
    place, speed = sign * packet[TIP_POSITION, c], sign * packet[TIP_SPEED, c]
    if mode == POSITION:
        return row[COUPLING] * (x - place / gain) + row[COUPLING_DAMPING] * (v - speed / gain)
    beyond = max(0.0, min(row[HANDLE_RANGE], abs(x)) - row[DEADBAND])
    rate = gain * beyond if x > 0.0 else -gain * beyond
    asked = s.integral[i] + period * rate
    s.integral[i] = min(place + MAX_WINDUP, max(place - MAX_WINDUP, asked))
    return row[COUPLING] * (s.integral[i] - place) + row[COUPLING_DAMPING] * (rate - speed)


@compiled
def _passive_channel_force(numbers, row, packet, period, s, i):
    """Return the force of a passive channel against the motion of handle axis i [N], [N m].

    A passive channel uses wave variables or passivity control. The content of the next packet is
    written to the state: time integral of the waves or handle position, and the energy sent so far.
    """
    c, sign, v, end = int(row[COORDINATE]), row[SIGN], s.speed[i], s.line[i]
    total, budget = sign * packet[CHANNEL_SIGNAL, c], packet[CHANNEL_ENERGY, c]
    if numbers.kind[0] == WAVE_VARIABLES:
        pushed, wave = step_wave_master(v, total, budget, row[AXIS_WAVE_IMPEDANCE], period, end)
        end[SENT_SIGNAL] += period * wave
        end[SENT_SIGNAL + 1] += period * wave * wave
        return pushed
    own = numbers.mass[0] if i < 3 else numbers.inertia[i - 3]
    pushed = step_passivity_master(v, total, budget, own, period, end)
    end[SENT_SIGNAL], end[SENT_SIGNAL + 1] = s.handle[i], end[ENERGY_IN]
    return pushed


@compiled
def _four_channel_force(row, mode, force, packet, fresh, period, s, i):
    """Return the force on handle axis i with four channels: reflected force and motion coupling.

    The reflected force is the contact force times the reflection ratio. Under rate control it is
    the derivative of this product divided by the rate gain, so that a constant force is not felt;
    the derivative has a bandwidth of 20 rad/s. The coupling is a spring and damper between the
    motion that the handle commands and that of the machine.
    """
    gain, spring, damper = row[GAIN], row[COUPLING], row[COUPLING_DAMPING]
    x, v, c, sign = s.handle[i], s.speed[i], int(row[COORDINATE]), row[SIGN]
    place, speed = sign * packet[TIP_POSITION, c], sign * packet[TIP_SPEED, c]
    reflected = row[REFLECTION_RATIO] * force
    if mode == POSITION:
        return reflected - fresh * (spring * (x - place / gain) + damper * (v - speed / gain))
    asked = s.integral[i] + period * gain * x
    s.integral[i] = min(place + MAX_WINDUP, max(place - MAX_WINDUP, asked))
    change = _DERIVATIVE_BANDWIDTH * (reflected - s.before[i])
    s.before[i] += period * change
    apart = spring * (s.integral[i] - place) + damper * (gain * x - speed)
    return change / gain - fresh * apart


@compiled
def _decoupled_wrench(numbers, turn, s, wrench):
    """Compute the coil wrench with which every handle axis moves as an independent mass.

    The force of each axis in `s.push` accelerates only this axis. `turn` is the rotation matrix,
    flotor to world. The wrench (6,) [N], [N m] is written to `wrench`.
    """
    mass, arm = numbers.mass[0], numbers.centre_of_mass - numbers.handle
    inertia, wanted, about = np.zeros((3, 3)), np.empty(3), np.empty(3)
    square = arm[0] ** 2 + arm[1] ** 2 + arm[2] ** 2
    for j in range(3):
        inertia[j, j] = numbers.inertia[j] - mass * (square - arm[j] ** 2)
        wanted[j], about[j] = s.push[j] / mass, s.push[3 + j] / numbers.inertia[j]
    free_flotor_wrench(
        mass, arm, inertia, numbers.centre_of_mass, wanted, about, turn, s.speed[3:], numbers.gravity, wrench
    )


@compiled
def drive_coils(parameters, quaternion, period, s):
    """Compute the coil currents of this period, and estimate the hand force.

    The currents produce the force `push` on the handle and carry the flotor's weight. If a current
    exceeds its limit, the whole wrench is scaled down and keeps its direction.

    Args:
        parameters: MasterParameters.
        quaternion: (4,) orientation of the flotor, scalar first.
        period: control period, scalar [s].
        s: MasterState. The results are `currents`, `limited` (factor by which they were scaled down) and
            `hand`, the estimated hand force; `momentum` is the state of its observer.

    Returns:
        Nothing.

    Source: Zhu 1994, 5.1.3; momentum observer after De Luca and Mattone 2005.
    """
    turn, wrench = np.empty((3, 3)), np.empty(6)
    quaternion_to_matrix(quaternion, turn)
    if parameters.kind[3] > 0.0:
        _decoupled_wrench(parameters, turn, s, wrench)
    else:
        held_flotor_wrench(
            parameters.mass[0], parameters.centre_of_mass, parameters.handle, s.push, turn, parameters.gravity, wrench
        )
    largest = parameters.max_current[0]
    for i in range(6):
        s.currents[i] = 0.0
        for j in range(6):
            s.currents[i] += parameters.to_currents[i, j] * wrench[j]
        if not np.isfinite(s.currents[i]):
            s.currents[i] = 0.0
        largest = max(largest, abs(s.currents[i]))
    s.limited[0] = parameters.max_current[0] / largest
    for i in range(6):
        s.currents[i] *= s.limited[0]
        own = parameters.mass[0] if i < 3 else parameters.inertia[i - 3]
        s.hand[i] = _OBSERVER_BANDWIDTH * (own * s.speed[i] - s.momentum[i])
        s.momentum[i] += period * (_force_without_hand(parameters, s, i) + s.hand[i])


@compiled
def _reset_master(s):
    """Set currents, handle motion, forces and the factor `limited` to 0 after an invalid reading.

    The next valid reading starts from rest.
    """
    for i in range(6):
        s.handle[i], s.speed[i], s.push[i] = 0.0, 0.0, 0.0
        s.hand[i], s.momentum[i], s.currents[i] = 0.0, 0.0, 0.0
    s.limited[0] = 0.0


@compiled
def step_master(parameters, qpos, packet, packet_gain, period, first, s):
    """Run one control period of the master: measure the handle, reflect forces, drive the coils.

    A reading that is not finite switches the coils off; handle displacement and forces become 0.

    Args:
        parameters: MasterParameters.
        qpos: (7,) flotor position [m] and quaternion, scalar first.
        packet: (8, k) data from the machine, rows as in `compute_reflected_forces`.
        packet_gain: factor on the packet, scalar, 0 to 1.
        period: control period, scalar [s].
        first: whether this is the first period, scalar.
        s: MasterState, written.

    Returns:
        Nothing.

    Source: `measure_handle`, `compute_reflected_forces` and `drive_coils` in turn.
    """
    if not np.isfinite(qpos).all():
        _reset_master(s)
        return
    measure_handle(parameters, qpos, 0.0 if first or s.limited[0] == 0.0 else period, s)
    compute_reflected_forces(parameters, packet, packet_gain, period, s)
    drive_coils(parameters, qpos[3:7], period, s)
