"""Time simulation of a teleoperator: two masses with their channels as differential equations with delay.

The simulation checks the linear predictions. It integrates two masses, master and slave with
their channels, as differential equations with delay. A case is written as coefficients on signals.
The signals are the master's position, its integral and derivatives, the hand's force and its
integral, and the slave's position and its derivatives:

`q = [int x, x, v, a, int F_h, F_h, y, w, w', w'']`

so that a derivative shifts the coefficients by one element. Accelerations, the hand's force and the
slave's jerk follow from the other signals and from delayed signals by four linear equations. These
also solve the algebraic loops of a structure without delay. The simulation does not use the
linear stability test that it checks.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.two_port import Impedance

INT, X, V, A, IMPULSE, FORCE, Y, W, W1, W2 = range(10)
_KNOWN_SIGNALS = np.array([INT, X, V, IMPULSE, Y, W])
_SOLVED_SIGNALS = np.array([A, FORCE, W1, W2])
_STEP_RATIO = 0.2  # steps per time constant of the fastest mode; the limit of Adams' method is 1
_MAX_STEP = 5e-4  # s
_BLOCKS = 20  # number of parts of a run whose largest speeds are compared
_MAX_SPEED_RATIO, _MIN_SPEED_RATIO = (
    1e9,
    1e-9,
)  # factors on the initial speed beyond which a run is stopped
_INITIAL_SPEED = 0.1  # m/s
_LAG_TOLERANCE = 1e-6  # tolerance, in steps, for a delay that is a whole number of steps
_MEASURED_PERIODS = 2  # number of sine periods that are measured
_SETTLING_TIMES = (20.0, 40.0, 80.0, 160.0, 320.0)  # s before a sine is measured
_SETTLING_TOLERANCE = 1e-3  # relative change of the measured impedance; the required accuracy is 3 %
_MIN_ROUND_TRIPS = 40  # minimum duration of a run in round-trip delays
_MIN_STEP = 2e-6  # s, minimum step; a run with a smaller one takes minutes


class ControlLaw(NamedTuple):
    """Control law of a structure: forces as linear combinations of the ten signals of the module.

    Attributes:
        master_own: (10,) coefficients of the force of the master's own controller.
        forward: (10,) coefficients of the force on the slave, from delayed signals of the master
            (channels C1 and C3).
        back: (10,) coefficients of the force on the master, from delayed signals of the slave
            (channels C2 and C4).
    """

    master_own: np.ndarray
    forward: np.ndarray
    back: np.ndarray


class SimulatedRun(NamedTuple):
    """Results of one time simulation of a teleoperator axis.

    Attributes:
        max_speeds: (20,) maximum of the sum of master's and slave's speed magnitudes in each
            twentieth of the run [m/s]; 0 after an early stop.
        impedance: complex ratio of hand force to the master's velocity at the frequency of an
            imposed motion [N s/m]; 0 without an imposed motion.
    """

    max_speeds: np.ndarray
    impedance: complex


def build_control_law(case: TeleoperatorAxis, structure: str, return_gain: float = 1.0) -> ControlLaw:
    """Build the control law of a structure, as coefficients for the time simulation.

    A control force is a sum of ten signals (positions, speeds, accelerations, hand force and their
    integrals), each multiplied by its coefficient.

    Args:
        case: parameters of the teleoperator axis.
        structure: name, one of `STRUCTURES`.
        return_gain: factor on the return channels [1].

    Returns:
        Coefficients of the control law.

    Source: Zhu 1994, 3.9-3.62, written in the time domain.
    """
    kv, gains = case.gains.velocity, case.gains
    rate = structure in ("rate_position", "rate_force", "four_channel_rate")
    forward = impedance_coefficients(case.slave_control, INT if rate else X) * (kv if rate else gains.position)
    own, back = impedance_coefficients(case.master_control, X), np.zeros(10)
    if structure in ("rate_position", "four_channel_rate"):
        own = kv * impedance_coefficients(case.master_control, INT)
    if structure in ("position_position", "rate_position", "four_channel_rate"):
        back = -impedance_coefficients(case.master_control, Y)
    if structure in ("position_force", "rate_force"):
        back = gains.force * impedance_coefficients(case.task, Y)
    if structure == "four_channel_position":
        forward = impedance_coefficients(case.slave, X) + impedance_coefficients(case.slave_control, X)
        forward[FORCE] = 1.0
        back = impedance_coefficients(case.task, Y) - impedance_coefficients(case.master, Y)
        back -= impedance_coefficients(case.master_control, Y)
    if structure == "four_channel_rate":
        forward[IMPULSE] = kv
        back = back + impedance_coefficients(case.task, W) / kv
    return ControlLaw(own, forward, return_gain * back)


def impedance_coefficients(impedance: Impedance, position_index: int) -> np.ndarray:
    """Return the coefficients (10,) that give the force of an impedance as a sum of the ten signals.

    Stiffness, damping and mass are written at `position_index` and the next two indices, those of a
    position, its speed and its acceleration. The other coefficients are 0.
    """
    made = np.zeros(10)
    made[position_index : position_index + 3] = impedance.stiffness, impedance.damping, impedance.mass
    return made


def choose_time_step(case: TeleoperatorAxis) -> float:
    """Choose a time step that resolves the fastest mode of the coupled masses [s].

    It is a fifth of the time constant of the fastest mode, at most 0.5 ms.

    Raises:
        InputError: the step would be below 2 microseconds.
    """
    parts = (case.master, case.slave, case.master_control, case.slave_control, case.hand, case.task)
    lightest = min(part.mass for part in parts if part.mass)
    rates = (
        sum(part.damping for part in parts) / lightest,
        math.sqrt(sum(part.stiffness for part in parts) / lightest),
        1.0 / _MAX_STEP * _STEP_RATIO,
    )
    step = _STEP_RATIO / max(rates)
    if step < _MIN_STEP:
        raise InputError(
            "teleoperator", f"modes are too fast to simulate: rates of {max(rates):.3g} 1/s with a"
            f" lightest mass of {lightest:g} kg; omit --confirm or give hand and sides a mass",
        )  # fmt: skip
    return step


def simulate_impulse_response(
    case: TeleoperatorAxis, structure: str, return_gain: float = 1.0, seconds: float = 40.0
) -> SimulatedRun:
    """Simulate the response to an initial velocity of the master, with hand and task.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        return_gain: factor on the return channels [1].
        seconds: duration, at least forty round-trip delays; the run stops earlier when the motion
            has decayed or has grown without bound.

    Returns:
        Largest speeds over the run; `is_growing` evaluates them.
    """
    seconds = max(seconds, _MIN_ROUND_TRIPS * 2.0 * case.delay)
    return _simulate_case(case, build_control_law(case, structure, return_gain), seconds, 0.0, 0.0)


def is_growing(run: SimulatedRun) -> bool:
    """Return whether the motion of a simulated run grows: late speeds exceed early ones.

    The largest speed in the last fifth of the run is compared with that in the second fifth. After
    an early stop the last speed is compared with the initial one.
    """
    reached = run.max_speeds[run.max_speeds > 0.0]
    if len(reached) < _BLOCKS:
        return bool(reached[-1] > _INITIAL_SPEED)
    return bool(run.max_speeds[-4:].max() > run.max_speeds[4:8].max())


def measure_sine_impedance(case: TeleoperatorAxis, structure: str, frequency: float) -> complex:
    """Measure in simulation the impedance that an operator feels at the master at one frequency.

    The master's motion is an imposed sine. The settling time is doubled until the result no longer
    changes.

    Args:
        case: teleoperator with its task.
        structure: name of the structure.
        frequency: frequency of the sine [rad/s].

    Returns:
        Complex ratio of hand force to velocity, measured over two periods [N s/m].
    """
    law, period = build_control_law(case, structure), 2.0 * math.pi / frequency
    felt = 0.0
    for settle in _SETTLING_TIMES:
        before, seconds = felt, (math.ceil(settle / period) + _MEASURED_PERIODS) * period
        felt = _simulate_case(case, law, seconds, frequency, _MEASURED_PERIODS * period).impedance
        if abs(felt - before) < _SETTLING_TOLERANCE * abs(felt):
            break
    return felt


def _simulate_case(
    case: TeleoperatorAxis, law: ControlLaw, seconds: float, frequency: float, measured_time: float
) -> SimulatedRun:
    step = choose_time_step(case)
    if frequency:  # a whole number of steps per period, so that the mean of the sine is 0
        step = 2.0 * math.pi / frequency / math.ceil(2.0 * math.pi / frequency / step)
    elif case.delay_forward >= step:  # a whole number of steps per delay
        step = case.delay_forward / math.ceil(case.delay_forward / step)
    late = np.array([case.delay_forward, case.delay_back]) / step
    late = np.where(np.abs(late - np.round(late)) < _LAG_TOLERANCE, np.round(late), late)
    late[late < 1.0] = 0.0  # a delay of less than a step is neglected
    lags = int(late[0]), int(late[1])
    now, delayed = _build_equations(case, law, lags, bool(frequency))
    inverse = np.linalg.inv(now[:, _SOLVED_SIGNALS])
    largest, sums = _integrate_case(
        inverse, inverse @ now[:, _KNOWN_SIGNALS], inverse @ delayed, np.array(lags), late - lags, step,
        round(seconds / step), round(measured_time / step), frequency,
    )  # fmt: skip
    return SimulatedRun(largest, complex(sums[0] / sums[1]) if frequency else 0.0)


def _build_equations(
    case: TeleoperatorAxis, law: ControlLaw, lags: tuple[int, int], imposed: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Build the four equations for both accelerations, hand force and slave's jerk at a time step.

    Rows: equations of motion of master, hand and slave, and the derivative of the slave's equation.
    If no force depends on the slave's jerk, the last row sets the jerk to 0. With `imposed` motion
    the second row sets the master's acceleration instead. `lags` are the delays of the forward and
    the return channel in whole steps; the signals of a channel with 0 count as present ones.

    Returns:
        Coefficients (4, 10) on the present signals, and (4, 20) on the delayed ones: ten delayed by
        the forward channel, then ten by the return channel.
    """
    own = impedance_coefficients(case.master, X) + law.master_own
    own[FORCE] -= 1.0
    hand = impedance_coefficients(case.hand, X)
    hand[FORCE] = 1.0
    if imposed:
        hand = np.eye(10)[A]
    slave = (
        impedance_coefficients(case.slave, Y)
        + impedance_coefficients(case.slave_control, Y)
        + impedance_coefficients(case.task, Y)
    )
    jerk, still = np.eye(10)[W2], np.zeros(10)
    if law.back[W2]:
        jerk, still = np.roll(slave, 1), np.roll(law.forward, 1)
    now = np.array([own, hand, slave, jerk])
    there, here = np.array([still, still, law.forward, still]), np.zeros((4, 10))
    there[:2] = 0.0
    here[0] = -law.back
    there, here = _move_undelayed_coefficients(there, here, now, lags)
    return now, np.hstack([there, here])


def _move_undelayed_coefficients(
    there: np.ndarray, here: np.ndarray, now: np.ndarray, lags: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Move the coefficients of channels without delay to the present signals in the linear equations.

    `there` and `here` are the coefficients of the forward and the return channel on the right-hand
    side. Those of a channel without delay (`lags` 0) are subtracted from the left-hand side `now`.
    Return the coefficients of both channels on delayed signals, zero for a channel without delay.
    """
    found = []
    for part, lag in zip((there, here), lags, strict=True):
        if lag == 0:
            now -= part
            part = np.zeros_like(part)
        found.append(part)
    return found[0], found[1]


@compiled
def _integrate_case(inverse, known, delayed, lags, beyond, step, rows, measured, frequency):
    """Integrate a run step by step, after an initial velocity or with an imposed sine.

    `inverse`, `known` and `delayed` are the matrices that solve for accelerations and hand force.
    `lags` (2,) are the whole and `beyond` (2,) the fractional delays of both channels in steps.
    `rows` is the number of steps, of which the last `measured` count for the sums. `frequency`
    [rad/s] is that of the imposed sine; 0 selects the initial velocity.

    Return the largest speeds (20,) of the parts of the run [m/s], and the complex Fourier sums (2,)
    of hand force and master velocity at the imposed frequency.
    """
    past = np.zeros((max(lags[0], lags[1]) + 2, 10))
    largest, sums = np.zeros(_BLOCKS), np.zeros(2, np.complex128)
    q, before, late = np.zeros(10), np.zeros(10), np.zeros(20)
    if frequency == 0.0:
        q[V] = _INITIAL_SPEED
    for n in range(rows):
        angle = frequency * step * n
        if frequency != 0.0:
            q[INT], q[X] = -math.cos(angle) / frequency, math.sin(angle)
            q[V] = frequency * math.cos(angle)
        _interpolate_delayed(past, n, lags, beyond, late)
        _solve_accelerations_and_force(q, late, inverse, known, delayed, frequency)
        past[n % len(past)] = q
        block = n * _BLOCKS // rows
        largest[block] = max(largest[block], abs(q[V]) + abs(q[W]))
        if frequency != 0.0 and n >= rows - measured:
            wave = complex(math.cos(angle), -math.sin(angle))
            sums[0] += q[FORCE] * wave
            sums[1] += q[V] * wave
        if frequency == 0.0 and n * _BLOCKS % rows < _BLOCKS and block > 0:
            if (
                largest[block - 1] < _MIN_SPEED_RATIO * _INITIAL_SPEED
                or not largest[block - 1] < _MAX_SPEED_RATIO * _INITIAL_SPEED
            ):
                break
        _advance_motion_signals(q, before, step, n == 0)
    return largest, sums


@compiled
def _interpolate_delayed(past, n, lags, beyond, late):
    """Write the delayed signals of both channels to `late` (20,), interpolated between two steps.

    `past` is the ring buffer of the ten signals by step, and n the present step. `lags` (2,) are
    the whole and `beyond` (2,) the fractional delays in steps. A channel without delay is not
    written.
    """
    for side in range(2):
        if lags[side] > 0 and n > lags[side]:
            row, share = n - lags[side], beyond[side]
            for j in range(10):
                newer, older = past[row % len(past), j], past[(row - 1) % len(past), j]
                late[10 * side + j] = newer + share * (older - newer)


@compiled
def _solve_accelerations_and_force(q, late, inverse, known, delayed, frequency):
    """Solve for both accelerations, the hand's force and the slave's jerk; write them to q (10,).

    q holds the present signals and `late` (20,) the delayed ones. `inverse`, `known` and `delayed`
    are the matrices of the solved linear equations. A `frequency` [rad/s] other than 0 imposes a
    sine.
    """
    for i in range(4):
        total = 0.0
        for j in range(20):
            total += delayed[i, j] * late[j]
        for j in range(6):
            total -= known[i, j] * q[_KNOWN_SIGNALS[j]]
        if frequency != 0.0:
            total -= inverse[i, 1] * frequency**2 * q[X]
        q[_SOLVED_SIGNALS[i]] = total  # _SOLVED and _KNOWN are disjoint


@compiled
def _advance_motion_signals(q, before, step, first):
    """Advance the simulated signals q (10,) of master, slave and hand by one time step.

    Speeds and the integral of the hand's force use the second-order Adams-Bashforth formula, positions
    and the integral of the master's position the trapezoidal rule. `before` (10,) holds accelerations
    and force of the previous step and is updated.
    """
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
