"""Visual manual control: the crossover model of the human operator, with online learning.

The controlled element Yc is what responds to the hand, such as machine and joystick together. Around
the crossover frequency omega_c, operator Yp and controlled element together are
`Yp Yc = omega_c e^(-tau s) / s` with an effective delay tau. The operator integrates if the element is a gain, acts in
proportion if it integrates once, and generates lead if it integrates twice. The operator learns the
element's gain and lag from past actions and observations. The required phase margin then gives the
crossover frequency. The error is observed with a delay and with noise in proportion to its size
(remnant), and the limb is a second-order lag.

Source: McRuer and Jex 1967, IEEE Trans. Human Factors in Electronics 8; Levison, Baron and Kleinman
1969, IEEE Trans. Man-Machine Systems 10 (observation noise).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compile_inlined, compiled
from hydrotele.teleop.operator_parameters import Operator

GAIN, INTEGRATOR, DOUBLE_INTEGRATOR = range(3)
FORMS = ("K", "K/s", "K/s^2")
_CANDIDATE_LAGS = (0.0, 0.15, 0.3, 0.6, 1.0)  # s, first-order lags of the candidate elements
_CANDIDATE_DEAD_TIMES = (0.0, 0.1, 0.2, 0.3, 0.45)  # s, dead times of the candidate elements
LEAD_TIME = 2.5  # s, lead time constant of the operator for a double integrator
_WASHOUT_FREQUENCY = 1.5  # rad/s: slower motion is drift, not an effect of the operator's input
_ERROR_CORRELATION_TIME = 0.5  # s, correlation time of the prediction errors
_VARIANCE_TIME = 5.0  # s, averaging time for the variance of the observed errors
_MIN_POWER = 1e-24  # sum of squares below which nothing has moved
# indices into `VisualLoop.parameters`
STEP, DELAY, REMNANT, THRESHOLD, MEMORY, GAIN_UNCERTAINTY, MAX_OUTPUT, FORM, EXPECTED_GAIN = range(9)
ERROR_POWER, RATE_POWER, INTEGRAL, SELECTED_CANDIDATE, ESTIMATED_GAIN, NOTICED_ERROR = range(6)  # in `VisualLoop.state`


class VisualLoop(NamedTuple):
    """Parameters and state of a loop that the operator closes by vision.

    The operator fits n candidate models of the controlled element, which differ in lag and dead time.

    Attributes:
        parameters: (9,) decision step [s], visual delay [s], remnant [1], threshold of the error,
            memory time [s], standard deviation of the logarithm of the expected gain, maximum
            displacement of the hand, number of integrations of the element, expected gain.
        lag: (n,) first-order lag of each candidate [s].
        dead_time: (n,) dead time of each candidate [s].
        operator_gain: (n,) operator gain for each candidate, for an element of unit gain.
        history: (rows, 3) ring buffer of error, observed output and hand displacement.
        noise: (m, 2) standard normal noise of error and rate.
        hand: (n, 4) hand displacement after each lag, and its three low-pass filters.
        output_filter: (3,) low-pass filters of the observed output.
        sums: (n, 4) exponentially weighted sums of effect^2, effect times output, output^2, and of 1;
            the effect is the output that a candidate of unit gain predicts.
        state: (6,) mean square of the error, mean square of its rate, integrated hand displacement,
            number of the selected candidate, its gain, and the observed error without noise (0 below
            the threshold).
    """

    parameters: np.ndarray
    lag: np.ndarray
    dead_time: np.ndarray
    operator_gain: np.ndarray
    history: np.ndarray
    noise: np.ndarray
    hand: np.ndarray
    output_filter: np.ndarray
    sums: np.ndarray
    state: np.ndarray


def make_visual_loop(
    operator: Operator, step: float, expected_gain: float, rng: np.random.Generator, *,
    form: int, margin: float | None = None, threshold: float = 0.0, max_output: float = math.inf,
    steps: int = 2**12,
) -> VisualLoop:  # fmt: skip
    """Create the parameters and initial state of a loop that an operator closes by vision.

    Args:
        operator: parameters of the operator.
        step: time between two decisions [s].
        expected_gain: expected gain of the element.
        rng: random generator of the observation noise and of the error of the expected gain.
        form: form of the element, known to the operator: GAIN, INTEGRATOR or DOUBLE_INTEGRATOR.
        margin: required phase margin [rad]; by default `tracking_margin` of the operator.
        threshold: error below which the operator does not act.
        max_output: maximum displacement of the hand.
        steps: number of decisions after which the noise samples repeat.

    Returns:
        Parameters and initial state of the loop.
    """
    off = math.exp(operator.new_gain_log_std * rng.standard_normal())
    late = operator.visual_delay + (operator.lead_delay if form == DOUBLE_INTEGRATOR else 0.0)
    rows = 4 + math.ceil((late + max(_CANDIDATE_DEAD_TIMES)) / step)
    places = [(lag, dead) for lag in _CANDIDATE_LAGS for dead in _CANDIDATE_DEAD_TIMES]
    margin = operator.tracking_margin if margin is None else margin
    n = len(places)
    return VisualLoop(
        parameters=np.array([
            step, late - 0.5 * step, operator.remnant, threshold, operator.memory_time, operator.new_gain_log_std,
            max_output, form, off * expected_gain,
        ]),
        lag=np.array([lag for lag, _ in places]),
        dead_time=np.array([dead for _, dead in places]),
        operator_gain=np.array([_max_operator_gain(operator, form, lag, late + dead, margin) for lag, dead in places]),
        history=np.zeros((rows, 3)),
        noise=rng.standard_normal((steps, 2)),
        hand=np.zeros((n, 4)),
        output_filter=np.zeros(3),
        sums=np.zeros((n, 4)),
        state=np.array([0.0, 0.0, 0.0, 0.0, off * expected_gain, 0.0]),
    )  # fmt: skip


@compile_inlined
def _interpolate_past_value(past, tick, back, column):
    """Return the value of a column of the ring buffer `past`, `back` decisions before `tick`.

    A fractional `back` interpolates between decisions. The value is 0 before the first decision.
    """
    whole = int(back)
    if tick < whole + 1:
        return 0.0
    part, rows = back - whole, len(past)
    one, two = past[(tick - whole) % rows, column], past[(tick - whole - 1) % rows, column]
    return (1.0 - part) * one + part * two


@compiled
def update_controlled_element_fits(loop, tick, late, seen):
    """Update the least-squares gain of every candidate model of the controlled element.

    The controlled element is what responds to the operator's hand; the candidates differ in lag and
    dead time.

    Hand and output pass through a third-order high-pass (wash-out) of bandwidth a, so that slow drift
    does not count. A candidate with n integrations and lag T then predicts the output, for unit gain,
    as the hand displacement filtered by `s^(3-n) / (s + a)^3 / (T s + 1)`. The candidate whose
    scaled prediction leaves the smallest part of the output's power unexplained is selected.

    Args:
        loop: VisualLoop; `hand`, `output_filter`, `sums` and `state` are written.
        tick: number of the decision, scalar.
        late: age of the observation in decision steps, scalar.
        seen: observed output of the element at that time, scalar.

    Returns:
        Nothing.

    Source: recursive least squares with forgetting, over a bank of models.
    """
    step, a = loop.parameters[STEP], _WASHOUT_FREQUENCY
    share = 1.0 - np.exp(-a * step)
    keep = np.exp(-step / loop.parameters[MEMORY])
    low = loop.output_filter
    low[0] += share * (seen - low[0])
    low[1] += share * (low[0] - low[1])
    low[2] += share * (low[1] - low[2])
    output = seen - 3.0 * low[0] + 3.0 * low[1] - low[2]
    best, least = 0, np.inf
    for i in range(len(loop.lag)):
        row, lag = loop.hand[i], loop.lag[i]
        hand = _interpolate_past_value(loop.history, tick, late + loop.dead_time[i] / step, 2)
        row[0] += (1.0 - np.exp(-step / lag) if lag > 0.0 else 1.0) * (hand - row[0])
        row[1] += share * (row[0] - row[1])
        row[2] += share * (row[1] - row[2])
        row[3] += share * (row[2] - row[3])
        if loop.parameters[FORM] == 0.0:
            effect = row[0] - 3.0 * row[1] + 3.0 * row[2] - row[3]
        elif loop.parameters[FORM] == 1.0:
            effect = (row[1] - 2.0 * row[2] + row[3]) / a
        else:
            effect = (row[2] - row[3]) / (a * a)
        sums = loop.sums[i]
        sums[0] = keep * sums[0] + effect * effect
        sums[1] = keep * sums[1] + effect * output
        sums[2] = keep * sums[2] + output * output
        sums[3] = keep * sums[3] + 1.0
        if sums[0] > _MIN_POWER and sums[1] > 0.0:
            cost = (sums[2] - sums[1] * sums[1] / sums[0]) / max(sums[2], _MIN_POWER)
            if cost < least:
                best, least = i, cost
    loop.state[SELECTED_CANDIDATE] = best


@compiled
def estimate_controlled_element_gain(loop):
    """Estimate the gain of the controlled element, that is of what responds to the operator's hand.

    The estimate is a mean of the gain that fits past observations and the gain that the operator
    expected, weighted by their uncertainty. It starts at the expected gain.

    Args:
        loop: VisualLoop; the estimated gain in `state` is written.

    Returns:
        The gain, scalar: output, its rate or its second derivative per hand displacement, for an element
        with no, one or two integrations.

    Source: normal posterior of the gain's logarithm.
    """
    best = int(loop.state[SELECTED_CANDIDATE])
    sums, prior = loop.sums[best], loop.parameters[EXPECTED_GAIN]
    gain = prior
    if sums[0] > _MIN_POWER and sums[1] > 0.0:
        fitted = sums[1] / sums[0]
        scatter = max(0.0, sums[2] - fitted * sums[1]) / sums[3]
        doubt = scatter / (fitted * fitted * sums[0]) * (_ERROR_CORRELATION_TIME / loop.parameters[STEP]) + 1e-4
        surprise = loop.parameters[GAIN_UNCERTAINTY] ** 2
        weight = surprise / (surprise + doubt)
        gain = np.exp(weight * np.log(fitted) + (1.0 - weight) * np.log(prior))
    loop.state[ESTIMATED_GAIN] = gain
    return gain


@compiled
def decide_hand_reference(loop, tick, target, seen, hand):
    """Run one visual decision of the operator: compute the hand's reference from the observed error.

    The model of the controlled element is updated first. The observed error is delayed and noisy.
    The action is the error, integrated for an element without integration or with lead for a double
    integrator, times the operator gain over the estimated gain of the element. A delayed error
    below the threshold causes no action.

    Args:
        loop: VisualLoop, written.
        tick: number of the decision, scalar.
        target: present reference of the element's output, scalar.
        seen: present output, scalar.
        hand: present displacement of the hand, scalar.

    Returns:
        Reference displacement of the hand before the neuromuscular lag, scalar.

    Source: McRuer and Jex 1967; Levison, Baron and Kleinman 1969.
    """
    facts, past, state = loop.parameters, loop.history, loop.state
    step, rows = facts[STEP], len(past)
    here = past[tick % rows]
    here[0], here[1], here[2] = target - seen, seen, hand
    late = max(0.5, facts[DELAY] / step)
    if tick < int(late) + 3:
        return 0.0
    middle = 0.5 if facts[FORM] == 0.0 else 0.0  # the integrator uses the middle of its step
    error = _interpolate_past_value(past, tick, late + middle, 0)
    rate = (
        _interpolate_past_value(past, tick, late - 0.5, 0) - _interpolate_past_value(past, tick, late + 0.5, 0)
    ) / step
    update_controlled_element_fits(loop, tick, late, _interpolate_past_value(past, tick, late, 1))
    best = int(state[SELECTED_CANDIDATE])
    gain = estimate_controlled_element_gain(loop)
    share = 1.0 - np.exp(-step / _VARIANCE_TIME)
    state[ERROR_POWER] += share * (error * error - state[ERROR_POWER])
    state[RATE_POWER] += share * (rate * rate - state[RATE_POWER])
    density = np.sqrt(facts[REMNANT] * np.pi / step)
    noise = loop.noise[tick % len(loop.noise)]
    state[NOTICED_ERROR] = error if abs(error) >= facts[THRESHOLD] else 0.0
    if state[NOTICED_ERROR] == 0.0 and facts[THRESHOLD] > 0.0:
        return state[INTEGRAL]  # no action on an unobserved error
    error += density * np.sqrt(state[ERROR_POWER]) * noise[0]
    action = loop.operator_gain[best] / gain
    if facts[FORM] == 0.0:
        state[INTEGRAL] += step * action * error
        state[INTEGRAL] = min(facts[MAX_OUTPUT], max(-facts[MAX_OUTPUT], state[INTEGRAL]))
        return state[INTEGRAL]
    if facts[FORM] == 2.0:
        rate += density * np.sqrt(state[RATE_POWER]) * noise[1]
        error += LEAD_TIME * rate
    return min(facts[MAX_OUTPUT], max(-facts[MAX_OUTPUT], action * error))


def operator_response(operator: Operator, form: int, frequencies: np.ndarray, late: float | None = None) -> np.ndarray:
    """Return the frequency response of an operator of unit gain: hand displacement per visible error.

    It contains delay, neuromuscular lag and equalisation, the operator's adaptation to the element:
    integration, no change, or lead.

    Args:
        operator: parameters of the operator.
        form: form of the controlled element: GAIN, INTEGRATOR or DOUBLE_INTEGRATOR.
        frequencies: (m,) [rad/s].
        late: delay, including that of lead generation [s]; by default the operator's.

    Returns:
        (m,) complex hand displacement per error.
    """
    s = 1j * frequencies
    if late is None:
        late = operator.visual_delay + (operator.lead_delay if form == DOUBLE_INTEGRATOR else 0.0)
    equal = (1.0 / s, np.ones_like(s), 1.0 + LEAD_TIME * s)[form]
    w, z = operator.neuromuscular_frequency, operator.neuromuscular_damping
    return equal * np.exp(-late * s) * w**2 / (s**2 + 2.0 * z * w * s + w**2)


def _max_operator_gain(operator: Operator, form: int, lag: float, late: float, margin: float) -> float:
    """Return the maximum operator gain that keeps phase and gain margin, for an element of unit gain.

    The element has `form` integrations and the first-order `lag` [s]; `late` is the total delay [s],
    and `margin` the phase margin [rad]. The crossover frequency, at which the loop gain is 1, is at most
    the operator's maximum.
    """
    w = np.geomspace(0.02, 60.0, 4000)
    loop = operator_response(operator, form, w, late) / (1j * w) ** form / (1.0 + lag * 1j * w)
    size, phase = np.abs(loop), np.unwrap(np.angle(loop))
    phase -= 2.0 * math.pi * round((phase[0] + math.pi * (1.0 if form == 2 else 0.5)) / math.tau)
    close = np.flatnonzero(phase >= margin - math.pi)
    turn = np.flatnonzero(phase >= -math.pi)
    at = min(w[close[-1]] if len(close) else w[turn[-1]] / 3.0, operator.max_crossover_frequency)
    beyond = size[turn[-1] :].max()  # includes the neuromuscular peak
    return float(min(1.0 / np.interp(at, w, size), operator.gain_margin / beyond))


def discretise_neuromuscular_lag(frequency: float, damping: float, step: float) -> np.ndarray:
    """Discretise the neuromuscular lag `omega^2 / (s^2 + 2 zeta omega s + omega^2)` exactly.

    Args:
        frequency: natural frequency [rad/s]; 0 for no lag.
        damping: damping ratio [1].
        step: time for which the input is held [s].

    Returns:
        (6,) a11, a12, b1, a21, a22, b2: next position `a11 x + a12 v + b1 u` and next rate
        `a21 x + a22 v + b2 u` for position x, rate v and input u.
    """
    if frequency <= 0.0:
        return np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    from scipy.linalg import expm

    w2 = frequency**2
    whole = expm(step * np.array([[0.0, 1.0, 0.0], [-w2, -2.0 * damping * frequency, w2],
                                  [0.0, 0.0, 0.0]]))  # fmt: skip
    return whole[:2].reshape(6)


class TrackingRecord(NamedTuple):
    """Record of a tracking task, in which a hand keeps a displayed response on a target.

    Attributes:
        time: (n,) [s].
        target: (n,) reference of the output.
        response: (n,) output of the controlled element.
        hand: (n,) displacement (or force) of the hand.
    """

    time: np.ndarray
    target: np.ndarray
    response: np.ndarray
    hand: np.ndarray


def make_sum_of_sines(time: np.ndarray, bandwidth: float = 1.5, duration: float = 120.0, seed: int = 0
                 ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Generate a target of ten sines, with ten times lower amplitudes above its bandwidth.

    Args:
        time: (n,) [s].
        bandwidth: upper frequency of the large sines [rad/s].
        duration: period of the signal [s].
        seed: seed of the phases.

    Returns:
        (n,) target of unit standard deviation, and the (10,) frequencies [rad/s]. They are multiples
        of the base frequency by prime numbers, so that none is a harmonic of another.

    Source: form of the forcing functions of McRuer et al. 1965, AFFDL-TR-65-15.
    """
    base = 2.0 * math.pi / duration
    wanted = np.geomspace(0.26, 14.0, 10) / base
    primes = [n for n in range(3, 400) if all(n % k for k in range(2, int(n**0.5) + 1))]
    count = [min(primes, key=lambda n: abs(n - w)) for w in wanted]
    frequencies = base * np.array(sorted(set(count)))
    size = np.where(frequencies <= bandwidth, 1.0, 0.1)
    phase = np.random.default_rng([seed, 65]).uniform(0.0, 2.0 * math.pi, len(frequencies))
    target = (size * np.sin(np.outer(time, frequencies) + phase)).sum(axis=1)
    return target / math.sqrt(0.5 * (size**2).sum()), frequencies


@compiled
def _simulate_tracking(loop, lag, form, gain, target, fine, hand, response):
    """Simulate operator and controlled element in a closed loop; write `hand` and `response` (n,).

    `hand` is the displacement of the hand, `response` the output of the element with `form`
    integrations and gain `gain`. `target` (n,) is the reference of the output. `lag` is the
    discrete neuromuscular lag, and `fine` the number of steps per decision.
    """
    place, speed, output, rate = 0.0, 0.0, 0.0, 0.0
    step = loop.parameters[STEP] / fine
    wanted = 0.0
    for k in range(len(target)):
        hand[k], response[k] = place, output
        if k % fine == 0:
            wanted = decide_hand_reference(loop, k // fine, target[k], output, place)
        before = place
        place, speed = (
            lag[0] * place + lag[1] * speed + lag[2] * wanted,
            lag[3] * place + lag[4] * speed + lag[5] * wanted,
        )
        middle = 0.5 * (before + place)
        if form == 0:
            output = gain * place
        elif form == 1:
            output += step * gain * middle
        else:
            output += step * rate + 0.5 * step * step * gain * middle
            rate += step * gain * middle


def simulate_tracking(
    operator: Operator, form: int, gain: float, target: np.ndarray, *, step: float = 0.01, steps_per_decision: int = 2,
    seed: int = 0, has_gain_error: bool = True,
) -> TrackingRecord:  # fmt: skip
    """Simulate an operator who tracks a displayed target with a simple controlled element.

    Args:
        operator: parameters of the operator.
        form: GAIN, INTEGRATOR or DOUBLE_INTEGRATOR.
        gain: gain of the element, unknown to the operator.
        target: (n,) target at intervals of `step`.
        step: sampling period of the record [s].
        steps_per_decision: number of steps per decision.
        seed: seed of the noise and of the expected gain.
        has_gain_error: whether the expected gain has the error given by `new_gain_log_std`; otherwise it
            is exact.

    Returns:
        Time, target, response and hand of the simulated task.
    """
    rng = np.random.default_rng([seed, 1967])
    loop = make_visual_loop(
        operator,
        steps_per_decision * step,
        gain,
        rng,
        form=form,
        steps=len(target) // steps_per_decision + 1,
    )
    if not has_gain_error:
        loop.parameters[EXPECTED_GAIN] = loop.state[ESTIMATED_GAIN] = gain
    lag = discretise_neuromuscular_lag(operator.neuromuscular_frequency, operator.neuromuscular_damping, step)
    hand, response = np.zeros((2, len(target)))
    _simulate_tracking(loop, lag, form, gain, np.asarray(target, float), steps_per_decision, hand, response)
    return TrackingRecord(step * np.arange(len(target)), np.asarray(target), response, hand)


class CrossoverProperties(NamedTuple):
    """Properties of the open loop of operator and controlled element near its crossover frequency.

    Attributes:
        frequency: crossover frequency, at which the gain of the open loop is 1 [rad/s].
        margin: phase margin [rad].
        slope: slope of the gain around the crossover [dB per decade].
    """

    frequency: float
    margin: float
    slope: float


def measure_describing_functions(
    records: Sequence[TrackingRecord], frequencies: np.ndarray, skip: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Measure the frequency responses of operator and open loop from tracking records.

    Args:
        records: records with a sum of sines of these frequencies as target, all of one length.
        frequencies: (m,) [rad/s], integer multiples of 1 / (record length after `skip`).
        skip: initial time that is discarded [s].

    Returns:
        (m,) complex response per error, the open loop Yp Yc, and (m,) hand per error, the operator Yp.

    Source: McRuer et al. 1965, AFFDL-TR-65-15: ratio of cross spectra with the target.
    """
    error, output, acted = np.zeros((3, len(frequencies)), complex)
    for record in records:
        kept = record.time >= skip - 1e-9
        basis = np.exp(-1j * np.outer(frequencies, record.time[kept]))
        target, response, hand = (basis @ values[kept] for values in record[1:])
        error += (target - response) * target.conj()
        output += response * target.conj()
        acted += hand * target.conj()
    return output / error, acted / error


def find_crossover(frequencies: np.ndarray, open_loop: np.ndarray) -> CrossoverProperties:
    """Compute crossover frequency, phase margin and slope of a measured open loop.

    The slope is that of a line through the points from half to twice the crossover frequency.

    Args:
        frequencies: (m,) increasing [rad/s].
        open_loop: (m,) complex frequency response.

    Returns:
        The crossover properties; all NaN if the gain does not fall through 1.
    """
    decades, size = np.log10(frequencies), 20.0 * np.log10(np.abs(open_loop))
    phase = np.unwrap(np.angle(open_loop))
    phase -= 2.0 * math.pi * np.round((phase[0] + 0.5 * math.pi) / (2.0 * math.pi))
    falls = np.flatnonzero((size[:-1] >= 0.0) & (size[1:] < 0.0))
    if not len(falls):
        return CrossoverProperties(math.nan, math.nan, math.nan)
    k = falls[0]
    share = size[k] / (size[k] - size[k + 1])
    place = decades[k] + share * (decades[k + 1] - decades[k])
    near = np.abs(decades - place) <= math.log10(2.0)
    near[k] = near[k + 1] = True
    slope = float(np.polyfit(decades[near], size[near], 1)[0])
    angle = phase[k] + share * (phase[k + 1] - phase[k])
    margin = math.remainder(math.pi + angle, 2.0 * math.pi)  # sparse sines can hide a full turn
    return CrossoverProperties(float(10.0**place), margin, slope)
