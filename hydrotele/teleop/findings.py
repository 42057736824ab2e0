"""Everything that an analysis of a teleoperator finds, and the same as JSON.

What the linear case of a scenario says: stability, largest reflection and delay, the theorem.

A dead band in a loop: what share of a swing passes it.

Linear predictions against the simulated two masses: what is felt, and what is stable.

Two masses in time: master and slave with their channels, as differential equations with delay.

A case is written as signals and coefficients. The signals are the master's position, its integral
and derivatives, the hand's force and its integral, and the slave's position and its derivatives:

`q = [int x, x, v, a, int F_h, F_h, y, w, w', w'']`

so that a derivative moves coefficients one place. Accelerations, the hand's force and the slave's
jerk follow from the others and from delayed signals by four linear equations, which also solves the
algebraic loops of a structure without delay. Independent of `stability`, which it confirms.
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


Progress = Callable[[str, float], None]
_EVERY = 40  # frequency that goes into the JSON


@dataclass(frozen=True)
class Findings:
    """What was found.

    Attributes:
        name: of the case.
        case: the teleoperator with hand and task.
        analyses: of the structures.
        delays: (n,) each way of the map [s].
        factors: (m,) of the map on what comes back [1].
        maps: structure -> (m, n), true where stable.
        spring: the joystick axis with stiffness feedback, None without.
        sweeps: measured in simulation, empty where not asked for.
        agreements: the maps, simulated; empty where not asked for.
        robust: what every structure withstands, sampled; empty where not asked for.
        period: of that sampling [s].
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
    """Analyse structures, and confirm them in simulation where that is asked for.

    Args:
        name: of the case.
        case: the teleoperator with hand and task.
        structures: their names.
        delays: (n,) each way of the map [s].
        factors: (m,) of the map on what comes back [1].
        spring: the joystick axis with stiffness feedback, None without.
        confirm: whether to simulate sine sweeps, with the case's delays and without, and every cell
            of the map.
        progress: told the structure and the share that is done.

    Returns:
        What was found.

    Raises:
        InputError: a structure is not known, or neither side has a mass.
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
    """What makes a structure unstable, in a few words.

    Args:
        one: the analysis.
        let_go: of the handle let go, not in a hand.

    Returns:
        Such as `no, 2 poles`, `yes` where it is stable.
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
    """A gain margin; where none was found, the largest factor that was tried.

    >>> format_factor(0.17), format_factor(math.inf)
    ('x 0.17', '> x 1000')
    """
    return f"> x {MOST_TRIED:g}" if math.isinf(margin) else f"x {margin:.3g}"


def format_delay(delay: float) -> str:
    """A delay; where none was found, the longest that was tried.

    >>> format_delay(0.12345), format_delay(math.inf)
    ('123 ms', '> 10 s')
    """
    return f"> {LONGEST_TRIED:g} s" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def format_number(value: float) -> str:
    """A number with five digits, without an exponent.

    >>> format_number(-20026.0), format_number(0.0123456)
    ('-20026', '0.012346')
    """
    return np.format_float_positional(value, precision=5, fractional=False, trim="-")


def format_error(error: float | None) -> str:
    """A relative error.

    >>> format_error(0.0016), format_error(1e-7)
    ('0.16 %', '< 0.01 %')
    """
    if error is None:
        return "not measurable"
    return "< 0.01 %" if error < 1e-4 else f"{100.0 * error:.2g} %"


def findings_document(found: Findings) -> dict:
    """What was found as plain data; infinite where nothing within reach changes stability.

    Args:
        found: the findings.

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
    """Gain of a dead band for a sine about its centre, of its slope outside.

    A loop with a dead band that is unstable by its slope still rests inside; it can sustain a swing
    where this share brings its gain to the limit.

    Args:
        deadband: half of the band d, scalar [m] or [rad].
        amplitude: of the sine A, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a swing inside.

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
        "its slave moves by an observed force of the hand, which is not modelled for a machine",
        _CASE + "four_channel_{}",
    ),
    "wave_variables": (
        "its line uses a wave only as far as energy has come",
        _CASE + "wave_variables --robust",
    ),
    "passivity_control": (
        "its line damps as much as energy is missing",
        _CASE + "passivity_control --robust",
    ),
    "impedance": (
        "the stiffness that is felt is identified and changes",
        "analyse it with pilot.reflection=direct_force, or simulate it: hydrotele run",
    ),
}  # reflection: why it has no linear case, and what to do
_SEARCHED = 2.0 * np.pi * np.geomspace(0.02, 40.0, 4000)  # rad/s
_STEPS, _NEWTON = 80, 8


@dataclass(frozen=True)
class LoopFindings:
    """What was found of one structure.

    Attributes:
        structure: its name.
        own: whether it is the scenario's; else it is what a direct reflection would be instead.
        unstable_poles: with the task; None where poles lie on the axis.
        gain_margin: factor on what comes back up to which it is stable.
        largest_delay: each way [s].
        frequency: of the oscillation at the margin [Hz]; NaN without a margin.
        pole: that oscillation's pole with the gain as it is [rad/s]; NaN without a margin.
        largest_ratio: hand per machine force up to which it is stable [N/N]; NaN where no force is
            reflected.
        hand_force: at the machine's force limit with that ratio [N], [N m].
        ratio_with_deadband: the same for a swing of the handle from stop to stop, of which the dead
            band passes a part [N/N]; NaN where there is none.
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
        """Whether no pole lies right of the axis."""
        return self.unstable_poles == 0


@dataclass(frozen=True)
class ScenarioFindings:
    """What was found of a scenario.

    Attributes:
        name: of the scenario.
        case: the linear case.
        task_source: where the task's numbers are from.
        loop: of the scenario's structure, or of direct force in its place.
        held: the joystick axis under stiffness feedback, with the hand.
        free: the same let go.
        edge_ratio: what stiffness feedback reflects at the dead band's edge [N/N].
    """

    name: str
    case: LinearCase
    task_source: str
    loop: LoopFindings
    held: Spring
    free: Spring
    edge_ratio: float


def find_loop(name: str, case: LinearCase, task_source: str) -> ScenarioFindings:
    """Analyse a scenario's linear case.

    Args:
        name: of the scenario.
        case: the case.
        task_source: where the task's numbers are from.

    Returns:
        What was found.

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
        InputError: the structure is not known here.
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
    """Frequency [Hz] at which the loop is about to swing, and its pole at the gain as it is."""
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
    """What was found as plain data, SI; infinite or NaN where there is none.

    Args:
        found: the findings.

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
