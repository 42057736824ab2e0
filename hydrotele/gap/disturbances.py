"""Force pulses and periodic forces: where, in which run and when.

A pulse is looked for in every run alone, where its residual force is largest, and in all runs at the same time. A
periodic force has the period at which the spectrum of the residual force is largest; its phase is another one in every
run, because the clocks of the runs start anywhere. Their columns follow from the residual input of the same balance.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.signal import czt

from hydrotele.effects import EFFECTS, Parameter
from hydrotele.estimate.evidence import Judged, flat
from hydrotele.estimate.filter import Input, input_sizes, input_units
from hydrotele.estimate.hypothesis import Hypothesis
from hydrotele.estimate.levels import smoothed_inputs
from hydrotele.estimate.track import Track, error_responses
from hydrotele.gap.regression import compare_groups
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

PERIODIC_FORCE = "periodic_force"
"""Name of a force that is periodic in time."""
_PULSE = ("size", "start", "duration")  # parameters of an effect of limited duration
_PERIODIC_STD = 0.03  # of the largest force, as the prior of a pulse
_WAVES = ("cosine", "sine")  # parameters of a periodic force in one run, which are also functions of a formula
_INSTANTS = 160  # at which a pulse may start or end: of a run, and then near the best of these
_CHOICE_OF_INTERVAL = 2.0 * math.log(0.5 * _INSTANTS * (_INSTANTS - 1))  # all are equally probable
_MIN_CYCLES = 3.0  # in a run, of a periodic force; a slower one is a law of the time
_MIN_ROWS = 4.0  # of a period: a faster one does not show in rows


def is_pulse(hypothesis: Hypothesis) -> bool:
    """Return whether an effect has a size, a start and a duration."""
    return set(_PULSE) <= hypothesis.parameters.keys()


def list_disturbances(data: Dataset, candidates: Sequence[Hypothesis], judged: Judged) -> list[Hypothesis]:
    """Return pulses in all runs and in every run alone, and periodic forces.

    Args:
        data: the logs.
        candidates: effects; those with a size, a start and a duration count.
        judged: the model, whose residual forces show the periods.
    """
    inputs = judged.tracks[0].levels.inputs
    pulses = [c for c in candidates if is_pulse(c) and Input("force", c.location) in inputs]
    if not pulses:
        return []
    series = [smoothed_inputs(track) for track in judged.tracks]
    found = list(pulses) if len(judged.tracks) > 1 else []
    for pulse in pulses:
        acts = Input("force", pulse.location)
        found += [_pulse_of_run(pulse, judged, track.run.name) for track in judged.tracks]
        values = [u[:, inputs.index(acts)] for u in series]
        periodic = _periodic_force(data, acts, judged.tracks, values)
        found += [periodic] if periodic else []
    return found


def _pulse_of_run(pulse: Hypothesis, judged: Judged, run: str) -> Hypothesis:
    """Return a pulse in one run only; a second one has a number in its location."""
    place = f"{pulse.location}.{run}"
    before = sum(h.location.startswith(place) for h in judged.guess.hypotheses)
    place = f"{place}.{before + 1}" if before else place
    return Hypothesis(
        pulse.name, place, pulse.parameters, partial(_add_effect, pulse.name, pulse.location), runs=(run,)
    )  # fmt: skip


def _add_effect(name: str, location: str, machine: Machine, values: Mapping[str, float]) -> Machine:
    """Add an effect to those of its name that are there."""
    applied = EFFECTS[name].apply(machine, location, values)
    added = [term for term in applied.terms if term not in machine.terms]
    return machine.model_copy(update={"terms": (*machine.terms, *added)})


def _periodic_force(
    data: Dataset, acts: Input, tracks: Sequence[Track], forces: Sequence[np.ndarray]
) -> Hypothesis | None:  # fmt: skip
    """Return a periodic force with the period of the largest peak of the spectrum; None if the runs are too short."""
    period = max(track.run.period for track in tracks)
    longest = max(len(u) * t.run.period for t, u in zip(tracks, forces, strict=True))
    lowest, highest = _MIN_CYCLES / longest, 1.0 / (_MIN_ROWS * period)
    step = 0.25 / longest  # a quarter of the width of a peak
    frequencies = np.arange(lowest, highest, step)
    if not len(frequencies):
        return None
    power = np.zeros(len(frequencies))
    for track, u in zip(tracks, forces, strict=True):
        turns = 2j * math.pi * track.run.period * np.array([-step, lowest])  # per row, of each factor
        power += np.abs(czt(u - np.mean(u), len(frequencies), *np.exp(turns))) ** 2
    best = 1.0 / float(frequencies[np.argmax(power * _row_gain(frequencies))])
    (largest,), (unit,) = input_sizes(data.machine, [acts]), input_units(data.machine, [acts])
    amplitude = Parameter(unit, 0.0, -largest, largest, _PERIODIC_STD * largest, 0.1 * _PERIODIC_STD * largest)
    names = tuple(run.name for run in (*data.fit, data.heldout))
    width, choice = best**2 / longest, 2.0 * math.log(len(frequencies))  # all are equally probable
    table = {"period": Parameter("s", best, max(best - 2.0 * width, 0.5 * best), best + 2.0 * width, width, 0.0)}
    table |= {f"{run}: {part}": amplitude for run in names for part in _WAVES}
    add = partial(_add_periodic_force, acts.axis)
    return Hypothesis(PERIODIC_FORCE, acts.axis, table, add, runs=names, choice_cost=choice)


def _row_gain(frequencies: np.ndarray) -> np.ndarray:
    """Weight of a frequency: the spectrum of residual inputs, an Ornstein-Uhlenbeck process, falls with its square."""
    return frequencies**2


def _add_periodic_force(axis: str, machine: Machine, values: Mapping[str, float]) -> Machine:
    length = values["period"]
    waves = {key.rpartition(": ")[2]: value for key, value in values.items() if key != "period"}
    names = {"cosine": "cos", "sine": "sin"}
    formula = {f"{names[part]}(time, {length!r})": size for part, size in waves.items() if size}
    if not formula:
        return machine
    term = Term(name=PERIODIC_FORCE, axis=axis, balance="force", law="formula", parameters=formula)
    return machine.model_copy(update={"terms": (*machine.terms, term)})


# -- linear step ------------------------------------------------------------------------------------------------------

Part = tuple[Hypothesis, np.ndarray]


def compare_disturbances(
    tried: Sequence[Hypothesis], tracks: Sequence[Track], each: Callable = map
) -> list[tuple[Part, float]]:
    """Compare each disturbance with none, by the response of the errors to the residual input of its balance.

    Args:
        tried: pulses and periodic forces.
        tracks: of the model, linearised.
        each: `map`, or that of an executor.

    Returns:
        Each with the deviation at which it is most likely, and twice its log Bayes factor.
    """
    return list(each(lambda h: (_locate_pulse if is_pulse(h) else _compare_waves)(h, tracks), tried))


def _responses(track: Track, h: Hypothesis, shapes: np.ndarray) -> np.ndarray:
    """(E, p) change of a track's whitened errors per unit of forces (n, p) on the drive of a disturbance."""
    index = track.levels.inputs.index(Input("force", h.location.partition(".")[0]))
    return error_responses(track, track.columns[:, index], shapes).reshape(-1, shapes.shape[1])


def _clock(track: Track) -> np.ndarray:
    return track.run.start + track.run.period * np.arange(len(track.whitened))


def _locate_pulse(h: Hypothesis, tracks: Sequence[Track]) -> tuple[Part, float]:
    """Find the interval of a pulse that makes it most likely: first on a coarse grid, then to a row."""
    acting = [t for t in tracks if not h.runs or t.run.name in h.runs]
    knots = np.linspace(min(_clock(t)[0] for t in acting), max(_clock(t)[-1] for t in acting), _INSTANTS)
    best, spacing = _best_interval(h, acting, knots), float(knots[1] - knots[0])
    while spacing > min(t.run.period for t in acting):
        near = np.linspace(-spacing, spacing, _INSTANTS // 2)
        spacing = float(near[1] - near[0])
        finer = _best_interval(h, acting, np.unique(np.append(best.start + near, best.end + near)))
        best = max(best, finer, key=lambda interval: interval.factor)
    table = dict(h.parameters)
    seconds = best.end - best.start
    for key, value in (("start", best.start), ("duration", seconds)):
        low, high = min(table[key].lower_bound, value), max(table[key].upper_bound, value)
        table[key] = replace(
            table[key], nominal=value, prior_std=seconds, lower_bound=low, upper_bound=high, start_values=()
        )  # fmt: skip
    table = {key: replace(p, start_values=()) for key, p in table.items()}
    located = replace(h, parameters=table, choice_cost=_CHOICE_OF_INTERVAL)
    deviation = np.array([best.mean if key == "size" else 0.0 for key in table])
    return (located, np.clip(deviation, located.low, located.high)), best.factor - _CHOICE_OF_INTERVAL


class _Interval(NamedTuple):
    """When a pulse acts [s], twice its log Bayes factor, and its size [prior standard deviations]."""

    start: float
    end: float
    factor: float
    mean: float


def _best_interval(h: Hypothesis, tracks: Sequence[Track], knots: np.ndarray) -> _Interval:
    """Return the most likely interval between two of some instants (K,).

    A pulse is the difference of two steps, so the Gram matrix of steps at all instants gives the Bayes factor of every
    interval.
    """
    size = h.parameters["size"]
    right, gram = np.zeros(len(knots)), np.zeros((len(knots), len(knots)))
    for track in tracks:
        steps = size.prior_std * (_clock(track)[:, None] >= knots)
        columns = _responses(track, h, steps)
        right -= columns.T @ flat(track.whitened)
        gram += columns.T @ columns
    of_step = np.diag(gram)
    precision = 1.0 + np.maximum(of_step[:, None] + of_step - 2.0 * gram, 0.0)
    pull = right[:, None] - right
    factors = np.triu(pull**2 / precision - np.log(precision), 1)
    first, last = np.unravel_index(int(np.argmax(factors)), factors.shape)
    end = float(knots[last]) if last > first else float(knots[first] + (knots[1] - knots[0]))
    mean = float(pull[first, last] / precision[first, last])
    return _Interval(float(knots[first]), end, float(factors[first, last]), mean)


def _compare_waves(h: Hypothesis, tracks: Sequence[Track]) -> tuple[Part, float]:
    keys = list(h.parameters)
    sized = [k for k, key in enumerate(keys) if key.endswith(_WAVES)]
    length, scale = h.parameters["period"].nominal, next(h.parameters[keys[k]].prior_std for k in sized)
    right, block = np.zeros(len(sized)), np.zeros((len(sized), len(sized)))
    for track in tracks:
        own = [n for n, k in enumerate(sized) if h.run_of(keys[k]) == track.run.name]
        phase = 2.0 * math.pi * _clock(track) / length
        columns = _responses(track, h, scale * np.column_stack([np.cos(phase), np.sin(phase)]))
        right[own] -= columns.T @ flat(track.whitened)
        block[np.ix_(own, own)] += columns.T @ columns
    factors, (mean,) = compare_groups(np.array([0, len(sized)]), right, [block])
    deviation = np.zeros(h.size)
    deviation[sized] = mean
    return (h, np.clip(deviation, h.low, h.high)), float(factors[0]) - h.choice_cost
