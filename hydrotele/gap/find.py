"""The workflow: find, name, add, show; from a Dataset to a Gap."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from hydrotele.dataset.load import Dataset
from hydrotele.gap.balances import balances
from hydrotele.gap.constancy import constancy
from hydrotele.gap.experiment import next_experiment
from hydrotele.gap.floor import perfect_tracks
from hydrotele.gap.residuals import residual_tests, rms
from hydrotele.gap.result import (
    Alternative,
    Candidate,
    Estimate,
    Gap,
    GapSize,
    NamedEffect,
    Prediction,
    Verdict,
)
from hydrotele.gap.search import MOST, Found, search
from hydrotele.gap.unknown import describe_unknown
from hydrotele.machine import Machine
from hydrotele.prediction.evidence import Evidence, Fit
from hydrotele.prediction.hypothesis import Guess, Hypothesis, hypotheses
from hydrotele.prediction.intervals import spreads
from hydrotele.prediction.levels import find_levels, known_levels
from hydrotele.prediction.stretches import busiest
from hydrotele.prediction.track import STEP, Track

_MOST_UNFLOORED = 4  # real machines without stated noise lack more than one effect
_ROUGH_STEP = 2.0e-3  # s, where the noise is not known and far above the integrator's errors
_NO_FLOOR = (
    "The machine states no accuracy of its sensors: an error counts by its mean over half a second,"
    " in units of the given model's errors, and it cannot be said whether what remains is noise or"
    " another effect."
)
SURE = 0.95  # probability below which an effect is called ambiguous
DOUBTFUL = 0.1  # largest probability next to an unknown effect; 2 of 48 blind ones were true
_WORTH_TELLING = 0.005  # probability below which an alternative is left out
_NORMAL95 = 1.96
Progress = Callable[[str, float], None]


def find_gap(
    data: Dataset,
    progress: Progress | None = None,
    effects: Sequence[str] = (),
    jobs: int = 2,
) -> Gap:
    """Find where a model and its logs disagree.

    Args:
        data: the logs; the fit runs decide, the held-out run judges.
        progress: called with (what is being done, share done).
        effects: names of the effects to try; all if empty.
        jobs: threads.

    Returns:
        The gap, named or not.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text, share: None)
    candidates = hypotheses(data.machine, effects)
    data = busiest(data)
    floored = known_levels(data)
    if not floored:
        tell("find the noise levels", 0.0)
        with ThreadPoolExecutor(jobs) as pool:
            data = find_levels(data, pool.map)
    evidence = Evidence(data, data.fit, jobs, STEP if floored else _ROUGH_STEP)
    try:
        found = search(evidence, candidates, progress, MOST if floored else _MOST_UNFLOORED)
        runs = (data.heldout, *data.fit)
        tell("judge on the held-out run", 0.95)
        before = evidence.track(data.machine, runs)
        patched = found.guess.machine(data.machine)
        after = evidence.track(patched, runs) if found.guess.parts else before
        tests, floor = _tests(evidence, found.guess, after) if floored else ({}, None)
        scatter = tests.get("constancy", {}).get("value", 1.0)
        spread = spreads(evidence, found.fit, scatter) if found.fit else np.zeros(0)
    finally:
        evidence.close()
    unit = 1.0 if floored else rms(np.concatenate([t.whitened for t in before[1:]]))
    failed = any(not test["passed"] for test in tests.values())
    named = _named(found, spread, failed)
    verdict = _verdict(named, failed)
    predictions = tuple(_prediction(t, data, unit) for t in before)
    improved = tuple(_prediction(t, data, unit) for t in after)
    unknown = describe_unknown(patched, data, improved) if failed else None
    laws, units = _laws(data, patched)
    tell("done", 1.0)
    return Gap(
        machine=data.machine,
        patched=patched,
        verdict=verdict,
        effects=named,
        unknown=unknown,
        size=GapSize(rms(before[0].whitened) / unit, rms(after[0].whitened) / unit, floor),
        ranking=tuple(
            Candidate(
                s.hypothesis.name, s.hypothesis.location, s.gain, s.gain - s.score,
                s.hypothesis.values(s.start),
            )
            for s in found.ranking[:15]
        ),
        before=predictions,
        after=improved,
        laws=laws,
        law_units=units,
        tests=tests,
        next_experiment=_experiment(data.machine, verdict, named, unknown),
        notes=(*data.notes, *_notes(found), *([] if floored else [_NO_FLOOR])),
        seconds=time.perf_counter() - begin,
    )  # fmt: skip


def _tests(evidence: Evidence, guess: Guess, tracks: Sequence[Track]):
    """Tests of what a guess leaves, and the noise floor, against readings made by the guess."""
    data = evidence.data
    perfect = perfect_tracks(guess.machine(data.machine), data, tracks)
    tests = residual_tests(tracks, data.channels, perfect)
    if guess.parts:
        made = Evidence(data, [track.run for track in perfect[1:]], 1, evidence.step)
        try:
            evidence.set_base(guess)
            made.set_base(guess)
            tests["constancy"] = constancy(evidence, guess, made)
        finally:
            made.close()
    return tests, rms(perfect[0].whitened)


def _verdict(named: Sequence[NamedEffect], failed: bool) -> Verdict:
    if failed:
        return "unknown"
    if not named:
        return "no_gap"
    return "named" if all(effect.probability >= SURE for effect in named) else "ambiguous"


def _named(found: Found, spread: np.ndarray, failed: bool) -> tuple[NamedEffect, ...]:
    effects, first = [], 0
    for index, (hypothesis, deviation) in enumerate(found.guess.parts):
        own = spread[first : first + hypothesis.size]
        first += hypothesis.size
        chance, others = _chances(found.scores[index], found.rivals[index])
        if failed:
            chance = min(chance, DOUBTFUL)
        effects.append(
            NamedEffect(
                hypothesis.name, hypothesis.location, chance,
                _estimates(hypothesis, deviation, own), others,
            )
        )  # fmt: skip
    return tuple(sorted(effects, key=lambda effect: -effect.probability))


def _estimates(hypothesis: Hypothesis, deviation: np.ndarray, spread: np.ndarray):
    values = hypothesis.values(deviation)
    table = {}
    for (key, p), own in zip(hypothesis.parameters.items(), spread, strict=True):
        reach = _NORMAL95 * own * p.scale
        low, high = max(p.low, values[key] - reach), min(p.high, values[key] + reach)
        table[key] = Estimate(values[key], p.unit, low, high, p.nominal)
    return table


def _chances(score: float, rivals: Sequence[Fit]) -> tuple[float, tuple[Alternative, ...]]:
    """Probability of an effect and of its rivals, from their evidence."""
    scores = np.array([score, *(fit.score for fit in rivals)])
    weights = np.exp(0.5 * (scores - scores.max()))
    weights /= weights.sum()
    others = []
    for fit, weight in zip(rivals, weights[1:], strict=True):
        rival = fit.guess.parts[-1][0]
        if weight >= _WORTH_TELLING:
            others.append(Alternative(rival.name, rival.location, float(weight)))
    return float(weights[0]), tuple(others)


def _prediction(track: Track, data: Dataset, unit: float) -> Prediction:
    run = track.run
    clock = run.start + run.period * np.arange(len(run.command))
    return Prediction(
        run.name, clock, data.channels, track.predicted, run.reading, track.whitened / unit
    )


def _laws(data: Dataset, patched: Machine):
    """Balance residuals of the held-out run before and after."""
    log = data.heldout.log
    before = balances(data.machine, log, data.sensors)
    after = balances(patched, log, data.sensors) if patched is not data.machine else before
    laws, units = {}, {}
    for law, places in before.items():
        laws[law] = {
            place: {
                "before": found.rms,
                "after": after[law][place].rms,
                "noise": found.rms / found.normalised_rms if found.normalised_rms > 0 else 0.0,
            }
            for place, found in places.items()
        }
        units[law] = next(iter(places.values())).unit
    return laws, units


def _experiment(machine: Machine, verdict: Verdict, named: Sequence[NamedEffect], unknown):
    if verdict == "unknown" and unknown:
        place = unknown.channel.partition(".")[2] or "supply"
        return next_experiment(machine, "no known effect explains the data", [(unknown.law, place)])
    if verdict != "ambiguous":
        return None
    unsure = [e for e in named if e.probability < SURE]
    pairs = [(e.name, e.location) for e in unsure]
    pairs += [(a.name, a.location) for e in unsure for a in e.alternatives]
    return next_experiment(machine, "these effects cannot be told apart with this data", pairs)


def _notes(found: Found) -> list[str]:
    if not found.weak:
        return []
    hypothesis, deviation = found.weak.guess.parts[-1]
    values = hypothesis.values(deviation)
    told = ", ".join(
        f"{key} {values[key]:.4g} {p.unit} (model: {p.nominal:.4g})"
        for key, p in hypothesis.parameters.items()
    )
    return [
        f"A trace of {hypothesis.name} at {hypothesis.location}, {told}, is smaller than worth"
        " naming and was left out."
    ]
