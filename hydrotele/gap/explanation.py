"""Why a verdict: candidates with Bayes factors, what was rejected by which test, and the residual inputs over time.

Every sentence is generated from numbers that stand in the same record.
"""

import math
from collections.abc import Sequence

import numpy as np

from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.filter import MEMORY, _rows_later, input_sizes, input_units
from hydrotele.estimate.hypothesis import CALIBRATION, LEARNED
from hydrotele.estimate.reduced_model import model_space, reduced_model, state_names
from hydrotele.estimate.track import COARSE, Track, steps_per_row
from hydrotele.gap.model_search import MIN_LOG_BAYES_FACTOR
from hydrotele.gap.result import Comparison, Contender, InputTrace, NamedEffect, Rejection
from hydrotele.gap.rivals import Found, part_taken
from hydrotele.gap.run_variables import see
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine

_TRACES = 4  # residual inputs that are shown: those that are the largest part of their physical limit
_MIN_RELATIVE = 0.02  # of the largest: smaller residual inputs say nothing about the verdict
_RIDGE = 1e-6  # of the squared change per row of an input at its estimated size: keeps the equations solvable
_REACH = 5.0  # correlation times: the weight of a change that far away is below 1 %


def compare_contenders(found: Found, named: Sequence[NamedEffect]) -> tuple[Comparison, ...]:
    """Rank the candidates in the place of each named effect by their Bayes factors against none.

    Args:
        found: the search.
        named: the named effects, with probabilities.

    Returns:
        Per named effect its comparison, in the order of `named`.
    """
    known = {(effect.name, effect.location): effect for effect in named}
    comparisons = []
    for index, (hypothesis, _) in enumerate(found.guess.parts):
        rest, effect = found.without[index], known.get(hypothesis.key)
        if hypothesis.name == CALIBRATION or rest is None or effect is None:
            continue
        chances = {(a.name, a.location): a.probability for a in effect.alternatives}
        own = rest.loss - found.judged.loss - found.charges[index]
        contenders = [Contender(*hypothesis.key, own, effect.probability)]
        contenders += [
            Contender(
                *r.hypothesis.key, rest.loss - r.judged.loss - r.occam_penalty, chances.get(r.hypothesis.key, 0.0)
            )
            for r in found.rivals[index] if math.isfinite(r.judged.loss)
        ]  # fmt: skip
        ranked = tuple(sorted(contenders, key=lambda c: -c.log_bayes_factor))
        comparisons.append(Comparison(*hypothesis.key, ranked))
    order = list(known)
    return tuple(sorted(comparisons, key=lambda c: order.index((c.name, c.location))))


def list_rejections(
    found: Found,
    named: Sequence[NamedEffect],
    worse: Sequence[str],
) -> tuple[Rejection, ...]:
    """List what was tried and not named, with the test that it failed.

    Args:
        found: the search.
        named: the named effects.
        worse: sentences on changes that made the held-out run worse.

    Returns:
        The rejections, the most plausible first.
    """
    rejections = []
    kept = {(e.name, e.location) for e in named}
    for (hypothesis, _), rest in zip(found.guess.parts, found.without, strict=True):
        if rest is not None and hypothesis.key not in kept and not hypothesis.name.startswith(LEARNED):
            taken = part_taken(rest, found.judged)
            test = "fraction of the residual inputs' loss that it removes"
            rejections.append(Rejection(*hypothesis.key, test, taken, math.nan))
    known = {h.key for h in found.guess.hypotheses} | {(r.name, r.location) for r in rejections}
    if not found.guess.parts:
        for s in found.ranking[:3]:
            if s.hypothesis.key not in known and s.factor < MIN_LOG_BAYES_FACTOR:
                rejections.append(
                    Rejection(*s.hypothesis.key, "twice the log Bayes factor", s.factor, MIN_LOG_BAYES_FACTOR)
                )
    rejections += [Rejection("", "", sentence, math.nan, math.nan) for sentence in worse]
    return tuple(rejections)


def trace_inputs(data: Dataset, given: Judged, final: Judged) -> tuple[InputTrace, ...]:
    """Estimate the largest residual inputs over the run that shows them most, and what the accepted model adds.

    Args:
        data: the logs.
        given: the given machine.
        final: the accepted effects, calibrated parameters and learned laws.

    Returns:
        The traces, the largest first; none if nothing is missing in the given machine.
    """
    levels = given.tracks[0].levels
    if not levels.inputs:
        return ()
    parts = levels.sizes / input_sizes(data.machine, levels.inputs)
    chosen = [k for k in np.argsort(-parts)[:_TRACES] if parts[k] > _MIN_RELATIVE * parts.max()]
    seen = [see(data, given, track) for track in given.tracks]
    lead = levels.inputs[int(chosen[0])]
    index = int(np.argmax([np.mean(np.where(s.known, s.inputs[lead], 0.0) ** 2) for s in seen]))
    before, track = seen[index], given.tracks[index]
    after = see(data, final, final.tracks[index])
    # the patched model has what all runs share
    added = _equivalent_inputs(data.machine, final.guess.machine(data.machine), track)
    units = input_units(data.machine, levels.inputs)
    time = track.run.start + track.run.period * np.arange(len(track.states))
    traces = []
    for k in chosen:
        i = levels.inputs[int(k)]
        nothing = np.zeros(len(time))
        traces.append(
            InputTrace(
                track.run.name, i.balance, i.axis, units[int(k)], time,
                np.where(before.known, before.inputs[i], np.nan),
                np.where(after.known, after.inputs.get(i, nothing), np.nan),
                None if added is None else np.where(before.known, added[:, int(k)], np.nan),
            )
        )  # fmt: skip
    return tuple(traces)


def _equivalent_inputs(given: Machine, final: Machine, track: Track) -> np.ndarray | None:
    """(n, m) inputs that change the next states as the corrected model does, by least squares; None if it does not.

    Each state's change is divided by that of the inputs at their estimated sizes. The inputs are averaged over the
    correlation time of residual inputs.
    """
    if state_names(given) != state_names(final):
        return None
    ends = []
    for machine in (given, final):
        model, later = reduced_model(machine, ()), np.empty(track.states.shape)
        steps = steps_per_row(machine, track.run.period, COARSE)
        _rows_later(model, model_space(model), track.states, track.run.command, track.run.period, steps, later)
        ends.append(later)
    change = np.nan_to_num(ends[1] - ends[0])
    if not np.any(change):
        return None
    sizes = track.levels.sizes
    columns = np.nan_to_num(track.columns * sizes[:, None])
    scale = np.sqrt(np.mean(np.sum(columns**2, axis=1), axis=0))
    inside = scale > 0.0
    columns, change = columns[:, :, inside] / scale[inside], change[:, inside] / scale[inside]
    gram = np.einsum("nmz,nkz->nmk", columns, columns) + _RIDGE * np.eye(len(sizes))
    right = np.einsum("nmz,nz->nm", columns, change)
    inputs = np.linalg.solve(gram, right[:, :, None])[:, :, 0] * sizes
    return np.apply_along_axis(np.convolve, 0, inputs, _memory_weights(track.run.period, len(inputs)), mode="same")


def _memory_weights(period: float, rows: int) -> np.ndarray:
    """Return weights of a mean over the correlation time of residual inputs, which cannot follow faster changes."""
    reach = min(math.ceil(_REACH * MEMORY / period), (rows - 1) // 2)
    weights = np.exp(-np.abs(np.arange(-reach, reach + 1)) * period / MEMORY)
    return weights / weights.sum()
