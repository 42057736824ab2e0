"""Complete analysis of a teleoperator, its check by time simulation, and the results as JSON.

The analysis covers several structures of one case: stability, maximum force-reflection ratio,
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
    LONGEST_TRIED,
    MOST_TRIED,
    Analysis,
    Case,
    analyse,
    gain_margin,
    largest_delay,
    loop_gain,
    stability_map,
)
from hydrotele.teleop.linear_case import STRUCTURES, LinearCase, local_ratio
from hydrotele.teleop.robust import Robustness
from hydrotele.teleop.switching import Spring
from hydrotele.teleop.two_port import (
    Impedance,
    OnTheAxis,
    transmitted,
    unstable_held,
    unstable_poles,
)

INT, X, V, A, IMPULSE, FORCE, Y, W, W1, W2 = range(10)
_KNOWN = np.array([INT, X, V, IMPULSE, Y, W])
_SOLVED = np.array([A, FORCE, W1, W2])
_PER_RATE = 0.2  # steps per time constant of the fastest mode; the limit of Adams' method is 1
_LARGEST = 5e-4  # s
_BLOCKS = 20  # number of parts of a run whose largest speeds are compared
_GROWN, _GONE = 1e9, 1e-9  # factors on the initial speed beyond which a run is stopped
_KICK = 0.1  # m/s
_WHOLE = 1e-6  # tolerance, in steps, for a delay that is a whole number of steps
_PERIODS = 2  # number of sine periods that are measured
_SETTLE = (20.0, 40.0, 80.0, 160.0, 320.0)  # s before a sine is measured
_SETTLED = 1e-3  # relative change of the measured impedance; the required accuracy is 3 %
_TRIPS = 40  # minimum duration of a run in round-trip delays
_FINEST = 2e-6  # s, minimum step; a run with a smaller one takes minutes


class ControlLaw(NamedTuple):
    """Coefficients of a control law on the signals (10,).

    Attributes:
        own: force of the master's own controller.
        forward: force on the slave, C1 and C3, from delayed signals.
        back: force on the master, C2 and C4, from delayed signals.
    """

    own: np.ndarray
    forward: np.ndarray
    back: np.ndarray


class SimulatedRun(NamedTuple):
    """Results of a simulated run.

    Attributes:
        largest: (20,) maximum of the sum of master's and slave's speed in each twentieth of the run
            [m/s].
        felt: force over velocity of an imposed motion at its frequency [N s/m], otherwise 0.
    """

    largest: np.ndarray
    felt: complex


def control_law(case: Case, structure: str, reflected: float = 1.0) -> ControlLaw:
    """Return the control law of a structure in the time domain.

    Args:
        case: the teleoperator.
        structure: name, one of `STRUCTURES`.
        reflected: factor on the return channels [1].

    Returns:
        Coefficients of the control law.

    Source: Zhu 1994, 3.9-3.62, written in the time domain.
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
    """Return coefficients (10,) of an impedance on a position and its two derivatives."""
    made = np.zeros(10)
    made[position : position + 3] = impedance.stiffness, impedance.damping, impedance.mass
    return made


def step_of(case: Case) -> float:
    """Return a time step that resolves the fastest mode that the masses can have together [s].

    Raises:
        InputError: the step would be too small.
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
            "teleoperator", f"modes are too fast to simulate: rates of {max(rates):.3g} 1/s with a"
            f" lightest mass of {lightest:g} kg; omit --confirm or give hand and sides a mass",
        )  # fmt: skip
    return step


def impulse_response(
    case: Case, structure: str, reflected: float = 1.0, seconds: float = 40.0
) -> SimulatedRun:
    """Simulate the response to an initial velocity of the master, with hand and task.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        reflected: factor on the return channels [1].
        seconds: duration, at least forty round-trip delays; the run stops earlier when the motion
            has decayed or has grown without bound.

    Returns:
        Results of the run.
    """
    seconds = max(seconds, _TRIPS * 2.0 * case.delay)
    return _simulated(case, control_law(case, structure, reflected), seconds, 0.0, 0.0)


def is_growing(run: SimulatedRun) -> bool:
    """Return whether the motion grows: late speeds are larger than early ones."""
    reached = run.largest[run.largest > 0.0]
    if len(reached) < _BLOCKS:
        return bool(reached[-1] > _KICK)
    return bool(run.largest[-4:].max() > run.largest[4:8].max())


def simulate_sine(case: Case, structure: str, frequency: float) -> complex:
    """Return the impedance at the master while its motion is an imposed sine.

    The settling time is increased until the result no longer changes.

    Args:
        case: teleoperator with its task.
        structure: name of the structure.
        frequency: frequency of the sine [rad/s].

    Returns:
        Force over velocity, measured over two periods [N s/m].
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
    if frequency:  # a whole number of steps per period, so that the mean of the sine is 0
        step = 2.0 * math.pi / frequency / math.ceil(2.0 * math.pi / frequency / step)
    elif case.delay_forward >= step:  # a whole number of steps per delay
        step = case.delay_forward / math.ceil(case.delay_forward / step)
    late = np.array([case.delay_forward, case.delay_back]) / step
    late = np.where(np.abs(late - np.round(late)) < _WHOLE, np.round(late), late)
    late[late < 1.0] = 0.0  # a delay of less than a step is neglected
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
    """Return coefficients (4, 10) on current and (4, 20) on delayed signals: forward, then back.

    Rows: master, hand, slave, derivative of the slave's equation. The last row is used where the
    slave's jerk is needed, and is otherwise `w'' = 0`.
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
    """Return delayed coefficients; those without delay are moved to the current signals."""
    found = []
    for part, lag in zip((there, here), lags, strict=True):
        if lag == 0:
            now -= part
            part = np.zeros_like(part)
        found.append(part)
    return found[0], found[1]


@compiled
def _march(inverse, known, delayed, lags, beyond, step, rows, measured, frequency):
    """Integrate; return largest speeds (20,) and Fourier sums of force and velocity (2,)."""
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
    """Interpolate the delayed signals between two steps."""
    for side in range(2):
        if lags[side] > 0 and n > lags[side]:
            row, share = n - lags[side], beyond[side]
            for j in range(10):
                newer, older = past[row % len(past), j], past[(row - 1) % len(past), j]
                late[10 * side + j] = newer + share * (older - newer)


@compiled
def _solve(q, late, inverse, known, delayed, frequency):
    """Solve for accelerations, the hand's force and the slave's jerk."""
    for i in range(4):
        total = 0.0
        for j in range(20):
            total += delayed[i, j] * late[j]
        for j in range(6):
            total -= known[i, j] * q[_KNOWN[j]]
        if frequency != 0.0:
            total -= inverse[i, 1] * frequency**2 * q[X]
        q[_SOLVED[i]] = total  # _SOLVED and _KNOWN are disjoint


@compiled
def _advance(q, before, step, first):
    """Advance speeds and impulse by second-order Adams-Bashforth, their integrals by trapezoids."""
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


SWEPT = 2.0 * np.pi * np.geomspace(0.1, 5.0, 9)  # rad/s, frequency range of hand motion


@dataclass(frozen=True)
class SineSweep:
    """Transmitted impedance in a simulated sine sweep.

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
    def error(self) -> float | None:
        """Largest relative error [1], None if no measurement is possible."""
        if not len(self.measured):
            return None
        return float(np.max(np.abs(self.measured / self.expected - 1.0)))


@dataclass(frozen=True)
class Agreement:
    """Predicted and simulated stability on a grid.

    Attributes:
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].
        predicted: (m, n) true where predicted stable.
        seen: (m, n) true where stable in simulation.
    """

    structure: str
    delays: np.ndarray
    factors: np.ndarray
    predicted: np.ndarray
    seen: np.ndarray

    @property
    def share(self) -> float:
        """Fraction of the grid cells with equal prediction and simulation [1]."""
        return float(np.mean(self.predicted == self.seen))


def sweep(case: Case, structure: str, frequencies: np.ndarray = SWEPT) -> SineSweep:
    """Compute the transmitted impedance and measure it with imposed sines in simulation.

    Args:
        case: teleoperator with its task.
        structure: name of the structure.
        frequencies: (n,) [rad/s].

    Returns:
        Predicted and measured impedances.
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
    """Predict and simulate stability in every cell of a stability map.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        Predicted and simulated stability.
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


Progress = Callable[[str, float], None]
_EVERY = 40  # step of the frequencies that are written to the JSON


@dataclass(frozen=True)
class Findings:
    """Results of an analysis of several structures.

    Attributes:
        name: name of the case.
        case: teleoperator with hand and task.
        analyses: one analysis per structure.
        delays: (n,) delays of the map in each direction [s].
        factors: (m,) factors of the map on the return channels [1].
        maps: structure -> (m, n), true where stable.
        spring: joystick axis with stiffness feedback, None without.
        sweeps: simulated sine sweeps, empty if not requested.
        agreements: simulated maps, empty if not requested.
        robust: robustness of every sampled structure, empty if not requested.
        period: sampling period [s].
    """

    name: str
    case: Case
    analyses: tuple[Analysis, ...]
    delays: np.ndarray
    factors: np.ndarray
    maps: dict[str, np.ndarray]
    spring: Spring | None = None
    sweeps: tuple[SineSweep, ...] = ()
    agreements: tuple[Agreement, ...] = ()
    robust: tuple[Robustness, ...] = ()
    period: float = 0.0


def find(
    name: str, case: Case, structures: tuple[str, ...], delays: np.ndarray, factors: np.ndarray,
    spring: Spring | None = None, confirm: bool = False, progress: Progress | None = None,
) -> Findings:  # fmt: skip
    """Analyse structures and, if requested, check the results by simulation.

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
        analyses.append(analyse(case, structure))
        if not confirm:
            maps[structure] = stability_map(case, structure, delays, factors)
            continue
        late = [case] if case.delay else []
        sweeps += [sweep(one, structure) for one in (case.with_delay(0.0), *late)]
        agreements.append(agreement(case, structure, delays, factors))
        maps[structure] = agreements[-1].predicted
    return Findings(
        name, case, tuple(analyses), delays, factors, maps, spring, tuple(sweeps), tuple(agreements)
    )


def why_unstable(one: Analysis, let_go: bool = False) -> str:
    """Return a short text on the stability of a structure and its unstable poles.

    Args:
        one: the analysis.
        let_go: whether to describe the released handle instead of the held one.

    Returns:
        Text such as `no, 2 poles`; `yes` if the structure is stable.
    """
    both = (one.unstable_poles, one.unstable_free)
    if let_go:
        both = (one.unstable_let_go, one.unstable_let_go_free)
    if both == (0, 0):
        return "yes"
    free = "" if both[0] != 0 else " when free"
    many = both[0] if not free else both[1]
    if many is None:
        return f"no, poles on the axis{free}"
    return f"no, {many} pole{'s' * (many != 1)}{free}"


def format_factor(margin: float) -> str:
    """Format a gain margin; an infinite one as more than the largest tested factor.

    >>> format_factor(0.17), format_factor(math.inf)
    ('x 0.17', '> x 1000')
    """
    return f"> x {MOST_TRIED:g}" if math.isinf(margin) else f"x {margin:.3g}"


def format_delay(delay: float) -> str:
    """Format a delay; an infinite one as more than the largest tested delay.

    >>> format_delay(0.12345), format_delay(math.inf)
    ('123 ms', '> 10 s')
    """
    return f"> {LONGEST_TRIED:g} s" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def format_number(value: float) -> str:
    """Format a number with five digits, without an exponent.

    >>> format_number(-20026.0), format_number(0.0123456)
    ('-20026', '0.012346')
    """
    return np.format_float_positional(value, precision=5, fractional=False, trim="-")


def format_error(error: float | None) -> str:
    """Format a relative error.

    >>> format_error(0.0016), format_error(1e-7)
    ('0.16 %', '< 0.01 %')
    """
    if error is None:
        return "not measurable"
    return "< 0.01 %" if error < 1e-4 else f"{100.0 * error:.2g} %"


def findings_document(found: Findings) -> dict:
    """Convert the results to plain data; infinite if no tested value changes stability.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary; complex numbers are pairs of real and imaginary part.
    """
    case = found.case
    document = {
        "name": found.name,
        "delay": {"forward": case.delay_forward, "back": case.delay_back},
        "structures": {one.structure: _analysis(one) for one in found.analyses},
        "map": {
            "delay": found.delays, "factor": found.factors,
            "stable": {name: cells.astype(bool).tolist() for name, cells in found.maps.items()},
        },
    }  # fmt: skip
    if found.spring:
        pair = {"held": found.spring.held(case.hand), "let_go": found.spring}
        document["stiffness_feedback"] = {name: _spring(one) for name, one in pair.items()}
    if found.robust:
        document["robust"] = {
            "period": found.period,
            "structures": {one.structure: _robust(one) for one in found.robust},
        }
    if found.agreements:
        document["confirmed"] = {
            "sweeps": [_sweep(one) for one in found.sweeps],
            "agreement": {one.structure: one.share for one in found.agreements},
        }
    return document


def _analysis(one: Analysis) -> dict:
    at = slice(None, None, _EVERY)
    worst = int(np.argmax(one.scattering))
    return {
        "stable": one.stable,
        "unstable_poles": one.unstable_poles,
        "unstable_poles_free": one.unstable_free,
        "stable_let_go": one.stable_let_go,
        "unstable_poles_let_go": one.unstable_let_go,
        "unstable_poles_let_go_free": one.unstable_let_go_free,
        "gain_margin": one.gain_margin,
        "largest_delay": one.largest_delay,
        "passive": one.passive,
        "scattering_peak": one.scattering[worst],
        "scattering_peak_frequency": one.frequencies[worst],
        "frequency": one.frequencies[at],
        "hybrid": _pairs(one.hybrid[at]),
        "transmitted": _pairs(one.transmitted[at]),
        "task": _pairs(one.task[at]),
        "scattering": one.scattering[at],
        "loop": _pairs(one.loop[at]),
    }


def _robust(one: Robustness) -> dict:
    names = ("held_task", "held_free", "let_go_task", "let_go_free")
    document = {
        "absolutely_stable": one.absolutely_stable,
        "llewellyn": one.llewellyn,
        "sampled": {
            name: {"stable": told.stable, "reason": told.reason}
            for name, told in zip(names, one.sampled, strict=True)
        },
        "drawn": {
            "pairs": one.worst.pairs, "unstable": one.worst.unstable,
            "unstable_let_go": one.worst.unstable_let_go, "worst_growth_rate": one.worst.rate,
            "worst_hand": vars(one.worst.hand), "worst_task": vars(one.worst.task),
        },
    }  # fmt: skip
    if one.width:
        document["z_width"] = {
            "decades": one.width.decades, "stiffest_task_held": one.width.stiffest_held,
            "stiffest_task_let_go": one.width.stiffest_let_go,
            "stiffest_tried": one.width.most_tried,
        }  # fmt: skip
    if one.released:
        document["master_let_go"] = {
            "coefficients": one.released.coefficients, "unstable_poles": one.released.unstable,
        }  # fmt: skip
    return document


def _pairs(values: np.ndarray) -> list:
    return np.stack([np.real(values), np.imag(values)], axis=-1).tolist()


def _spring(one: Spring) -> dict:
    return {
        "mass": one.mass, "damping": one.damping, "least": one.least, "most": one.most,
        "margin": one.margin, "damping_asked": one.enough_damping, "worst_growth": one.growth,
        "least_damping": one.least_damping, "stable_by": one.stable_by,
    }  # fmt: skip


def _sweep(one: SineSweep) -> dict:
    return {
        "structure": one.structure, "delay_forward": one.delay_forward,
        "delay_back": one.delay_back, "error": one.error, "frequency": one.frequencies,
        "expected": _pairs(one.expected), "measured": _pairs(one.measured),
    }  # fmt: skip


def deadband_share(deadband: float, amplitude: float) -> float:
    """Return the gain of a dead band for a centred sine, relative to its slope outside the band.

    A loop that is unstable with the full slope still comes to rest inside the dead band. It can
    sustain an oscillation at which this factor reduces the loop gain to the stability limit.

    Args:
        deadband: half width d of the band, scalar [m] or [rad].
        amplitude: amplitude A of the sine, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a sine inside the band.

    Source: describing function of a dead zone; Gelb and Vander Velde 1968, appendix B.

    >>> round(deadband_share(1.5e-3, 5.0e-3), 3), deadband_share(2.0, 1.0)
    (0.624, 0.0)
    """
    ratio = deadband / amplitude
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio**2))


_NAMES = {
    ("direct_force", "rate"): "rate_force",
    ("direct_force", "position"): "position_force",
    ("coordinating_force", "rate"): "rate_position",
    ("coordinating_force", "position"): "position_position",
}
_CASE = "analyse a case file: hydrotele analyse teleop CASE.yaml --structure "
_UNLINEAR = {
    "four_channel": (
        "its slave moves by an observed hand force, which is not modelled for a machine",
        _CASE + "four_channel_{}",
    ),
    "wave_variables": (
        "its channel transmits a wave only as far as received energy permits",
        _CASE + "wave_variables --robust",
    ),
    "passivity_control": (
        "its channel adds damping in proportion to the missing energy",
        _CASE + "passivity_control --robust",
    ),
    "impedance": (
        "the displayed stiffness is identified online and changes",
        "analyse it with pilot.reflection=direct_force, or simulate it: hydrotele run",
    ),
}  # reflection: reason why it has no linear case, and the alternative
_SEARCHED = 2.0 * np.pi * np.geomspace(0.02, 40.0, 4000)  # rad/s
_STEPS, _NEWTON = 80, 8


@dataclass(frozen=True)
class LoopFindings:
    """Results of the analysis of one structure of a scenario.

    structure: name of the structure.
    own: whether it is the scenario's structure; otherwise direct force reflection replaces it.
    unstable_poles: number of unstable poles with the task; None if poles lie on the imaginary
        axis.
    gain_margin: factor on the return channels up to which the loop is stable.
    largest_delay: maximum delay in each direction [s].
    frequency: frequency of the oscillation at the margin [Hz]; NaN without a margin.
    pole: pole of that oscillation at the present gain [rad/s]; NaN without a margin.
    largest_ratio: maximum stable ratio of hand force to machine force [N/N]; NaN if no force is
        reflected.
    hand_force: hand force at the machine's force limit with that ratio [N], [N m].
    ratio_with_deadband: maximum stable ratio for an oscillation of the handle from stop to stop,
        with the reduced gain of the dead band [N/N]; NaN without a dead band.
    """

    structure: str
    own: bool
    unstable_poles: int | None
    gain_margin: float
    largest_delay: float
    frequency: float
    pole: complex
    largest_ratio: float
    hand_force: float
    ratio_with_deadband: float

    @property
    def stable(self) -> bool:
        """Whether no pole lies in the right half-plane."""
        return self.unstable_poles == 0


@dataclass(frozen=True)
class ScenarioFindings:
    """Results of the analysis of a scenario.

    Attributes:
        name: name of the scenario.
        case: linear case of the scenario.
        task_source: source of the task's parameters.
        loop: results of the scenario's structure, or of direct force reflection in its place.
        held: joystick axis under stiffness feedback, with the hand.
        free: joystick axis under stiffness feedback, released.
        edge_ratio: reflection ratio of stiffness feedback at the dead band's edge [N/N].
    """

    name: str
    case: LinearCase
    task_source: str
    loop: LoopFindings
    held: Spring
    free: Spring
    edge_ratio: float


def find_loop(name: str, case: LinearCase, task_source: str) -> ScenarioFindings:
    """Analyse the linear case of a scenario.

    Args:
        name: name of the scenario.
        case: linear case of the scenario.
        task_source: source of the task's parameters.

    Returns:
        Results of the analysis.

    Raises:
        InputError: the structure has no linear case.

    Source: Zhu 1994, chapters 3 and 4.
    """
    reflection, mode = case.pilot.reflection, case.pilot.mode
    if reflection in _UNLINEAR:
        why, instead = _UNLINEAR[reflection]
        message = f"{reflection!r} of a scenario has no linear case, because {why}"
        raise InputError("pilot.reflection", f"{message}; {instead.format(mode)}")
    own = (reflection, mode) in _NAMES
    structure = _NAMES.get((reflection, mode), f"{mode}_force")
    spring = case.spring
    return ScenarioFindings(
        name, case, task_source, structure_findings(case, structure, own), spring.held(case.held),
        spring, local_ratio(case, case.deadband),
    )  # fmt: skip


def structure_findings(case: LinearCase, structure: str, own: bool = True) -> LoopFindings:
    """Analyse one structure of a case; see `LoopFindings`.

    Raises:
        InputError: the structure is not known.
    """
    if structure not in STRUCTURES:
        raise InputError("structure", f"{structure!r}; known: {', '.join(STRUCTURES)}")
    try:
        many = unstable_poles(case.port(structure), case.hand, case.task)
    except OnTheAxis:
        many = None
    margin = gain_margin(case, structure)
    frequency, pole = _swing(case, structure, margin)
    ratio = passing = math.nan
    if structure.endswith("force"):
        ratio = margin * case.ratio
        share = deadband_share(case.deadband, case.reach)
        passing = ratio / share if structure == "rate_force" and share > 0.0 else math.nan
    return LoopFindings(
        structure, own, many, margin, largest_delay(case, structure), frequency, pole, ratio,
        ratio * case.force_limit, passing,
    )  # fmt: skip


def _swing(case: LinearCase, structure: str, margin: float) -> tuple[float, complex]:
    """Return the oscillation frequency at the margin [Hz], and its pole at the present gain."""
    if not 0.0 < margin < math.inf:
        return math.nan, complex(math.nan, math.nan)

    def returned(s: complex | np.ndarray, factor: float) -> np.ndarray:
        return 1.0 + loop_gain(case.port(structure, factor), s, case.hand, case.task)

    place = int(np.argmin(np.abs(returned(1j * _SEARCHED, margin))))
    s = 1j * float(_SEARCHED[place])
    for factor in np.geomspace(margin, 1.0, _STEPS):
        for _ in range(_NEWTON):
            step = 1e-6 * abs(s)
            here = complex(returned(s, factor))
            slope = (complex(returned(s + step, factor)) - here) / step
            s -= here / slope
    return float(_SEARCHED[place]) / (2.0 * math.pi), s


def loop_document(found: ScenarioFindings) -> dict:
    """Convert the results to plain data in SI units; missing values are infinite or NaN.

    Args:
        found: results of the analysis.

    Returns:
        A dictionary.
    """
    case, loop, tip = found.case, found.loop, found.case.tip
    springs = {"held": found.held, "let_go": found.free}
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
            "name": loop.structure, "of_the_scenario": loop.own, "stable": loop.stable,
            "unstable_poles": loop.unstable_poles, "gain_margin": loop.gain_margin,
            "largest_delay": loop.largest_delay, "frequency": loop.frequency,
            "pole": [loop.pole.real, loop.pole.imag], "ratio": case.ratio,
            "largest_ratio": loop.largest_ratio, "force_limit": case.force_limit,
            "hand_force_at_limit": loop.hand_force,
            "largest_ratio_with_deadband": loop.ratio_with_deadband,
        },
        "stiffness_feedback": {
            "ratio_at_deadband_edge": found.edge_ratio,
            **{
                name: {
                    "mass": one.mass, "damping": one.damping, "most": one.most,
                    "margin": one.margin, "damping_asked": one.enough_damping,
                    "worst_growth": one.growth, "least_damping": one.least_damping,
                    "stable_by": one.stable_by,
                }
                for name, one in springs.items()
            },
        },
    }  # fmt: skip
