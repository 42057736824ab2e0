"""Control of the master: measure the joystick, reflect the machine's force, drive the coils.

The coils give every joystick axis a spring and damper to its centre, about the handle (remote
centre of compliance). Stiffness or force follows the data from the machine. One kernel implements
all structures at 200 Hz. A protection function pushes the handle back before the machine tips
over.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.machine.joystick import Joystick
from hydrotele.scenario.teleoperation import TeleopPilot, TipOver
from hydrotele.teleop.axis_table import (
    COLUMNS,
    COORDINATE,
    COUPLING,
    COUPLING_DAMPING,
    DAMPING,
    DEADBAND,
    DROP,
    GAIN,
    LEAST,
    LIMIT,
    MOST,
    NOMINAL,
    OUTSIDE,
    RATIO,
    REACH,
    REFLECTED_MOST,
    SIGN,
    SLOPE,
    WAVE,
    axis_table,
    flat_state,
    flattened,
    split,
)
from hydrotele.teleop.coils import three_stations
from hydrotele.teleop.compliance import GRAVITY, driving_wrench, holding_wrench, turn_matrix
from hydrotele.teleop.passive_line import END, GONE_IN, controlled_master, wave_master

NONE, STIFFNESS, DIRECT, COORDINATING, FOUR_CHANNEL, IMPEDANCE, WAVES, CONTROLLED = range(8)
KINDS = (
    "none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance",
    "wave_variables", "passivity_control",
)  # fmt: skip
RATE, POSITION = range(2)
# rows of `Packet`
FORCE, PLACE, SPEED, WANTED, WANTED_SPEED, TASK_STIFFNESS, TASK_DAMPING, TASK_MASS = range(8)
# rows for a passive channel: sum of waves or force of the slave's controller, and its energy
TOTAL, BUDGET = WANTED, WANTED_SPEED
_OBSERVER = 60.0  # rad/s, bandwidth of the hand force observer, stable at 200 Hz
_CHANGE = 20.0  # rad/s, bandwidth of the derivative of a force or speed
_HEAVIER = 0.5  # maximum added apparent mass over the flotor's mass, because of the lag of _CHANGE
SENT = END  # index in a row of `MasterState.line`: data of the next packet, then its energy
WINDUP = 0.1  # m or rad at the machine, limit of the integral of the rate command


class Master(NamedTuple):
    """Parameters of the master's control.

    Attributes:
        axis: (6, 18) parameters of every joystick axis, columns above; SI. GAIN is the coordinate's
            rate per displacement beyond the dead band [1/s], or its position per displacement.
        mass: (1,) mass of the flotor [kg].
        turning: (3,) moments of inertia about the handle [kg m^2].
        below: (3,) centre of mass in the coils' frame [m].
        handle: (3,) the handle's point in the coils' frame [m].
        gravity: (3,) [m/s^2].
        to_currents: (6, 6) inverse of the coils' map [A/N], [A/(N m)].
        most: (1,) maximum current [A].
        step: (6,) resolution of the sensing [m], [rad].
        kind: (4,) structure, mode, whether the coordinating force uses the handle's position, and
            whether the axes are decoupled.
    """

    axis: np.ndarray
    mass: np.ndarray
    turning: np.ndarray
    below: np.ndarray
    handle: np.ndarray
    gravity: np.ndarray
    to_currents: np.ndarray
    most: np.ndarray
    step: np.ndarray
    kind: np.ndarray


class MasterState(NamedTuple):
    """State of the master's control, updated every period.

    Attributes:
        handle: (6,) measured displacement [m] and rotation vector [rad].
        speed: (6,) its rate.
        push: (6,) force of the coils on the handle [N], [N m].
        stiffness: (6,) stiffness of every axis [N/m], [N m/rad].
        hand: (6,) estimated force of the hand [N], [N m].
        momentum: (6,) momentum of the observer.
        integral: (6,) integral of the rate command, for four channels under rate control [m],
            [rad].
        before: (6,) low-pass filtered force from the machine, for its derivative [N], [N m]; or
            low-pass filtered speed of the handle when a task's mass is displayed [m/s], [rad/s].
        currents: (6,) [A].
        extra: (6,) additional force on the handle, such as tip-over protection [N], [N m].
        limited: (1,) factor by which the currents were scaled down; 1 if not, 0 if they are off
            because the reading is not finite.
        energy: (2,) energy from the hand into the handle [J]: present value, and minimum so far.
        line: (6, 10) end of a passive channel: `passive_line`, and TOTAL, BUDGET to send.
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


def master(
    joystick: Joystick, pilot: TeleopPilot, coordinates: tuple[str, ...]
) -> tuple[Master, MasterState]:
    """Build parameters and initial state of the master's control.

    Args:
        joystick: the joystick.
        pilot: teleoperation settings of the scenario.
        coordinates: task coordinates of the arm.

    Returns:
        The parameters, and a state at the centre.

    Raises:
        InputError: inconsistent gains, a coordinate that the arm does not have, or one joystick
            axis for two coordinates.
    """
    f, coils = joystick.flotor, joystick.coils
    com, handle, inertia = np.array(f.com), np.array(f.handle), np.diag(f.inertia)
    arm = com - handle
    turning = np.diag(inertia) + f.mass * (arm @ arm - arm**2)
    lorentz = three_stations(coils.radius, coils.force_per_ampere, coils.max_current)
    numbers = Master(
        axis=axis_table(joystick, pilot, coordinates),
        mass=np.array([f.mass]),
        turning=turning,
        below=com,
        handle=handle,
        gravity=np.array(GRAVITY),
        to_currents=np.linalg.inv(lorentz.wrench_map),
        most=np.array([coils.max_current]),
        step=np.array([joystick.sensing.translation] * 3 + [joystick.sensing.rotation] * 3),
        kind=np.array([
            KINDS.index(pilot.reflection), RATE if pilot.mode == "rate" else POSITION,
            pilot.coordinating == "handle", pilot.compliance == "decoupled",
        ]),
    )  # fmt: skip
    state = flat_state(MasterState, [(6,)] * 10 + [(1,), (2,), (6, SENT + 2)])
    state.limited[:] = 1.0
    return flattened(numbers), state


@compiled
def unpack_master(flat):
    """Return the parts of `flat_view(Master)`.

    Args:
        flat: (168,) array.

    Returns:
        Master, views of it.

    Source: order and shapes of Master.
    """
    axis, rest = split(flat, 6 * COLUMNS)
    mass, rest = split(rest, 1)
    turning, rest = split(rest, 3)
    below, rest = split(rest, 3)
    handle, rest = split(rest, 3)
    gravity, rest = split(rest, 3)
    to_currents, rest = split(rest, 36)
    most, rest = split(rest, 1)
    step, kind = split(rest, 6)
    return Master(
        axis.reshape(6, COLUMNS), mass, turning, below, handle, gravity, to_currents.reshape(6, 6),
        most, step, kind,
    )  # fmt: skip


@compiled
def unpack_master_state(flat):
    """Return the parts of `flat_view(MasterState)`.

    Args:
        flat: (123,) array.

    Returns:
        MasterState, views of it.

    Source: order and shapes of MasterState.
    """
    handle, rest = split(flat, 6)
    speed, rest = split(rest, 6)
    push, rest = split(rest, 6)
    stiffness, rest = split(rest, 6)
    hand, rest = split(rest, 6)
    momentum, rest = split(rest, 6)
    integral, rest = split(rest, 6)
    before, rest = split(rest, 6)
    currents, rest = split(rest, 6)
    extra, rest = split(rest, 6)
    limited, rest = split(rest, 1)
    energy, line = split(rest, 2)
    return MasterState(
        handle, speed, push, stiffness, hand, momentum, integral, before, currents, extra, limited,
        energy, line.reshape(6, SENT + 2),
    )  # fmt: skip


@compiled
def read_handle(numbers, qpos, period, s):
    """Measure the handle with the sensing resolution, its rate by differences, and its energy.

    The energy from the hand follows from the kinetic energy and the work of the coils, without the
    lag of the estimated hand force.

    Args:
        numbers: Master.
        qpos: (7,) flotor position [m] and quaternion.
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
        if numbers.step[i] > 0.0:
            value = np.rint(value / numbers.step[i]) * numbers.step[i]
        speed = (value - s.handle[i]) / period if period > 0.0 else 0.0
        if period > 0.0:
            own = numbers.mass[0] if i < 3 else numbers.turning[i - 3]
            gained = 0.5 * own * (speed**2 - s.speed[i] ** 2)
            s.energy[0] += gained - _given(numbers, s, i) * (value - s.handle[i])
        s.speed[i], s.handle[i] = speed, value
    s.energy[1] = min(s.energy[1], s.energy[0])


@compiled
def _given(numbers, s, i):
    """Return the force of coils and weight on a handle axis since the last reading."""
    given = s.limited[0] * s.push[i]
    if i < 3:  # part of the flotor's weight that the limited currents do not carry
        given += (1.0 - s.limited[0]) * numbers.mass[0] * numbers.gravity[i]
    return given


@compiled
def reflect(numbers, packet, fresh, period, s):
    """Compute the force on every axis of the handle with the selected structure.

    Args:
        numbers: Master.
        packet: (8, k) data from the machine in task units: tip force, position and speed of the tip
            and of its reference, stiffness, damping and mass of the task.
        fresh: factor on the packet, scalar: 1, falling to 0 while the channel is silent.
        period: scalar [s].
        s: MasterState; `push`, `stiffness`, `integral`, `before` and `line` are written.

    Returns:
        Nothing.

    Source: Zhu 1994, 3.52-3.53, 3.59-3.62, 3.75, 4.1, Fig. 6.51; `teleop.passive_line`.
    """
    kind, mode = numbers.kind[0], numbers.kind[1]
    for i in range(6):
        row, x, v = numbers.axis[i], s.handle[i], s.speed[i]
        c, sign, gain = int(row[COORDINATE]), row[SIGN], row[GAIN]
        stiff, rub, push = row[NOMINAL], row[DAMPING], 0.0
        way = 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)
        if c >= 0 and kind != NONE:
            force = fresh * sign * packet[FORCE, c]
            if not np.isfinite(force):
                force = 0.0
            kept = min(row[REFLECTED_MOST], max(-row[REFLECTED_MOST], force))
            if mode == POSITION and kind != STIFFNESS and kind != IMPEDANCE:
                stiff = 0.0  # the spring's rest position is the slave's position
            if kind == STIFFNESS:
                kept = min(row[LIMIT], max(-row[LIMIT], force))
                stiff = min(row[MOST], max(row[LEAST], stiff - row[SLOPE] * kept * way))
            elif kind == DIRECT:
                push += row[RATIO] * kept
            elif kind == COORDINATING and numbers.kind[2] > 0.0:
                push -= fresh * _coordinating(row, mode, packet, period, s, i)
            elif kind == COORDINATING:
                share = sign / gain if mode == POSITION else sign
                behind = share * (packet[WANTED, c] - packet[PLACE, c])
                slower = share * (packet[WANTED_SPEED, c] - packet[SPEED, c])
                push -= fresh * (row[COUPLING] * behind + row[COUPLING_DAMPING] * slower)
            elif kind == FOUR_CHANNEL:
                push += _four_channels(row, mode, kept, packet, fresh, period, s, i)
            elif kind == IMPEDANCE:
                felt = fresh * row[RATIO] * gain
                stiff = min(row[MOST], max(row[LEAST], stiff + felt * packet[TASK_STIFFNESS, c]))
                rub += min(rub, felt * packet[TASK_DAMPING, c])  # limited: sampling
                own = numbers.mass[0] if i < 3 else numbers.turning[i - 3]
                change = _CHANGE * (v - s.before[i])
                s.before[i] += period * change
                heavier = felt * packet[TASK_MASS, c]
                if heavier > 0.0:  # false for NaN
                    push -= min(_HEAVIER * own, heavier) * change
            elif kind == WAVES or kind == CONTROLLED:
                push -= fresh * _passive_line(numbers, row, packet, period, s, i)
        s.stiffness[i] = stiff
        beyond = abs(x) - row[DEADBAND]
        if row[OUTSIDE] >= 0.0 and beyond > 0.0:
            stiff_out = row[OUTSIDE] + max(stiff - row[NOMINAL], 0.0)
            push -= way * (max(stiff * row[DEADBAND] - row[DROP], 0.0) + stiff_out * beyond)
        else:
            push -= stiff * x
        total = push - rub * v + fresh * s.extra[i]
        s.push[i] = (
            total if np.isfinite(total) else -row[NOMINAL] * x - row[DAMPING] * v
        )  # fallback: spring and damper only


@compiled
def _coordinating(row, mode, packet, period, s, i):
    """Return the spring and damper force between the machine and its command from the handle."""
    gain, x, v, c, sign = row[GAIN], s.handle[i], s.speed[i], int(row[COORDINATE]), row[SIGN]
    place, speed = sign * packet[PLACE, c], sign * packet[SPEED, c]
    if mode == POSITION:
        return row[COUPLING] * (x - place / gain) + row[COUPLING_DAMPING] * (v - speed / gain)
    beyond = max(0.0, min(row[REACH], abs(x)) - row[DEADBAND])
    rate = gain * beyond if x > 0.0 else -gain * beyond
    asked = s.integral[i] + period * rate
    s.integral[i] = min(place + WINDUP, max(place - WINDUP, asked))
    return row[COUPLING] * (s.integral[i] - place) + row[COUPLING_DAMPING] * (rate - speed)


@compiled
def _passive_line(numbers, row, packet, period, s, i):
    """Return the force of a passive channel against the handle; write the next packet's data."""
    c, sign, v, end = int(row[COORDINATE]), row[SIGN], s.speed[i], s.line[i]
    total, budget = sign * packet[TOTAL, c], packet[BUDGET, c]
    if numbers.kind[0] == WAVES:
        pushed, wave = wave_master(v, total, budget, row[WAVE], period, end)
        end[SENT] += period * wave
        end[SENT + 1] += period * wave * wave
        return pushed
    own = numbers.mass[0] if i < 3 else numbers.turning[i - 3]
    pushed = controlled_master(v, total, budget, own, period, end)
    end[SENT], end[SENT + 1] = s.handle[i], end[GONE_IN]
    return pushed


@compiled
def _four_channels(row, mode, force, packet, fresh, period, s, i):
    """Return the reflected force and velocity of the four-channel structures.

    Under rate control `C2 = s / k_v` differentiates the force, below 20 rad/s.
    """
    gain, spring, damper = row[GAIN], row[COUPLING], row[COUPLING_DAMPING]
    x, v, c, sign = s.handle[i], s.speed[i], int(row[COORDINATE]), row[SIGN]
    place, speed = sign * packet[PLACE, c], sign * packet[SPEED, c]
    reflected = row[RATIO] * force
    if mode == POSITION:
        return reflected - fresh * (spring * (x - place / gain) + damper * (v - speed / gain))
    asked = s.integral[i] + period * gain * x
    s.integral[i] = min(place + WINDUP, max(place - WINDUP, asked))
    change = _CHANGE * (reflected - s.before[i])
    s.before[i] += period * change
    apart = spring * (s.integral[i] - place) + damper * (gain * x - speed)
    return change / gain - fresh * apart


@compiled
def _decoupled(numbers, turn, s, wrench):
    """Compute the wrench that makes every axis an independent mass under its force."""
    mass, arm = numbers.mass[0], numbers.below - numbers.handle
    inertia, wanted, about = np.zeros((3, 3)), np.empty(3), np.empty(3)
    square = arm[0] ** 2 + arm[1] ** 2 + arm[2] ** 2
    for j in range(3):
        inertia[j, j] = numbers.turning[j] - mass * (square - arm[j] ** 2)
        wanted[j], about[j] = s.push[j] / mass, s.push[3 + j] / numbers.turning[j]
    driving_wrench(
        mass, arm, inertia, numbers.below, wanted, about, turn, s.speed[3:], numbers.gravity, wrench
    )


@compiled
def drive_coils(numbers, quaternion, period, s):
    """Compute the coil currents for `push` plus the flotor's weight, and estimate the hand force.

    If a current exceeds its limit, the whole wrench is scaled down and keeps its direction.

    Args:
        numbers: Master.
        quaternion: (4,) orientation of the flotor.
        period: scalar [s].
        s: MasterState; `currents`, `limited`, `hand` and `momentum` are written.

    Returns:
        Nothing.

    Source: Zhu 1994, 5.1.3; momentum observer after De Luca and Mattone 2005.
    """
    turn, wrench = np.empty((3, 3)), np.empty(6)
    turn_matrix(quaternion, turn)
    if numbers.kind[3] > 0.0:
        _decoupled(numbers, turn, s, wrench)
    else:
        holding_wrench(
            numbers.mass[0], numbers.below, numbers.handle, s.push, turn, numbers.gravity, wrench
        )
    largest = numbers.most[0]
    for i in range(6):
        s.currents[i] = 0.0
        for j in range(6):
            s.currents[i] += numbers.to_currents[i, j] * wrench[j]
        if not np.isfinite(s.currents[i]):
            s.currents[i] = 0.0
        largest = max(largest, abs(s.currents[i]))
    s.limited[0] = numbers.most[0] / largest
    for i in range(6):
        s.currents[i] *= s.limited[0]
        own = numbers.mass[0] if i < 3 else numbers.turning[i - 3]
        s.hand[i] = _OBSERVER * (own * s.speed[i] - s.momentum[i])
        s.momentum[i] += period * (_given(numbers, s, i) + s.hand[i])


@compiled
def _blind(s):
    """Switch currents and command off; the next valid reading starts from rest."""
    for i in range(6):
        s.handle[i], s.speed[i], s.push[i] = 0.0, 0.0, 0.0
        s.hand[i], s.momentum[i], s.currents[i] = 0.0, 0.0, 0.0
    s.limited[0] = 0.0


@compiled
def master_step(numbers, qpos, packet, fresh, period, first, s):
    """Run one period of the master: read the handle, reflect, drive the coils.

    A reading that is not finite switches the coils off and leaves the machine without a command.

    Args:
        numbers: Master.
        qpos: (7,) flotor position [m] and quaternion.
        packet: (8, k) see `reflect`.
        fresh: see `reflect`, scalar.
        period: scalar [s].
        first: whether this is the first period, scalar.
        s: MasterState, written.

    Returns:
        Nothing.

    Source: this module.
    """
    if not np.isfinite(qpos).all():
        _blind(s)
        return
    read_handle(numbers, qpos, 0.0 if first or s.limited[0] == 0.0 else period, s)
    reflect(numbers, packet, fresh, period, s)
    drive_coils(numbers, qpos[3:7], period, s)


_GRAVITY = 9.81
_FULL = 0.1  # range of the tipping ratio, above the allowed one, over which the spring builds up


def tipping_share(facts: TipOver, radius: float, force: float) -> float:
    """Return the ratio of a vertical tip force's moment to the tipping moment.

    Args:
        facts: tip-over parameters of the machine.
        radius: distance of the tip from the swing axis [m].
        force: force of the environment on the tip, positive up [N].

    Returns:
        1 if the machine tips: backwards about its rear edge if pushed up, forwards about the front
        edge if pulled down.

    >>> machine = TipOver(mass=20000.0, behind=0.4, edge=1.6)
    >>> round(tipping_share(machine, 6.4, 29430.0), 3)
    1.0
    """
    weight = facts.mass * _GRAVITY
    if force > 0.0:
        return force * (radius + facts.edge) / (weight * (facts.edge - facts.behind))
    return -force * max(radius - facts.edge, 0.0) / (weight * (facts.edge + facts.behind))


def push_back(
    facts: TipOver, numbers: Master, packet: np.ndarray, start: np.ndarray, handle: np.ndarray,
    speed: np.ndarray, extra: np.ndarray,
) -> None:  # fmt: skip
    """Compute a force on the handle's vertical axis that keeps the machine from tipping.

    The force is an additional spring to the centre, with the damper that a 200 Hz control needs. It
    acts only in the direction that increases the tipping moment. It brings the handle back into the
    dead band and never commands a motion.

    Args:
        facts: tip-over parameters of the machine.
        numbers: parameters of the master.
        packet: (8, k) data from the machine.
        start: (5,) pose at the start.
        handle: (6,) measured displacement [m], [rad].
        speed: (6,) its rate [m/s], [rad/s].
        extra: (6,) written [N], [N m].

    Source: Zhu 1994, chapter 6 (tip-over of an excavator that presses too hard).
    """
    extra[:] = 0.0
    force, radius = float(packet[FORCE, 2]), float(packet[PLACE, 0] + start[0])
    danger = min(1.0, (tipping_share(facts, radius, force) - facts.share) / _FULL)
    if not danger > 0.0:
        return
    for axis in range(6):
        row = numbers.axis[axis]
        worse = -math.copysign(1.0, force) * row[SIGN]  # this direction increases the tip force
        if row[COORDINATE] == 2.0 and worse * handle[axis] > 0.0:
            push = facts.stiffness * handle[axis] + facts.damping * speed[axis]
            extra[axis] = -danger * push
