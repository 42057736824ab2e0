"""Effects that are looked for as if nothing unknown acted: only sensors are noisy.

Where a model lacks much, the unknown forces, flows and commands of the given machine are so large
that they explain what an effect does as well as the effect itself, and its signature is hidden. A
filter without them follows worse the more is lacking, and the right effect stands out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.estimate.calibration import calibration, numbers
from hydrotele.estimate.evidence import MIDDLE, Evidence, Judged, occam_penalty
from hydrotele.estimate.hypothesis import Guess, Hypothesis, with_shape
from hydrotele.estimate.levels import noise_prior
from hydrotele.estimate.track import COARSE, Levels, Track, track_run
from hydrotele.gap.calibrating import fitted, strained
from hydrotele.gap.rivals import ENTER
from hydrotele.gap.screening import Screened, screen
from hydrotele.machine.machine import Machine

_MUCH = 2.0  # RMS of the errors without unknown inputs, over noise, from which much is lacking
_TRIED = 5  # candidates that are fitted
_MOST = 3  # effects, one after the other
_PART = 0.5  # of what is left of the errors' squares, that an effect must take at least
_ROUNDS = 2  # of a calibration beside effects


@dataclass(frozen=True)
class WithoutInputs:
    """What was found: guesses judged with levels of their own, and the first signatures.

    Attributes:
        options: guesses and their scores beside the given machine.
        ranking: candidates by their signatures, best first.
    """

    options: tuple[tuple[Judged, float], ...]
    ranking: tuple[Screened, ...]


def without_inputs(
    evidence: Evidence, base: Judged, candidates: Sequence[Hypothesis]
) -> WithoutInputs:
    """Effects that take most of what is lacking, one after the other, then with a calibration.

    Args:
        evidence: on the fit runs; its base is the given machine afterwards.
        base: the given machine, judged.
        candidates: the hypotheses.

    Returns:
        Nothing where not much is lacking.
    """
    now, options, first = _alone(evidence, Guess()), [], ()
    while _rms(now) > _MUCH and len(now.guess.parts) < _MOST:
        evidence.set_base(now)
        ranked = screen(evidence, now.guess, candidates)
        first = first or tuple(ranked)
        fits = fitted(evidence, now, ranked[:_TRIED])
        fits = [fit for fit in fits if fit.score > 0.0 and not strained(fit.guess, -1)]
        if not fits:
            break
        after = _alone(evidence, fits[0].guess)
        if _excess(after) > (1.0 - _PART) * _excess(now):
            break
        now = _shaped_alone(evidence, after)
        if _rms(now) <= _MUCH or len(now.guess.parts) == 1:
            options.append(_option(evidence, base, now))
    if now.guess.parts and _rms(now) > _MUCH:
        options += _beside_calibration(evidence, base, now)
    evidence.set_base(base)
    return WithoutInputs(tuple(options), first)


def _beside_calibration(
    evidence: Evidence, base: Judged, now: Judged
) -> list[tuple[Judged, float]]:
    """Effects that are no uncertain numbers with all that are; empty without such effects."""
    table = numbers(evidence.data.machine)
    keys = {number.effect[:2] for number in table.values() if number.effect}
    parts = tuple(part for part in now.guess.parts if part[0].key not in keys)
    group = calibration(evidence.data.machine, frozenset(Guess(parts).names))
    if not parts or not group.parameters:
        return []
    begin, held = np.zeros(group.size), list(group.parameters)
    for hypothesis, deviation in now.guess.parts:  # the others begin where they were found
        for (key, p), d in zip(hypothesis.parameters.items(), deviation, strict=True):
            name = f"{hypothesis.name}.{hypothesis.location}.{key}"
            if name in held:
                begin[held.index(name)] = d * p.scale / group.parameters[name].scale
    guess = Guess(parts).plus(group, np.clip(begin, group.low, group.high))
    for _ in range(_ROUNDS):
        evidence.set_base(_alone(evidence, guess))
        slopes = evidence.base_slopes(evidence.step_of(guess, COARSE))
        guess = evidence.fit(guess, 0.0, step=evidence.step_of(guess, MIDDLE), kept=slopes).guess
    return [_option(evidence, base, _alone(evidence, guess))]


def shaped(guess: Guess, machine: Machine) -> Guess | None:
    """A guess whose last effect has its optional numbers to fit, too; None if it has none."""
    hypothesis, deviation = guess.parts[-1]
    whole = with_shape(hypothesis, machine)
    if whole is None:
        return None
    more = np.zeros(whole.size - hypothesis.size)
    return Guess(guess.parts[:-1]).plus(whole, np.append(deviation, more))


def _shaped_alone(evidence: Evidence, now: Judged) -> Judged:
    """The last effect with the shape that it needs, as long as nothing unknown acts.

    A spring with another damping than usual may be taken for teeth, which are looked for for
    minutes.
    """
    guess = shaped(now.guess, evidence.data.machine)
    if guess is None:
        return now
    evidence.set_base(now)
    fit = evidence.fit(guess, 0.0, step=evidence.step_of(guess, MIDDLE))
    after = _alone(evidence, fit.guess)
    cost = occam_penalty(fit.information, guess.hypotheses[-1].size)
    return after if after.loss + cost < now.loss - ENTER else now


def _alone(evidence: Evidence, guess: Guess) -> Judged:
    """A guess with its sensors' noise alone."""
    machine, levels = guess.machine(evidence.data.machine), _sensors(evidence)

    def track(near: Track):
        return track_run(
            machine, evidence.data, near.run, None, evidence.step, levels, rest=near.rest
        )

    tracks = tuple(evidence.map(track, evidence.tracks))
    return Judged(guess, tracks, sum(t.loss for t in tracks))


def _option(evidence: Evidence, base: Judged, alone: Judged) -> tuple[Judged, float]:
    """A guess with levels of its own, and its score beside the given machine."""
    evidence.set_base(alone)
    slopes = evidence.base_slopes(evidence.slope_step)
    information = slopes.T @ slopes + np.eye(slopes.shape[1])
    judged = evidence.judged_from(alone.guess, _sensors(evidence))
    return judged, base.loss - judged.loss - occam_penalty(information, len(information))


def _sensors(evidence: Evidence) -> Levels:
    jitter = evidence.tracks[0].levels.jitter
    return Levels(noise_prior(evidence.data).noise, jitter=jitter)


def _excess(judged: Judged) -> float:
    """Mean square of the errors beyond that of noise."""
    errors = np.concatenate([track.whitened.ravel() for track in judged.tracks])
    return float(np.nanmean(errors**2)) - 1.0


def _rms(judged: Judged) -> float:
    return float(np.sqrt(_excess(judged) + 1.0))
