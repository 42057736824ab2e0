"""Time simulation of a sampled teleoperator, packet by packet, to check `sampled_stability`.

Master with hand and slave with task are integrated with many steps per period. In every period each
side measures, sends a packet and uses the newest packet that has arrived. Packets have individual
delays, may overtake each other and may be lost. The simulation uses no polynomials, means or
predictions of `sampled_stability`. Waves and passivity control are the nonlinear laws of the
teleoperated scenarios (`passive_channel`).
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.packet_delays import compute_packet_ages, delays_to_periods
from hydrotele.teleop.passive_channel import (
    END_SIZE,
    ENERGY_IN,
    STORED_ENERGY,
    step_passivity_master,
    step_passivity_slave,
    step_wave_master,
    step_wave_slave,
)
from hydrotele.teleop.sampled_stability import PASSIVITY_STRUCTURE, WAVE_STRUCTURE, wave_impedance
from hydrotele.teleop.two_port import RATE_STRUCTURES, Impedance

# signals of a side: sum, position, difference, acceleration, sum and difference of the force on
# hand or task, that force
SUM, X, V, A, IMPULSE, FORCE_RATE, FORCE = range(7)
_SIGNALS = 7
_STEP_RATIO = 0.1  # integration steps per time constant of the fastest mode
_MIN_POWER = 1e-5  # W of passivity control: in one run less than a tenth of the initial energy
_INITIAL_SPEEDS = np.array([0.1, 0.03])  # m/s, of master and slave
_BLOCKS = 40
_MAX_SPEED_RATIO, _MIN_SPEED_RATIO = (
    1e8,
    1e-8,
)  # factors on the initial speed beyond which a run is stopped
_LINEAR, _WAVES, _CONTROLLED = range(3)


class KickResponse(NamedTuple):
    """Response of a sampled teleoperator to initial velocities of master and slave.

    Attributes:
        max_speeds: (40,) maximum of the sum of master's and slave's speed magnitudes in each
            fortieth of the run [m/s]; 0 after an early stop.
        is_growing: whether the largest speed late in the run exceeds that early in the run by more
            than 5 %. Under passivity control, which bounds motions without damping them: whether
            the late kinetic energy exceeds that at the start by more than 5 %.
        line_energy: (periods,) energy that has entered the channel at both ends [J]; 0 for the six
            structures without waves or passivity control.
    """

    max_speeds: np.ndarray
    is_growing: bool
    line_energy: np.ndarray

    @property
    def has_decayed(self) -> bool:
        """Whether the last speeds of the run are below a thousandth of the master's initial speed.

        The last speeds are the last positive element of `max_speeds`.
        """
        return bool(self.max_speeds[self.max_speeds > 0.0][-1] < 1e-3 * _INITIAL_SPEEDS.max())


def control_coefficients(case: TeleoperatorAxis, structure: str, return_gain: float = 1.0) -> np.ndarray:
    """Return the control laws of a structure as coefficients on seven sampled signals of each side.

    The signals are the time integral of the position, position, its difference quotient,
    acceleration, time integral and difference quotient of the force on hand or task, and that
    force.

    Args:
        case: the teleoperator.
        structure: one of `two_port.STRUCTURES`.
        return_gain: factor on the return channels [1].

    Returns:
        (4, 7) rows: own force of the master, force on the slave from the master's packet, own force of
        the slave, force on the master from the slave's packet. Own forces are subtracted from the force
        on a side, forces from packets are added.

    Source: Zhu 1994, 3.9-3.62.
    """
    made, gains, rate = np.zeros((4, _SIGNALS)), case.gains, structure in RATE_STRUCTURES
    own, forward, slave, back = made

    def add_impedance(row: np.ndarray, z: Impedance, place: int, factor: float = 1.0) -> None:
        row[place : place + 2] += factor * np.array([z.stiffness, z.damping])
        if place == X:
            row[A] += factor * z.mass

    add_impedance(slave, case.slave_control, X)
    ahead = gains.velocity if rate else gains.position
    if structure == "four_channel_position":
        ahead = 1.0
    add_impedance(forward, case.slave_control, SUM if rate else X, ahead)
    shared = structure in ("rate_position", "four_channel_rate")
    add_impedance(own, case.master_control, SUM if shared else X, gains.velocity if shared else 1.0)
    if structure in ("position_force", "rate_force"):
        back[FORCE] = -gains.force
    else:
        add_impedance(back, case.master_control, X)
    if structure == "four_channel_position":
        add_impedance(forward, case.slave, X)
        add_impedance(back, case.master, X)
        forward[FORCE], back[FORCE] = -1.0, -1.0
    if structure == "four_channel_rate":
        forward[IMPULSE], back[FORCE_RATE] = -gains.velocity, -1.0 / gains.velocity
    back *= return_gain
    return made


def simulate_initial_velocities(
    case: TeleoperatorAxis, structure: str, period: float, delays_forward: np.ndarray, delays_back: np.ndarray,
    return_gain: float = 1.0,
) -> KickResponse:  # fmt: skip
    """Simulate a sampled teleoperator packet by packet, after initial velocities of both sides.

    Args:
        case: teleoperator with hand and task; its delays are replaced by the given delays.
        structure: one of `sampled_stability.SAMPLED_STRUCTURES`.
        period: control period of both sides [s].
        delays_forward: (n,) delay of the master's packet that is sent in each of the n periods of
            the run [s]; NaN if lost.
        delays_back: (n,) the same for the slave's packets [s].
        return_gain: factor on the return channels [1].

    Returns:
        Speeds, growth and energy of the run.

    Source: this module's docstring.
    """
    way = _LINEAR
    table = np.zeros((4, _SIGNALS))
    if structure in (WAVE_STRUCTURE, PASSIVITY_STRUCTURE):
        way = _WAVES if structure == WAVE_STRUCTURE else _CONTROLLED
    else:
        table = control_coefficients(case, structure, return_gain)
    ages = [compute_packet_ages(delays_to_periods(d, period)) for d in (delays_forward, delays_back)]
    firm = case.slave_control
    bodies = np.array([
        [a.mass, a.damping, a.stiffness, b.mass, b.damping, b.stiffness]
        for a, b in ((case.master, case.hand), (case.slave, case.task))
    ])  # fmt: skip
    steps = max(1, math.ceil(period * _max_mode_rate(bodies) / _STEP_RATIO))
    numbers = np.array([period, firm.stiffness, firm.damping, wave_impedance(case)])
    largest, moving, energy = _integrate_run(way, table, bodies, numbers, steps, ages[0], ages[1], _INITIAL_SPEEDS)
    given = 0.5 * float((bodies[:, 0] + bodies[:, 3]) @ _INITIAL_SPEEDS**2)
    grows = _has_gained_energy(moving, given) if way == _CONTROLLED else _is_growing(largest)
    return KickResponse(largest, grows, energy)


def _max_mode_rate(bodies: np.ndarray) -> float:
    mass, damping, stiffness = bodies[:, :3].T + bodies[:, 3:].T
    return float(max((damping / mass).max(), np.sqrt(stiffness / mass).max()))


_MIN_GROWTH_RATIO = 1.05  # ratio of late to early motion above which motion grows; drift stays below


def _is_growing(largest: np.ndarray) -> bool:
    """Return whether the speeds of a run grow.

    `largest` (40,) are the maximum speeds of the parts of the run. Speeds grow if the maximum of
    the last quarter of the run exceeds that of the second quarter by more than 5 %. After an early
    stop the last speed is compared with the initial one.
    """
    reached = int(np.count_nonzero(largest > 0.0))
    if reached < _BLOCKS:
        return bool(largest[reached - 1] > _INITIAL_SPEEDS.max())
    quarter = _BLOCKS // 4
    return bool(largest[-quarter:].max() > _MIN_GROWTH_RATIO * largest[quarter : 2 * quarter].max())


def _has_gained_energy(largest: np.ndarray, given: float) -> bool:
    """Return whether the kinetic energy late in a run exceeds the initial one by more than 5 %.

    `largest` (40,) are the maximum kinetic energies of the parts of the run [J], of which the last
    ten before its stop are used. `given` is the initial kinetic energy [J].
    """
    late = largest[largest > 0.0][-_BLOCKS // 4 :]
    return bool(late.max() > _MIN_GROWTH_RATIO * given)


@compiled
def _integrate_run(way, table, bodies, numbers, steps, age_forward, age_back, first):
    """Integrate master and slave over all n periods, with one packet in each direction per period.

    `way` selects linear control laws, wave variables or passivity control; `table` (4, 7) are the
    coefficients of a linear law. `bodies` (2, 6) are mass, damping and stiffness of each side and
    of hand or task. `numbers` are period, stiffness and damping of the slave's controller, and wave
    impedance. `age_forward` and `age_back` (n,) are the ages of the packets in use, in periods;
    `first` (2,) are the initial speeds.

    The run stops early when speeds have decayed or grown beyond limits. Return the largest speeds
    (40,) [m/s] and kinetic energies (40,) [J] of the parts of the run, and the energy that has
    entered the channel (n,) [J].
    """
    count = len(age_forward)
    period = numbers[0]
    largest, moving, energy = np.zeros(_BLOCKS), np.zeros(_BLOCKS), np.zeros(count)
    sent = np.zeros((2, count, _SIGNALS))
    state = np.zeros((2, 2))  # position, speed
    state[0, 1], state[1, 1] = first[0], first[1]
    seen, force = np.zeros((2, _SIGNALS)), np.zeros(2)
    ends, come = np.zeros((2, END_SIZE)), np.zeros((2, _SIGNALS))
    for n in range(count):
        for side in range(2):
            _sample_side_signals(bodies[side], state[side], force[side], period, seen[side])
        newest = n - age_forward[n], n - age_back[n]
        if way == _LINEAR:
            sent[0, n], sent[1, n] = seen[0], seen[1]
            for side in range(2):
                if newest[side] >= 0:  # otherwise no packet has arrived yet
                    come[side] = sent[side, newest[side]]
            for side in range(2):
                force[side] = 0.0
                for j in range(_SIGNALS):
                    force[side] -= table[2 * side, j] * seen[side, j]
                    force[side] += table[3 - 2 * side, j] * come[1 - side, j]
        elif way == _WAVES:
            _step_waves(n, newest[0], newest[1], numbers, seen, sent, ends, force)
        else:
            _step_passivity_control(n, newest[0], newest[1], numbers, bodies[0, 0], seen, sent, ends, force)
        energy[n] = ends[0, STORED_ENERGY] + ends[1, STORED_ENERGY]
        for side in range(2):
            _integrate_side(bodies[side], state[side], force[side], period, steps)
        block = n * _BLOCKS // count
        speed = abs(state[0, 1]) + abs(state[1, 1])
        largest[block] = max(largest[block], speed)
        kinetic = 0.0
        for side in range(2):
            kinetic += 0.5 * (bodies[side, 0] + bodies[side, 3]) * state[side, 1] ** 2
        moving[block] = max(moving[block], kinetic)
        if (n + 1) * _BLOCKS % count < _BLOCKS:
            if largest[block] < _MIN_SPEED_RATIO * first[0] or not largest[block] < _MAX_SPEED_RATIO * first[0]:
                break
    return largest, moving, energy


@compiled
def _sample_side_signals(body, state, force, period, seen):
    """Update the sampled signals `seen` (7,) of master or slave from its state.

    They are position, its time integral and difference quotient, acceleration, the force on hand or
    task, and the time integral and difference quotient of that force. `body` (6,) is mass, damping
    and stiffness of the side and of hand or task, `state` (2,) position and speed. The sample is
    taken just before the control force `force` [N] changes.
    """
    x, v = state[0], state[1]
    mass, damping, stiffness = body[0] + body[3], body[1] + body[4], body[2] + body[5]
    a = (force - damping * v - stiffness * x) / mass
    held = body[3] * a + body[4] * v + body[5] * x
    seen[SUM] += period * x
    seen[V] = (x - seen[X]) / period
    seen[X], seen[A] = x, a
    seen[IMPULSE] += period * held
    seen[FORCE_RATE] = (held - seen[FORCE]) / period
    seen[FORCE] = held


# elements of a packet: sum of waves, position of the master or force of the slave; their energy
PACKET_SIGNAL, PACKET_ENERGY = range(2)


@compiled
def _read_packet(sent, row, n):
    """Return the two values of the packet that was sent in the earlier of the periods `row` and n.

    They are the signal (time integral of waves, position or force) and the energy. Both are 0
    before the first arrival (`row` negative). `sent` holds the packets of one side, one row per
    period.
    """
    if row < 0:
        return 0.0, 0.0
    return sent[min(row, n), PACKET_SIGNAL], sent[min(row, n), PACKET_ENERGY]


@compiled
def _step_waves(n, newest_forward, newest_back, numbers, seen, sent, ends, force):
    """Compute the forces on master and slave in period n with wave variables, and send packets.

    The master acts first and uses the slave's packet of an earlier period.
    """
    period, stiffness, damping, b = numbers[0], numbers[1], numbers[2], numbers[3]
    total, budget = _read_packet(sent[1], newest_back, n - 1)
    pushed, wave = step_wave_master(seen[0, V], total, budget, b, period, ends[0])
    _write_wave_packet(sent[0], n, wave, period)
    total, budget = _read_packet(sent[0], newest_forward, n)
    pull, wave = step_wave_slave(seen[1, V], total, budget, stiffness, damping, b, period, ends[1])
    _write_wave_packet(sent[1], n, wave, period)
    force[0], force[1] = -pushed, pull


@compiled
def _write_wave_packet(sent, n, wave, period):
    before, energy = 0.0, 0.0
    if n > 0:
        before, energy = sent[n - 1, PACKET_SIGNAL], sent[n - 1, PACKET_ENERGY]
    sent[n, PACKET_SIGNAL] = before + period * wave
    sent[n, PACKET_ENERGY] = energy + period * wave * wave


@compiled
def _step_passivity_control(n, newest_forward, newest_back, numbers, mass, seen, sent, ends, force):
    """Compute the forces on master and slave in period n under passivity control, and send packets.

    The master acts first and uses the slave's packet of an earlier period.
    """
    period, stiffness, damping = numbers[0], numbers[1], numbers[2]
    total, budget = _read_packet(sent[1], newest_back, n - 1)
    force[0] = -step_passivity_master(seen[0, V], total, budget, mass, period, ends[0])
    sent[0, n, PACKET_SIGNAL], sent[0, n, PACKET_ENERGY] = seen[0, X], ends[0, ENERGY_IN]
    total, budget = _read_packet(sent[0], newest_forward, n)
    force[1] = step_passivity_slave(seen[1, V], total, budget, stiffness, damping, _MIN_POWER, period, ends[1])
    sent[1, n, PACKET_SIGNAL], sent[1, n, PACKET_ENERGY] = force[1], ends[1, ENERGY_IN]


@compiled
def _integrate_side(body, state, force, period, steps):
    """Integrate the motion of a side over one period with a constant force, by Runge-Kutta steps.

    `body` is mass, damping and stiffness of the side and of the hand or task; `state` is position and
    speed, written.
    """
    mass, damping, stiffness = body[0] + body[3], body[1] + body[4], body[2] + body[5]
    h = period / steps
    x, v = state[0], state[1]
    for _ in range(steps):
        a = (force - damping * v - stiffness * x) / mass
        x2, v2 = x + 0.5 * h * v, v + 0.5 * h * a
        a2 = (force - damping * v2 - stiffness * x2) / mass
        x3, v3 = x + 0.5 * h * v2, v + 0.5 * h * a2
        a3 = (force - damping * v3 - stiffness * x3) / mass
        x4, v4 = x + h * v3, v + h * a3
        a4 = (force - damping * v4 - stiffness * x4) / mass
        x += h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4)
        v += h / 6.0 * (a + 2.0 * a2 + 2.0 * a3 + a4)
    state[0], state[1] = x, v
