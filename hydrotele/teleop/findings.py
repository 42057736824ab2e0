"""Complete analysis of a teleoperator, its check by time simulation, and the results as JSON.

A structure is a choice of signals that master and slave exchange, such as position forward and force
back. The analysis covers several structures of one case: stability, maximum force-reflection ratio,
maximum delay and the stability theorem of stiffness feedback. A scenario is analysed through its
linear case. The describing function of a dead band gives its effect on the loop gain.

The time simulation checks the linear predictions. It integrates two masses, master and slave with
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
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.teleop.analysis import (
    MAX_TESTED_DELAY,
    MAX_TESTED_FACTOR,
    StructureAnalysis,
    TeleoperatorAxis,
    analyse_structure,
    find_gain_margin,
    find_max_delay,
    loop_gain,
    stability_map,
)
from hydrotele.teleop.linear_case import STRUCTURES, LinearCase, stiffness_feedback_ratio
from hydrotele.teleop.robust import Robustness
from hydrotele.teleop.switching import StiffnessAxis
from hydrotele.teleop.two_port import (
    Impedance,
    PoleOnAxisError,
    count_unstable_poles,
    count_unstable_poles_held,
    transmitted_impedance,
)

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
        max_speeds: (20,) maximum of the sum of master's and slave's speed in each twentieth of the run
            [m/s].
        impedance: force over velocity of an imposed motion at its frequency [N s/m], otherwise 0.
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

    After an early stop the last speed is compared with the initial one.
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
    the second row sets the master's acceleration instead.

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

    Return the largest speeds (20,) of the parts of the run [m/s], and the complex Fourier sums (2,) of
    hand force and velocity at the imposed frequency.
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
    """Write the delayed signals of both channels to `late` (20,), interpolated between two steps."""
    for side in range(2):
        if lags[side] > 0 and n > lags[side]:
            row, share = n - lags[side], beyond[side]
            for j in range(10):
                newer, older = past[row % len(past), j], past[(row - 1) % len(past), j]
                late[10 * side + j] = newer + share * (older - newer)


@compiled
def _solve_accelerations_and_force(q, late, inverse, known, delayed, frequency):
    """Solve for both accelerations, the hand's force and the slave's jerk; write them to q (10,)."""
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


SWEEP_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.1, 5.0, 9)  # rad/s, frequency range of hand motion


@dataclass(frozen=True)
class SineSweep:
    """Impedance that is transmitted to the operator, from the formula and from simulated sines.

    Attributes:
        structure: name of the structure.
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
        frequencies: (n,) [rad/s].
        expected: (n,) predicted by the formula [N s/m].
        measured: (n,) measured in simulation [N s/m]; empty if the slave is unstable while the
            master is held, so that no measurement is possible.
    """

    structure: str
    delay_forward: float
    delay_back: float
    frequencies: np.ndarray
    expected: np.ndarray
    measured: np.ndarray

    @property
    def max_relative_error(self) -> float | None:
        """Largest difference of measured and predicted impedance, relative to the latter [1].

        None if no measurement is possible.
        """
        if not len(self.measured):
            return None
        return float(np.max(np.abs(self.measured / self.expected - 1.0)))


@dataclass(frozen=True)
class StabilityComparison:
    """Predicted and simulated stability on a grid of delays and factors on the return channels.

    Attributes:
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].
        predicted: (m, n) true where predicted stable.
        simulated: (m, n) true where stable in simulation.
    """

    structure: str
    delays: np.ndarray
    factors: np.ndarray
    predicted: np.ndarray
    simulated: np.ndarray

    @property
    def agreement_fraction(self) -> float:
        """Fraction of the grid cells in which linear prediction and simulation agree [1]."""
        return float(np.mean(self.predicted == self.simulated))


def run_sine_sweep(case: TeleoperatorAxis, structure: str, frequencies: np.ndarray = SWEEP_FREQUENCIES) -> SineSweep:
    """Compute the impedance transmitted to the operator, and measure it in simulation with sines.

    Args:
        case: teleoperator with its task.
        structure: name of the structure.
        frequencies: (n,) [rad/s].

    Returns:
        Predicted and measured impedances.
    """
    port = case.make_port(structure)
    expected = transmitted_impedance(port, 1j * frequencies, case.task)
    measured = []
    if count_unstable_poles_held(port, case.task) == 0:
        measured = [measure_sine_impedance(case, structure, float(w)) for w in frequencies]
    return SineSweep(structure, case.delay_forward, case.delay_back, frequencies, expected, np.array(measured))


def compare_stability(
    case: TeleoperatorAxis, structure: str, delays: np.ndarray, factors: np.ndarray
) -> StabilityComparison:
    """Predict stability linearly and by simulation, for all pairs of a delay and a return gain.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        Predicted and simulated stability.
    """
    seen = [
        [not is_growing(simulate_impulse_response(case.with_delay(float(t)), structure, float(k))) for t in delays]
        for k in factors
    ]
    predicted = stability_map(case, structure, delays, factors)
    return StabilityComparison(structure, delays, factors, predicted, np.array(seen))


Progress = Callable[[str, float], None]
_JSON_FREQUENCY_STEP = 40  # step of the frequencies that are written to the JSON


@dataclass(frozen=True)
class TeleopFindings:
    """Results of the analysis of a case file with several control structures.

    Attributes:
        name: name of the case.
        case: teleoperator with hand and task.
        analyses: one analysis per structure.
        delays: (n,) delays of the map in each direction [s].
        factors: (m,) factors of the map on the return channels [1].
        maps: structure -> (m, n), true where stable.
        spring: joystick axis with stiffness feedback, None without.
        sweeps: simulated sine sweeps, empty if not requested.
        agreements: predicted and simulated maps, empty if not requested.
        robustness_results: robustness of every sampled structure, empty if not requested.
        period: sampling period [s].
    """

    name: str
    case: TeleoperatorAxis
    analyses: tuple[StructureAnalysis, ...]
    delays: np.ndarray
    factors: np.ndarray
    maps: dict[str, np.ndarray]
    spring: StiffnessAxis | None = None
    sweeps: tuple[SineSweep, ...] = ()
    agreements: tuple[StabilityComparison, ...] = ()
    robustness_results: tuple[Robustness, ...] = ()
    period: float = 0.0


def analyse_structures(
    name: str, case: TeleoperatorAxis, structures: tuple[str, ...], delays: np.ndarray, factors: np.ndarray,
    spring: StiffnessAxis | None = None, confirm: bool = False, progress: Progress | None = None,
) -> TeleopFindings:  # fmt: skip
    """Analyse several control structures of a case and, if requested, check them by simulation.

    Args:
        name: name of the case.
        case: teleoperator with hand and task.
        structures: names of the structures.
        delays: (n,) delays of the map in each direction [s].
        factors: (m,) factors of the map on the return channels [1].
        spring: joystick axis with stiffness feedback, None without.
        confirm: whether to simulate sine sweeps, with and without the case's delays, and every cell
            of the map.
        progress: called with the structure and the completed fraction.

    Returns:
        Results of all structures.

    Raises:
        InputError: a structure is not known, or neither master nor slave has a mass.
    """
    analyses, maps, sweeps, agreements = [], {}, [], []
    for n, structure in enumerate(structures):
        if progress:
            progress(structure, n / len(structures))
        analyses.append(analyse_structure(case, structure))
        if not confirm:
            maps[structure] = stability_map(case, structure, delays, factors)
            continue
        late = [case] if case.delay else []
        sweeps += [run_sine_sweep(one, structure) for one in (case.with_delay(0.0), *late)]
        agreements.append(compare_stability(case, structure, delays, factors))
        maps[structure] = agreements[-1].predicted
    return TeleopFindings(name, case, tuple(analyses), delays, factors, maps, spring, tuple(sweeps), tuple(agreements))


def describe_stability(analysis: StructureAnalysis, released: bool = False) -> str:
    """Return a short text that states whether a structure is stable, with its unstable poles.

    Args:
        analysis: results of the linear analysis of the structure.
        released: whether to describe the released handle instead of the held one.

    Returns:
        Text such as `no, 2 poles`; `yes` if the structure is stable.
    """
    both = (analysis.unstable_poles, analysis.unstable_poles_free)
    if released:
        both = (analysis.unstable_poles_released, analysis.unstable_poles_released_free)
    if both == (0, 0):
        return "yes"
    free = "" if both[0] != 0 else " when free"
    many = both[0] if not free else both[1]
    if many is None:
        return f"no, poles on the axis{free}"
    return f"no, {many} pole{'s' * (many != 1)}{free}"


def format_gain_margin(margin: float) -> str:
    """Format a gain margin as a factor; an infinite one as more than the largest tested factor.

    >>> format_gain_margin(0.17), format_gain_margin(math.inf)
    ('x 0.17', '> x 1000')
    """
    return f"> x {MAX_TESTED_FACTOR:g}" if math.isinf(margin) else f"x {margin:.3g}"


def format_delay(delay: float) -> str:
    """Format a maximum stable delay [s]; an infinite one as more than the largest tested delay.

    >>> format_delay(0.12345), format_delay(math.inf)
    ('123 ms', '> 10 s')
    """
    return f"> {MAX_TESTED_DELAY:g} s" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def format_number(value: float) -> str:
    """Format a number with five significant digits, without an exponent.

    >>> format_number(-20026.0), format_number(0.0123456)
    ('-20026', '0.012346')
    """
    return np.format_float_positional(value, precision=5, fractional=False, trim="-")


def format_relative_error(error: float | None) -> str:
    """Format a relative error in per cent; `not measurable` for None.

    >>> format_relative_error(0.0016), format_relative_error(1e-7)
    ('0.16 %', '< 0.01 %')
    """
    if error is None:
        return "not measurable"
    return "< 0.01 %" if error < 1e-4 else f"{100.0 * error:.2g} %"


def findings_to_dict(found: TeleopFindings) -> dict:
    """Convert the results of a case file to a dictionary for JSON.

    Margins are infinite if no tested value changes stability.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary in SI units; complex numbers are pairs of real and imaginary part.
    """
    case = found.case
    document = {
        "name": found.name,
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structures": {one.structure: _analysis_to_dict(one) for one in found.analyses},
        "map": {
            "delay": found.delays, "factor": found.factors,
            "stable": {name: cells.astype(bool).tolist() for name, cells in found.maps.items()},
        },
    }  # fmt: skip
    if found.spring:
        pair = {"held": found.spring.with_hand(case.hand), "released": found.spring}
        document["stiffness_feedback"] = {name: _spring_to_dict(one) for name, one in pair.items()}
    if found.robustness_results:
        document["robust"] = {
            "period": found.period,
            "structures": {one.structure: _robustness_to_dict(one) for one in found.robustness_results},
        }
    if found.agreements:
        document["confirmed"] = {
            "sweeps": [_sweep_to_dict(one) for one in found.sweeps],
            "agreement": {one.structure: one.agreement_fraction for one in found.agreements},
        }
    return document


def _analysis_to_dict(one: StructureAnalysis) -> dict:
    at = slice(None, None, _JSON_FREQUENCY_STEP)
    worst = int(np.argmax(one.scattering_norms))
    return {
        "stable": one.is_stable_held,
        "unstable_poles": one.unstable_poles,
        "unstable_poles_free": one.unstable_poles_free,
        "stable_released": one.is_stable_released,
        "unstable_poles_released": one.unstable_poles_released,
        "unstable_poles_released_free": one.unstable_poles_released_free,
        "gain_margin": one.gain_margin,
        "max_delay": one.max_delay,
        "passive": one.has_passive_port,
        "scattering_peak": one.scattering_norms[worst],
        "scattering_peak_frequency": one.frequencies[worst],
        "frequency": one.frequencies[at],
        "hybrid": _complex_to_pairs(one.hybrid_matrices[at]),
        "transmitted": _complex_to_pairs(one.transmitted_impedance[at]),
        "task": _complex_to_pairs(one.task_impedance[at]),
        "scattering": one.scattering_norms[at],
        "loop": _complex_to_pairs(one.loop_gains[at]),
    }


def _robustness_to_dict(one: Robustness) -> dict:
    names = ("held_task", "held_free", "released_task", "released_free")
    document = {
        "absolutely_stable": one.has_absolute_stability,
        "llewellyn": one.llewellyn,
        "sampled": {
            name: {"stable": told.is_stable, "reason": told.reason}
            for name, told in zip(names, one.sampled, strict=True)
        },
        "sampled_pairs": {
            "pairs": one.sampled_pairs.pair_count, "unstable": one.sampled_pairs.unstable_count,
            "unstable_released": one.sampled_pairs.unstable_released_count,
            "worst_growth_rate": one.sampled_pairs.worst_growth_rate,
            "worst_hand": vars(one.sampled_pairs.worst_hand), "worst_task": vars(one.sampled_pairs.worst_task),
        },
    }  # fmt: skip
    if one.z_width_result:
        document["z_width"] = {
            "decades": one.z_width_result.mean_width_decades,
            "max_stiffness_held": one.z_width_result.max_stiffness_held,
            "max_stiffness_released": one.z_width_result.max_stiffness_released,
            "max_tested_stiffness": one.z_width_result.max_tested_stiffness,
        }  # fmt: skip
    if one.released_polynomial:
        document["released_master"] = {
            "coefficients": one.released_polynomial.coefficients,
            "unstable_poles": one.released_polynomial.unstable_zeros,
        }  # fmt: skip
    return document


def _complex_to_pairs(values: np.ndarray) -> list:
    return np.stack([np.real(values), np.imag(values)], axis=-1).tolist()


def _spring_to_dict(one: StiffnessAxis) -> dict:
    return {
        "mass": one.mass, "damping": one.damping, "min_stiffness": one.min_stiffness,
        "max_stiffness": one.max_stiffness, "margin": one.stability_theorem_margin,
        "theorem_damping": one.stability_theorem_damping, "worst_growth": one.half_swing_growth,
        "min_stable_damping": one.min_stable_damping, "stable_by": one.stability_criterion,
    }  # fmt: skip


def _sweep_to_dict(one: SineSweep) -> dict:
    return {
        "structure": one.structure, "delay_forward": one.delay_forward,
        "delay_back": one.delay_back, "error": one.max_relative_error, "frequency": one.frequencies,
        "expected": _complex_to_pairs(one.expected), "measured": _complex_to_pairs(one.measured),
    }  # fmt: skip


def deadband_gain(deadband: float, amplitude: float) -> float:
    """Return the describing function of a dead band: its gain for a centred sine.

    The gain is relative to the slope outside the band.

    A loop that is unstable with the full slope still comes to rest inside the dead band. It can
    sustain an oscillation at which this factor reduces the loop gain to the stability limit.

    Args:
        deadband: half width d of the band, scalar [m] or [rad].
        amplitude: amplitude A of the sine, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a sine inside the band.

    Source: describing function of a dead zone; Gelb and Vander Velde 1968, appendix B.

    >>> round(deadband_gain(1.5e-3, 5.0e-3), 3), deadband_gain(2.0, 1.0)
    (0.624, 0.0)
    """
    ratio = deadband / amplitude
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio**2))


_STRUCTURE_NAMES = {
    ("direct_force", "rate"): "rate_force",
    ("direct_force", "position"): "position_force",
    ("coordinating_force", "rate"): "rate_position",
    ("coordinating_force", "position"): "position_position",
}
_CASE_FILE_HINT = "analyse a case file: hydrotele analyse teleop CASE.yaml --structure "
_NONLINEAR_REFLECTIONS = {
    "four_channel": (
        "its slave moves by an observed hand force, which is not modelled for a machine",
        _CASE_FILE_HINT + "four_channel_{}",
    ),
    "wave_variables": (
        "its channel transmits a wave only as far as received energy permits",
        _CASE_FILE_HINT + "wave_variables --robust",
    ),
    "passivity_control": (
        "its channel adds damping in proportion to the missing energy",
        _CASE_FILE_HINT + "passivity_control --robust",
    ),
    "impedance": (
        "the displayed stiffness is identified online and changes",
        "analyse it with pilot.reflection=direct_force, or simulate it: hydrotele run",
    ),
}  # reflection: reason why it has no linear case, and the alternative
_SEARCH_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.02, 40.0, 4000)  # rad/s
_CONTINUATION_STEPS, _NEWTON_STEPS = 80, 8


@dataclass(frozen=True)
class LoopFindings:
    """Stability results of the linear loop of a scenario with one control structure.

    Attributes:
        structure: name of the structure.
        is_scenario_structure: whether it is the scenario's structure; otherwise direct force
            reflection replaces it.
        unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
            axis.
        gain_margin: factor on the return channels up to which the loop is stable.
        max_delay: maximum stable delay in each direction [s].
        frequency: frequency of the oscillation at the margin [Hz]; NaN without a margin.
        pole: pole of that oscillation at the present gain [rad/s]; NaN without a margin.
        max_ratio: maximum stable ratio of hand force to machine force [N/N]; NaN if no force is
            reflected.
        hand_force: hand force at the machine's force limit with that ratio [N], [N m].
        max_ratio_with_deadband: maximum stable ratio for an oscillation of the handle from stop to
            stop, with the reduced gain of the dead band [N/N]; NaN without a dead band.
    """

    structure: str
    is_scenario_structure: bool
    unstable_poles: int | None
    gain_margin: float
    max_delay: float
    frequency: float
    pole: complex
    max_ratio: float
    hand_force: float
    max_ratio_with_deadband: float

    @property
    def is_stable(self) -> bool:
        """Whether no pole lies in the right half-plane."""
        return self.unstable_poles == 0


@dataclass(frozen=True)
class ScenarioFindings:
    """Results of the linear stability analysis of a teleoperated scenario.

    Attributes:
        name: name of the scenario.
        case: linear case of the scenario.
        task_source: source of the task's parameters.
        loop: results of the scenario's structure, or of direct force reflection in its place.
        held_spring: joystick axis under stiffness feedback, with the hand.
        released_spring: joystick axis under stiffness feedback, released.
        deadband_edge_ratio: reflection ratio of stiffness feedback at the dead band's edge [N/N].
    """

    name: str
    case: LinearCase
    task_source: str
    loop: LoopFindings
    held_spring: StiffnessAxis
    released_spring: StiffnessAxis
    deadband_edge_ratio: float


def analyse_scenario_case(name: str, case: LinearCase, task_source: str) -> ScenarioFindings:
    """Analyse the stability of a teleoperated scenario from its linear model.

    Args:
        name: name of the scenario.
        case: linear model of hand, joystick, machine and task along one coordinate.
        task_source: text that states where the task's parameters come from.

    Returns:
        Stability of the loop, and of the joystick axis under stiffness feedback.

    Raises:
        InputError: the force reflection of the scenario has no linear model.

    Source: Zhu 1994, chapters 3 and 4.
    """
    reflection, mode = case.pilot.reflection, case.pilot.mode
    if reflection in _NONLINEAR_REFLECTIONS:
        why, instead = _NONLINEAR_REFLECTIONS[reflection]
        message = f"{reflection!r} of a scenario has no linear case, because {why}"
        raise InputError("pilot.reflection", f"{message}; {instead.format(mode)}")
    own = (reflection, mode) in _STRUCTURE_NAMES
    structure = _STRUCTURE_NAMES.get((reflection, mode), f"{mode}_force")
    spring = case.spring
    return ScenarioFindings(
        name, case, task_source, analyse_scenario_loop(case, structure, own), spring.with_hand(case.hand_impedance),
        spring, stiffness_feedback_ratio(case, case.deadband),
    )  # fmt: skip


def analyse_scenario_loop(case: LinearCase, structure: str, is_scenario_structure: bool = True) -> LoopFindings:
    """Compute poles, margins and the largest stable reflection ratio of a scenario's linear loop.

    Args:
        case: linear model of hand, joystick, machine and task.
        structure: control structure, one of `linear_case.STRUCTURES`.
        is_scenario_structure: whether the scenario uses this structure; it is only recorded.

    Raises:
        InputError: the structure is not known.
    """
    if structure not in STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(STRUCTURES)}")
    try:
        many = count_unstable_poles(case.make_port(structure), case.hand, case.task)
    except PoleOnAxisError:
        many = None
    margin = find_gain_margin(case, structure)
    frequency, pole = _find_oscillation(case, structure, margin)
    ratio = passing = math.nan
    if structure.endswith("force"):
        ratio = margin * case.ratio
        share = deadband_gain(case.deadband, case.reach)
        passing = ratio / share if structure == "rate_force" and share > 0.0 else math.nan
    return LoopFindings(
        structure, is_scenario_structure, many, margin, find_max_delay(case, structure), frequency, pole, ratio,
        ratio * case.force_limit, passing,
    )  # fmt: skip


def _find_oscillation(case: LinearCase, structure: str, margin: float) -> tuple[float, complex]:
    """Return the oscillation frequency at the stability limit, and its pole at the present gain.

    The pole is followed from the gain at the limit, `margin` times the present one, by Newton's
    method. Return frequency [Hz] and pole [rad/s]; both are NaN without a finite margin.
    """
    if not 0.0 < margin < math.inf:
        return math.nan, complex(math.nan, math.nan)

    def evaluate_characteristic_function(s: complex | np.ndarray, factor: float) -> np.ndarray:
        return 1.0 + loop_gain(case.make_port(structure, factor), s, case.hand, case.task)

    place = int(np.argmin(np.abs(evaluate_characteristic_function(1j * _SEARCH_FREQUENCIES, margin))))
    s = 1j * float(_SEARCH_FREQUENCIES[place])
    for factor in np.geomspace(margin, 1.0, _CONTINUATION_STEPS):
        for _ in range(_NEWTON_STEPS):
            step = 1e-6 * abs(s)
            here = complex(evaluate_characteristic_function(s, factor))
            slope = (complex(evaluate_characteristic_function(s + step, factor)) - here) / step
            s -= here / slope
    return float(_SEARCH_FREQUENCIES[place]) / (2.0 * math.pi), s


def scenario_findings_to_dict(found: ScenarioFindings) -> dict:
    """Convert the results of a scenario's analysis to a dictionary for JSON, in SI units.

    Values that do not exist are infinite or NaN.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary.
    """
    case, loop, tip = found.case, found.loop, found.case.tip
    springs = {"held": found.held_spring, "released": found.released_spring}
    return {
        "name": found.name,
        "coordinate": tip.coordinate,
        "reflection": case.pilot.reflection,
        "mode": case.pilot.mode,
        "machine": {"mass": tip.mass, "hydraulic_stiffness": tip.stiffness},
        "task": {
            "mass": case.task.mass, "damping": case.task.damping,
            "stiffness": case.task.stiffness, "source": found.task_source,
        },
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structure": {
            "name": loop.structure, "of_the_scenario": loop.is_scenario_structure, "stable": loop.is_stable,
            "unstable_poles": loop.unstable_poles, "gain_margin": loop.gain_margin,
            "max_delay": loop.max_delay, "frequency": loop.frequency,
            "pole": [loop.pole.real, loop.pole.imag], "ratio": case.ratio,
            "max_ratio": loop.max_ratio, "force_limit": case.force_limit,
            "hand_force_at_limit": loop.hand_force,
            "max_ratio_with_deadband": loop.max_ratio_with_deadband,
        },
        "stiffness_feedback": {
            "ratio_at_deadband_edge": found.deadband_edge_ratio,
            **{
                name: {
                    "mass": one.mass, "damping": one.damping, "max_stiffness": one.max_stiffness,
                    "margin": one.stability_theorem_margin, "theorem_damping": one.stability_theorem_damping,
                    "worst_growth": one.half_swing_growth, "min_stable_damping": one.min_stable_damping,
                    "stable_by": one.stability_criterion,
                }
                for name, one in springs.items()
            },
        },
    }  # fmt: skip
