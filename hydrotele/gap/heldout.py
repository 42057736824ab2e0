"""Compare the held-out run with the fitted runs: its share of what differs between runs, and what it alone has.

The accepted model is kept. Of the held-out run only the parameters that differ between the runs are estimated, with the
standard deviation between runs as prior. Then the same regression that finds effects is asked what this run alone
has in addition.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hydrotele.estimate.evidence import Evidence, invert_information
from hydrotele.estimate.hypothesis import BETWEEN_RUNS, CALIBRATION, Guess, Hypothesis, calibration
from hydrotele.gap.disturbances import is_pulse
from hydrotele.gap.machine_model import MachineModel
from hydrotele.gap.model_search import MIN_LOG_BAYES_FACTOR, Model, add_effects, settle, settle_noise
from hydrotele.gap.result import RunDifference
from hydrotele.gap.rivals import Found
from hydrotele.gap.run_differences import between_runs, difference_in_run, list_quantities


class HeldOut(NamedTuple):
    """The held-out run compared with the fitted runs.

    Attributes:
        found: the accepted model, with this run's parameters.
        spread: parameter that differs between runs -> standard deviation of this run's normalised deviation.
        differences: of this run alone.
        is_open: whether there are such differences and the fitted runs do not contradict them: they may act in all
            runs, without effect on the motion of the fitted ones.
    """

    found: Found
    spread: dict[str, float]
    differences: tuple[RunDifference, ...]
    is_open: bool = False


def compare_heldout(evidence: Evidence, found: Found, candidates: Sequence[Hypothesis]) -> HeldOut:
    """Estimate the held-out run's part of an accepted model, and find what differs in this run alone.

    Args:
        evidence: of the fitted runs.
        found: the accepted model.
        candidates: the effects.
    """
    run, data = evidence.data.heldout, evidence.data
    free = [_select_run(h, d, run.name) for h, d in found.guess.parts]
    other = Evidence(data, (run,), evidence.jobs, evidence.step, lacking=True)
    model = MachineModel(other)
    try:
        own = other.set_base(Guess(tuple(free)))
        if (levels := found.judged.tracks[0].levels).colours:
            own = other.set_base(other.judged_from(own.guess, levels))
        now = settle(model, Model(settle_noise(model, own)))
        found = replace(found, judged=replace(found.judged, guess=_with_run(found.guess, now.guess, run.name)))
        spread = {}
        if now.fit:
            known, first = np.sqrt(np.diag(invert_information(now.fit.information))), 0
            for h, d in now.guess.parts:
                spread |= {h.location: float(known[first])} if h.name == BETWEEN_RUNS else {}
                first += len(d)
        parts = list(now.guess.parts)
        if all(h.name != CALIBRATION for h, _ in parts):  # its parameters are tried one by one
            group = calibration(data.machine)
            parts.append((group, np.zeros(group.size)))
        held = Model(replace(now.judged, guess=Guess(tuple((h.held(d), np.zeros(0)) for h, d in parts))))
        other.set_base(held.judged)
        alone = [between_runs(q, (run.name,), 1.0) for q in list_quantities(data.machine, candidates).values()]
        pulses = [c for c in candidates if is_pulse(c)]
        last, _, _ = add_effects(model, held, [*alone, *pulses], False, lambda text, share: None)
        if not last.fit or not last.guess.deviation.size:  # nothing, or coloured noise
            return HeldOut(found, spread, ())
        sizes, first, differences = np.sqrt(np.diag(invert_information(last.fit.information))), 0, []
        for h, d in last.guess.parts:
            if h.size:
                differences.append(difference_in_run(h, d, sizes[first : first + h.size], run.name))
            first += h.size
        return HeldOut(found, spread, tuple(differences), _are_compatible(evidence, found, last.guess))
    finally:
        other.close()


def _are_compatible(evidence: Evidence, found: Found, heldout: Guess) -> bool:
    """Return whether the differences of the held-out run are as likely in the fitted runs as no difference."""
    common = found.guess
    for h, deviation in heldout.parts:
        if h.size and h.name != BETWEEN_RUNS:  # a disturbance, at a time of this run
            return False
        if h.size:
            common = common.plus(replace(h, runs=()), deviation)
    now, tried = (settle_noise(MachineModel(evidence), evidence.judged(g)) for g in (found.guess, common))
    return tried.loss - common.prior < now.loss - found.guess.prior + MIN_LOG_BAYES_FACTOR


def _select_run(h: Hypothesis, deviation: np.ndarray, run: str) -> tuple[Hypothesis, np.ndarray]:
    """Return a hypothesis in which only the parameters of a run are free."""
    own = [k for k, key in enumerate(h.parameters) if h.run_of(key) == run]
    if not own:
        return h.held(deviation), np.zeros(0)
    keys, change = list(h.parameters), h.change
    assert change
    shared = {key: value for key, value in h.values(deviation).items() if not h.run_of(key)}
    free = replace(
        h, parameters={keys[k]: h.parameters[keys[k]] for k in own}, runs=(run,),
        change=lambda machine, values: change(machine, {**shared, **values}),
    )  # fmt: skip
    return free, deviation[own]


def _with_run(guess: Guess, fitted: Guess, run: str) -> Guess:
    """Return a hypothesis with the deviations of a run's parameters taken from another one of the same parts."""
    parts = []
    for (h, deviation), (_, own) in zip(guess.parts, fitted.parts, strict=True):
        moved = deviation.copy()
        if len(own):
            moved[[h.run_of(key) == run for key in h.parameters]] = own
        parts.append((h, moved))
    return Guess(tuple(parts))
