"""Linear predictions against the simulated two masses: what is felt, and what is stable.

Two masses in time: master and slave with their channels, as differential equations with delay.

A case is written as signals and coefficients. The signals are the master's position, its integral
and derivatives, the hand's force and its integral, and the slave's position and its derivatives:

`q = [int x, x, v, a, int F_h, F_h, y, w, w', w'']`

so that a derivative moves coefficients one place. Accelerations, the hand's force and the slave's
jerk follow from the others and from delayed signals by four linear equations, which also solves the
algebraic loops of a structure without delay. Independent of `stability`, which it confirms.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.teleop.analysis import Case, stability_map
from hydrotele.teleop.two_port import Impedance, transmitted, unstable_held

INT, X, V, A, IMPULSE, FORCE, Y, W, W1, W2 = range(10)
_KNOWN = np.array([INT, X, V, IMPULSE, Y, W])
_SOLVED = np.array([A, FORCE, W1, W2])
_PER_RATE = 0.2  # steps over the time constant of the fastest rate, a tenth of Adams' limit of 1
_LARGEST = 5e-4  # s
_BLOCKS = 20  # of a run, whose largest speeds are compared
_GROWN, _GONE = 1e9, 1e-9  # of the kick, beyond which nothing changes any more
_KICK = 0.1  # m/s
_WHOLE = 1e-6  # of a step, what a quotient of delay and step rounds by
_PERIODS = 2  # of a sine that are measured
_SETTLE = (20.0, 40.0, 80.0, 160.0, 320.0)  # s before a sine is measured
_SETTLED = 1e-3  # change of what is measured, small against the 3 % that are asked for
_TRIPS = 40  # there and back that a run lasts at least
_FINEST = 2e-6  # s, a step below which a run takes minutes


class ControlLaw(NamedTuple):
    """Coefficients on the signals (10,).

    Attributes:
        own: force of the master's own controller.
        forward: force on the slave, C1 and C3, of signals as they were a delay ago.
        back: force on the master, C2 and C4, the same.
    """

    own: np.ndarray
    forward: np.ndarray
    back: np.ndarray


class SimulatedRun(NamedTuple):
    """A simulated run.

    Attributes:
        largest: (20,) of master's and slave's speed together, in twentieths of the run [m/s].
        felt: force over velocity of an imposed motion at its frequency [N s/m], else 0.
    """

    largest: np.ndarray
    felt: complex


def control_law(case: Case, structure: str, reflected: float = 1.0) -> ControlLaw:
    """The control law of a structure in time.

    Args:
        case: the teleoperator.
        structure: its name, one of `STRUCTURES`.
        reflected: factor on what comes back [1].

    Returns:
        The law.

    Source: Zhu 1994, 3.9-3.62, written in time.
    """
    kv, gains = case.gains.velocity, case.gains
    rate = structure in ("rate_position", "rate_force", "four_channel_rate")
    forward = on_motion(case.slave_control, INT if rate else X) * (kv if rate else gains.position)
    own, back = on_motion(case.master_control, X), np.zeros(10)
    if structure in ("rate_position", "four_channel_rate"):
        own = kv * on_motion(case.master_control, INT)
    if structure in ("position_position", "rate_position", "four_channel_rate"):
        back = -on_motion(case.master_control, Y)
    if structure in ("position_force", "rate_force"):
        back = gains.force * on_motion(case.task, Y)
    if structure == "four_channel_position":
        forward = on_motion(case.slave, X) + on_motion(case.slave_control, X)
        forward[FORCE] = 1.0
        back = on_motion(case.task, Y) - on_motion(case.master, Y)
        back -= on_motion(case.master_control, Y)
    if structure == "four_channel_rate":
        forward[IMPULSE] = kv
        back = back + on_motion(case.task, W) / kv
    return ControlLaw(own, forward, reflected * back)


def on_motion(impedance: Impedance, position: int) -> np.ndarray:
    """Coefficients (10,) of an impedance on a position and its two derivatives."""
    made = np.zeros(10)
    made[position : position + 3] = impedance.stiffness, impedance.damping, impedance.mass
    return made


def step_of(case: Case) -> float:
    """Step that resolves the fastest rate that the masses can have together [s].

    Raises:
        InputError: that would take too long.
    """
    parts = (case.master, case.slave, case.master_control, case.slave_control, case.hand, case.task)
    lightest = min(part.mass for part in parts if part.mass)
    rates = (
        sum(part.damping for part in parts) / lightest,
        math.sqrt(sum(part.stiffness for part in parts) / lightest),
        1.0 / _LARGEST * _PER_RATE,
    )
    step = _PER_RATE / max(rates)
    if step < _FINEST:
        raise InputError(
            "teleoperator", f"too fast to be simulated, with rates of {max(rates):.3g} 1/s: the"
            f" lightest mass is {lightest:g} kg; leave --confirm out or give hand and sides mass",
        )  # fmt: skip
    return step


def impulse_response(
    case: Case, structure: str, reflected: float = 1.0, seconds: float = 40.0
) -> SimulatedRun:
    """Simulate a kick of the hand, with hand and task in place.

    Args:
        case: the teleoperator with hand and task.
        structure: its name.
        reflected: factor on what comes back [1].
        seconds: to simulate, and at least forty delays; it ends sooner where motion has died out
            or has grown without bound.

    Returns:
        The run.
    """
    seconds = max(seconds, _TRIPS * 2.0 * case.delay)
    return _simulated(case, control_law(case, structure, reflected), seconds, 0.0, 0.0)


def is_growing(run: SimulatedRun) -> bool:
    """Whether a kick grows: speeds late in the run are larger than early ones."""
    reached = run.largest[run.largest > 0.0]
    if len(reached) < _BLOCKS:
        return bool(reached[-1] > _KICK)
    return bool(run.largest[-4:].max() > run.largest[4:8].max())


def simulate_sine(case: Case, structure: str, frequency: float) -> complex:
    """Impedance felt where the master's motion is an imposed sine.

    Transients are given more and more time, until that changes nothing.

    Args:
        case: the teleoperator with its task.
        structure: its name.
        frequency: [rad/s].

    Returns:
        Force over velocity, of two periods [N s/m].
    """
    law, period = control_law(case, structure), 2.0 * math.pi / frequency
    felt = 0.0
    for settle in _SETTLE:
        before, seconds = felt, (math.ceil(settle / period) + _PERIODS) * period
        felt = _simulated(case, law, seconds, frequency, _PERIODS * period).felt
        if abs(felt - before) < _SETTLED * abs(felt):
            break
    return felt


def _simulated(
    case: Case, law: ControlLaw, seconds: float, frequency: float, measured: float
) -> SimulatedRun:
    step = step_of(case)
    if frequency:  # a whole number of steps in a period, so that the sine's mean is 0
        step = 2.0 * math.pi / frequency / math.ceil(2.0 * math.pi / frequency / step)
    elif case.delay_forward >= step:  # a whole number in the delay
        step = case.delay_forward / math.ceil(case.delay_forward / step)
    late = np.array([case.delay_forward, case.delay_back]) / step
    late = np.where(np.abs(late - np.round(late)) < _WHOLE, np.round(late), late)
    late[late < 1.0] = 0.0  # less than a step counts as none
    lags = int(late[0]), int(late[1])
    now, delayed = _equations(case, law, lags, bool(frequency))
    inverse = np.linalg.inv(now[:, _SOLVED])
    largest, sums = _march(
        inverse, inverse @ now[:, _KNOWN], inverse @ delayed, np.array(lags), late - lags, step,
        round(seconds / step), round(measured / step), frequency,
    )  # fmt: skip
    return SimulatedRun(largest, complex(sums[0] / sums[1]) if frequency else 0.0)


def _equations(
    case: Case, law: ControlLaw, lags: tuple[int, int], imposed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients (4, 10) on signals now, and on delayed ones (4, 20): forward, then back.

    Rows: master, hand, slave, derivative of the slave's. The last is needed where the slave's jerk
    is, and is otherwise `w'' = 0`.
    """
    own = on_motion(case.master, X) + law.own
    own[FORCE] -= 1.0
    hand = on_motion(case.hand, X)
    hand[FORCE] = 1.0
    if imposed:
        hand = np.eye(10)[A]
    slave = on_motion(case.slave, Y) + on_motion(case.slave_control, Y) + on_motion(case.task, Y)
    jerk, still = np.eye(10)[W2], np.zeros(10)
    if law.back[W2]:
        jerk, still = np.roll(slave, 1), np.roll(law.forward, 1)
    now = np.array([own, hand, slave, jerk])
    there, here = np.array([still, still, law.forward, still]), np.zeros((4, 10))
    there[:2] = 0.0
    here[0] = -law.back
    there, here = _if_late(there, here, now, lags)
    return now, np.hstack([there, here])


def _if_late(
    there: np.ndarray, here: np.ndarray, now: np.ndarray, lags: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Delayed coefficients; those without delay are moved to the signals of now."""
    found = []
    for part, lag in zip((there, here), lags, strict=True):
        if lag == 0:
            now -= part
            part = np.zeros_like(part)
        found.append(part)
    return found[0], found[1]


@compiled
def _march(inverse, known, delayed, lags, beyond, step, rows, measured, frequency):
    """Largest speeds (20,), and sums of force and velocity times the measured wave (2,)."""
    past = np.zeros((max(lags[0], lags[1]) + 2, 10))
    largest, sums = np.zeros(_BLOCKS), np.zeros(2, np.complex128)
    q, before, late = np.zeros(10), np.zeros(10), np.zeros(20)
    if frequency == 0.0:
        q[V] = _KICK
    for n in range(rows):
        angle = frequency * step * n
        if frequency != 0.0:
            q[INT], q[X] = -math.cos(angle) / frequency, math.sin(angle)
            q[V] = frequency * math.cos(angle)
        _recall(past, n, lags, beyond, late)
        _solve(q, late, inverse, known, delayed, frequency)
        past[n % len(past)] = q
        block = n * _BLOCKS // rows
        largest[block] = max(largest[block], abs(q[V]) + abs(q[W]))
        if frequency != 0.0 and n >= rows - measured:
            wave = complex(math.cos(angle), -math.sin(angle))
            sums[0] += q[FORCE] * wave
            sums[1] += q[V] * wave
        if frequency == 0.0 and n * _BLOCKS % rows < _BLOCKS and block > 0:
            if largest[block - 1] < _GONE * _KICK or not largest[block - 1] < _GROWN * _KICK:
                break
        _advance(q, before, step, n == 0)
    return largest, sums


@compiled
def _recall(past, n, lags, beyond, late):
    """Signals as they were a delay ago, between two steps where it is no whole number of them."""
    for side in range(2):
        if lags[side] > 0 and n > lags[side]:
            row, share = n - lags[side], beyond[side]
            for j in range(10):
                newer, older = past[row % len(past), j], past[(row - 1) % len(past), j]
                late[10 * side + j] = newer + share * (older - newer)


@compiled
def _solve(q, late, inverse, known, delayed, frequency):
    """Accelerations, the hand's force and the slave's jerk."""
    for i in range(4):
        total = 0.0
        for j in range(20):
            total += delayed[i, j] * late[j]
        for j in range(6):
            total -= known[i, j] * q[_KNOWN[j]]
        if frequency != 0.0:
            total -= inverse[i, 1] * frequency**2 * q[X]
        q[_SOLVED[i]] = total  # none of the known ones


@compiled
def _advance(q, before, step, first):
    """Second order: Adams-Bashforth for speeds and impulse, the trapezoid for what they move."""
    if first:
        before[:] = q
    x, v, w = q[X], q[V], q[W]
    q[V] += step * (1.5 * q[A] - 0.5 * before[A])
    q[W] += step * (1.5 * q[W1] - 0.5 * before[W1])
    q[IMPULSE] += step * (1.5 * q[FORCE] - 0.5 * before[FORCE])
    before[A], before[W1], before[FORCE] = q[A], q[W1], q[FORCE]
    q[X] += 0.5 * step * (v + q[V])
    q[Y] += 0.5 * step * (w + q[W])
    q[INT] += 0.5 * step * (x + q[X])


SWEPT = 2.0 * np.pi * np.geomspace(0.1, 5.0, 9)  # rad/s, what a hand moves


@dataclass(frozen=True)
class SineSweep:
    """Impedance felt in a simulated sine sweep.

    Attributes:
        structure: its name.
        delay_forward: from the master to the slave [s].
        delay_back: back [s].
        frequencies: (n,) [rad/s].
        expected: (n,) by the formula [N s/m].
        measured: (n,) in simulation [N s/m]; empty where a held master's slave is unstable, so that
            nothing can be measured.
    """

    structure: str
    delay_forward: float
    delay_back: float
    frequencies: np.ndarray
    expected: np.ndarray
    measured: np.ndarray

    @property
    def error(self) -> float | None:
        """Largest relative error [1], None where nothing could be measured."""
        if not len(self.measured):
            return None
        return float(np.max(np.abs(self.measured / self.expected - 1.0)))


@dataclass(frozen=True)
class Agreement:
    """Stability predicted and seen in simulation.

    Attributes:
        structure: its name.
        delays: (n,) each way [s].
        factors: (m,) on what comes back [1].
        predicted: (m, n) true where stable.
        seen: (m, n) the same in simulation.
    """

    structure: str
    delays: np.ndarray
    factors: np.ndarray
    predicted: np.ndarray
    seen: np.ndarray

    @property
    def share(self) -> float:
        """Share of the cells that agree [1]."""
        return float(np.mean(self.predicted == self.seen))


def sweep(case: Case, structure: str, frequencies: np.ndarray = SWEPT) -> SineSweep:
    """Measure what is felt with imposed sines, and compute it.

    Args:
        case: the teleoperator with its task.
        structure: its name.
        frequencies: (n,) [rad/s].

    Returns:
        Both.
    """
    port = case.port(structure)
    expected = transmitted(port, 1j * frequencies, case.task)
    measured = []
    if unstable_held(port, case.task) == 0:
        measured = [simulate_sine(case, structure, float(w)) for w in frequencies]
    return SineSweep(
        structure, case.delay_forward, case.delay_back, frequencies, expected, np.array(measured)
    )


def agreement(case: Case, structure: str, delays: np.ndarray, factors: np.ndarray) -> Agreement:
    """Simulate a kick in every cell of a map of stability.

    Args:
        case: the teleoperator with hand and task.
        structure: its name.
        delays: (n,) each way [s].
        factors: (m,) on what comes back [1].

    Returns:
        Prediction and simulation.
    """
    seen = [
        [
            not is_growing(impulse_response(case.with_delay(float(t)), structure, float(k)))
            for t in delays
        ]
        for k in factors
    ]
    predicted = stability_map(case, structure, delays, factors)
    return Agreement(structure, delays, factors, predicted, np.array(seen))
