"""The master's control: read the joystick, reflect the machine's force, drive the coils.

Every axis of the joystick is a spring and damper to its centre, made by the coils about the handle
(remote centre of compliance), whose stiffness or force follows what comes back from the machine.
One kernel makes all structures, 200 times a second; `teleop.handle` holds the same laws of one axis
for people.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.errors import InputError
from hydrotele.joystick import AXES, Joystick
from hydrotele.operate.flat import flat_state, flattened
from hydrotele.teleop.coils import three_stations
from hydrotele.teleop.compliance import GRAVITY, holding_wrench, turn_matrix
from hydrotele.teleop.handle import StiffnessFeedback
from hydrotele.teleoperation import Coupling, TeleopPilot

NONE, STIFFNESS, DIRECT, COORDINATING, FOUR_CHANNEL, IMPEDANCE = range(6)
KINDS = ("none", "stiffness", "direct_force", "coordinating_force", "four_channel", "impedance")
RATE, POSITION = range(2)
# columns of `Master.axis`
(NOMINAL, LEAST, MOST, SLOPE, DAMPING, LIMIT, DEADBAND, DROP, OUTSIDE, REACH, COORDINATE, SIGN,
 GAIN, RATIO, COUPLING, COUPLING_DAMPING, REFLECTED_MOST) = range(17)  # fmt: skip
# rows of `Packet`
FORCE, PLACE, SPEED, WANTED, WANTED_SPEED, TASK_STIFFNESS, TASK_DAMPING = range(7)
_OBSERVER = 60.0  # rad/s of the hand force's estimate: a third of what 200 Hz samples
LEVER = 0.1  # m, a hand's: makes rotational gains of translational ones


class Master(NamedTuple):
    """Numbers of the master's control.

    Attributes:
        axis: (6, 17) of every joystick axis, columns above; SI. GAIN is the coordinate's rate per
            displacement beyond the dead band [1/s], or its place per displacement.
        mass: (1,) of the flotor [kg].
        turning: (3,) its moments about the handle [kg m^2].
        below: (3,) its centre of mass from the coils' frame [m].
        handle: (3,) the handle's point from the coils' frame [m].
        gravity: (3,) [m/s^2].
        to_currents: (6, 6) inverse of the coils' map [A/N], [A/(N m)].
        most: (1,) largest current [A].
        step: (6,) resolution of the sensing [m], [rad].
        kind: (2,) structure and mode.
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
    """What the master knows and does, rewritten every period.

    Attributes:
        handle: (6,) measured displacement [m] and rotation vector [rad].
        speed: (6,) its rate.
        push: (6,) force of the coils on the handle [N], [N m].
        stiffness: (6,) of every axis [N/m], [N m/rad].
        hand: (6,) estimated force of the hand [N], [N m].
        momentum: (6,) of the estimate.
        integral: (6,) of the displacement, for four channels under rate control.
        before: (6,) force of the last period from the machine, for its rate of change.
        currents: (6,) [A].
        extra: (6,) further force on the handle, such as that of tip-over protection [N], [N m].
        limited: (1,) share by which the currents had to be made smaller; 1 if not.
        energy: (2,) gone into the handle from the hand [J]: now, and its least so far.
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


def master(
    joystick: Joystick, pilot: TeleopPilot, coordinates: tuple[str, ...]
) -> tuple[Master, MasterState]:
    """Numbers and first state of the master's control.

    Args:
        joystick: the joystick.
        pilot: the scenario's.
        coordinates: task coordinates of the arm.

    Returns:
        The numbers, and a state at the centre.

    Raises:
        InputError: gains that make no sense, a coordinate that the arm has not, one joystick axis
            for two coordinates.
    """
    f, coils = joystick.flotor, joystick.coils
    com, handle, inertia = np.array(f.com), np.array(f.handle), np.diag(f.inertia)
    arm = com - handle
    turning = np.diag(inertia) + f.mass * (arm @ arm - arm**2)
    lorentz = three_stations(coils.radius, coils.force_per_ampere, coils.max_current)
    numbers = Master(
        axis=_axis_table(joystick, pilot, coordinates),
        mass=np.array([f.mass]),
        turning=turning,
        below=com,
        handle=handle,
        gravity=np.array(GRAVITY),
        to_currents=np.linalg.inv(lorentz.wrench_map),
        most=np.array([coils.max_current]),
        step=np.array([joystick.sensing.translation] * 3 + [joystick.sensing.rotation] * 3),
        kind=np.array([KINDS.index(pilot.reflection), RATE if pilot.mode == "rate" else POSITION]),
    )
    state = flat_state(MasterState, [(6,)] * 10 + [(1,), (2,)])
    state.limited[:] = 1.0
    return flattened(numbers), state


@compiled
def unpack_master(flat):
    """The parts of `flat_view(Master)`.

    Args:
        flat: (160,) array.

    Returns:
        Master, views of it.

    Source: order and shapes of Master.
    """
    return Master(
        flat[0:102].reshape(6, 17), flat[102:103], flat[103:106], flat[106:109], flat[109:112],
        flat[112:115], flat[115:151].reshape(6, 6), flat[151:152], flat[152:158], flat[158:160],
    )  # fmt: skip


@compiled
def unpack_master_state(flat):
    """The parts of `flat_view(MasterState)`.

    Args:
        flat: (63,) array.

    Returns:
        MasterState, views of it.

    Source: order and shapes of MasterState.
    """
    return MasterState(
        flat[0:6], flat[6:12], flat[12:18], flat[18:24], flat[24:30], flat[30:36], flat[36:42],
        flat[42:48], flat[48:54], flat[54:60], flat[60:61], flat[61:63],
    )  # fmt: skip


def _axis_table(joystick: Joystick, pilot: TeleopPilot, coordinates) -> np.ndarray:
    where = "pilot"
    if pilot.gains not in joystick.gains:
        raise InputError(f"{where}.gains", f"{pilot.gains!r}; valid: {', '.join(joystick.gains)}")
    table = np.zeros((6, 17))
    table[:, COORDINATE] = -1.0
    for number, name in enumerate(AXES):
        gains = joystick.gains[pilot.gains][name].model_dump()
        if unknown := set(pilot.stiffness.get(name, {})) - set(gains):
            raise InputError(f"{where}.stiffness.{name}", f"no {', '.join(sorted(unknown))}")
        gains |= pilot.stiffness.get(name, {})
        reach = joystick.workspace.translation if number < 3 else joystick.workspace.rotation
        slope = (gains["most"] - gains["nominal"]) / gains["force_limit"]
        law = StiffnessFeedback(
            gains["nominal"], gains["least"], gains["most"], slope, gains["damping"],
            gains["force_limit"], gains["deadband"],
        )  # fmt: skip
        detent = gains["detent"] if pilot.detent and gains["detent"] else None
        table[number, : COORDINATE] = (
            law.nominal, law.least, law.most, law.ratio, law.damping, law.force_limit,
            law.deadband, detent["drop"] if detent else 0.0,
            detent["outside"] if detent else -1.0, reach,
        )  # fmt: skip
        lever = 1.0 if number < 3 else LEVER
        table[number, RATIO:] = (
            lever * pilot.ratio, lever**2 * pilot.coupling, lever**2 * pilot.coupling_damping,
            pilot.force_limit or law.force_limit,
        )  # fmt: skip
    for number, coordinate in enumerate(coordinates):
        axis, sign, gain = _placed(pilot, coordinate)
        row = table[AXES.index(axis)]
        if row[COORDINATE] >= 0.0:
            raise InputError(f"{where}.coordinates", f"joystick axis {axis} moves two of them")
        if row[DEADBAND] >= row[REACH] and coordinate in pilot.coordinates:
            message = f"the dead band of {axis} reaches beyond its stop: {coordinate} cannot move"
            raise InputError(f"{where}.coordinates.{coordinate}", message)
        if pilot.mode == "rate":
            gain /= max(row[REACH] - row[DEADBAND], 1e-9)
        row[[COORDINATE, SIGN, GAIN]] = number, sign, gain
    if strange := set(pilot.coordinates) - set(coordinates):
        raise InputError(
            f"{where}.coordinates", f"{', '.join(sorted(strange))}: the arm has"
            f" {', '.join(coordinates)}",
        )  # fmt: skip
    return table


def _placed(pilot: TeleopPilot, coordinate: str) -> tuple[str, float, float]:
    """Joystick axis, its sign and its gain: speed at the stop, or scale."""
    coupling = pilot.coordinates.get(coordinate, Coupling())  # pyright: ignore - checked above
    axis, sign = coupling.placed(coordinate)
    return axis, sign, coupling.speed if pilot.mode == "rate" else coupling.scale


@compiled
def read_handle(numbers, qpos, period, s):
    """Measure the handle as finely as the sensing allows, and its rate by differences.

    Args:
        numbers: Master.
        qpos: (7,) of the flotor: position [m] and quaternion.
        period: since the last reading, scalar [s]; 0 for the first one.
        s: MasterState; `handle` and `speed` are written.

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
        s.speed[i] = (value - s.handle[i]) / period if period > 0.0 else 0.0
        s.handle[i] = value


@compiled
def reflect(numbers, packet, fresh, period, s):
    """Force on the handle of every axis, by the structure that was chosen.

    Args:
        numbers: Master.
        packet: (7, k) what came from the machine: force on its tip, its place and speed, those of
            its reference, stiffness and damping of its task; task units.
        fresh: share of the packet that counts, scalar: 1, falling to 0 when the line is silent.
        period: scalar [s].
        s: MasterState; `push`, `stiffness`, `integral` and `before` are written.

    Returns:
        Nothing.

    Source: Zhu 1994, 3.14, 3.59-3.62, 3.75, 4.1, Fig. 6.51.
    """
    kind, mode = numbers.kind[0], numbers.kind[1]
    for i in range(6):
        row, x, v = numbers.axis[i], s.handle[i], s.speed[i]
        c, sign, gain = int(row[10]), row[11], row[12]
        stiff, rub, push = row[0], row[4], 0.0
        way = 1.0 if x > 0.0 else (-1.0 if x < 0.0 else 0.0)
        if c >= 0 and kind != 0:
            force = fresh * sign * packet[0, c]
            if not np.isfinite(force):
                force = 0.0
            kept = min(row[16], max(-row[16], force))
            if mode == 1 and kind != 1 and kind != 5:
                stiff = 0.0  # under position control the slave's place is the spring's rest
            if kind == 1:
                kept = min(row[5], max(-row[5], force))
                stiff = min(row[2], max(row[1], stiff - row[3] * kept * way))
            elif kind == 2:
                push += row[13] * kept
            elif kind == 3:
                share = sign / gain if mode == 1 else sign
                behind = share * (packet[3, c] - packet[1, c])
                slower = share * (packet[4, c] - packet[2, c])
                push -= fresh * (row[14] * behind + row[15] * slower)
            elif kind == 4:
                push += _four_channels(row, mode, x, v, kept, sign, packet, c, period, s, i)
            elif kind == 5:
                stiff = min(row[2], max(row[1], stiff + fresh * row[13] * gain * packet[5, c]))
                rub += fresh * row[13] * gain * packet[6, c]
        s.stiffness[i] = stiff
        beyond = abs(x) - row[6]
        if row[8] >= 0.0 and beyond > 0.0:
            stiff_out = row[8] + max(stiff - row[0], 0.0)
            push -= way * (stiff * row[6] - row[7] + stiff_out * beyond)
        else:
            push -= stiff * x
        s.push[i] = push - rub * v + fresh * s.extra[i]


@compiled
def _four_channels(row, mode, x, v, force, sign, packet, c, period, s, i):
    """Force back and velocity back of the four-channel structures, and the master's own part."""
    gain, spring, damper = row[12], row[14], row[15]
    place, speed = sign * packet[1, c], sign * packet[2, c]
    reflected = row[13] * force
    if mode == 1:
        return reflected - spring * (x - place / gain) - damper * (v - speed / gain)
    s.integral[i] += period * x
    change = (reflected - s.before[i]) / (period * gain)
    s.before[i] = reflected
    return change - spring * (gain * s.integral[i] - place) - damper * (gain * x - speed)


@compiled
def drive_coils(numbers, quaternion, period, s):
    """Coil currents that put `push` on the handle, the flotor's weight taken off; hand's force.

    Currents beyond the largest make the whole wrench smaller, in its direction.

    Args:
        numbers: Master.
        quaternion: (4,) of the flotor.
        period: scalar [s].
        s: MasterState; `currents`, `limited`, `hand`, `momentum` and `energy` are written.

    Returns:
        Nothing.

    Source: Zhu 1994, 5.1.3; momentum observer after De Luca and Mattone 2005.
    """
    turn, wrench = np.empty((3, 3)), np.empty(6)
    turn_matrix(quaternion, turn)
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
    power = 0.0
    for i in range(6):
        s.currents[i] *= s.limited[0]
        own = numbers.mass[0] if i < 3 else numbers.turning[i - 3]
        s.hand[i] = _OBSERVER * (own * s.speed[i] - s.momentum[i])
        s.momentum[i] += period * (s.push[i] + s.hand[i])
        power += s.hand[i] * s.speed[i]
    s.energy[0] += period * power
    s.energy[1] = min(s.energy[1], s.energy[0])


@compiled
def master_step(numbers, qpos, packet, fresh, period, s):
    """One period of the master: read the handle, reflect, drive the coils.

    Args:
        numbers: Master.
        qpos: (7,) of the flotor: position [m] and quaternion.
        packet: (7, k) see `reflect`.
        fresh: see `reflect`, scalar.
        period: scalar [s]; 0 for the first one.
        s: MasterState, written.

    Returns:
        Nothing.

    Source: this module.
    """
    read_handle(numbers, qpos, period, s)
    reflect(numbers, packet, fresh, max(period, 1e-9), s)
    drive_coils(numbers, qpos[3:7], period, s)
