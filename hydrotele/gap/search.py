"""From the errors of the given model to named effects: screen, fit, calibrate, compare rivals.

Every guess is judged with noise levels of its own (`estimate.levels`): what it leaves over is
counted as unknown inputs, so that a model that is only nearly right is not refuted by the first
reading that it misses. A guess is better if it is more likely over most stretches of the runs, not
in a few readings (`weights`).

Effects that are looked for as if nothing unknown acted: only sensors are noisy.

Where a model lacks much, the unknown forces, flows and commands of the given machine are so large
that they explain what an effect does as well as the effect itself, and its signature is hidden. A
filter without them follows worse the more is lacking, and the right effect stands out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import MIDDLE, Evidence, Fit, Judged, invert_information, occam_penalty
from hydrotele.estimate.hypothesis import (
    CALIBRATION,
    Guess,
    Hypothesis,
    calibration,
    numbers,
    with_shape,
)
from hydrotele.estimate.levels import check_filter_follows, input_excess, noise_prior
from hydrotele.estimate.track import COARSE, Levels, Track, track_run
from hydrotele.gap.calibrating import (
    FIT_STEPS,
    calibrated,
    calibration_of,
    ended,
    fit_until_settled,
    fitted,
    free_of_calibration,
    given_again,
    let_out,
    loss_of,
    mostly_right,
    polished,
    promoted,
    strained,
    taken_back,
    uncalibrated,
    widened,
)
from hydrotele.gap.rivals import (
    ENTER,
    TOLD,
    Rival,
    better,
    differs_significantly,
    find_rivals,
    idle,
    is_case_of,
    moved_last,
    plain_form,
    pruned,
    rests_of,
    telling,
    without_needless,
    worth_naming,
)
from hydrotele.gap.screening import Screened, rattling, screen, shaken, timed
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


def without_inputs(evidence: Evidence, base: Judged, candidates: Sequence[Hypothesis]) -> WithoutInputs:
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


def _beside_calibration(evidence: Evidence, base: Judged, now: Judged) -> list[tuple[Judged, float]]:
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
                begin[held.index(name)] = d * p.prior_std / group.parameters[name].prior_std
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
        return track_run(machine, evidence.data, near.run, None, evidence.step, levels, rest=near.rest)

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


_ALIKE = 0.5  # of the squares of what an effect changes, that a number that does the same leaves
LACKING = 30.0  # twice the log likelihood that unknown inputs must bring to be there at all
_MOSTLY = 0.5  # of what the given machine lacks: less is left by what explains it mostly
_NEARLY_NOTHING = 0.1  # of it: a calibration leaves more where more than numbers is wrong
_WRONG = ("force", "command")  # balances that lack something in every axis of a wrong machine
_LITTLE = 0.01  # of what the given machine lacks: an effect that leaves less is tried at once
_SHORT = 5  # candidates that are fitted after a screening
_JUDGED = 3  # of them that are judged with levels of their own
_PLAIN = 0.8  # of the best score, from which a number that stopped at its end comes before it
_NEAR = 0.3  # of the best fitted score: below it a candidate is not judged
_WORTH = 0.1  # of the best screened score: below it a candidate is not fitted
_PAIRED = 6  # candidates that are tried in pairs where no single one helps
_REFUSED = 3  # effects that may turn out to be none before a search ends
_OTHER = 0.05  # of a jitter, by which it is another one than the search was made with
_NIBBLED = 0.5  # of what is lacking, that an effect leaves after which a calibration is tried again
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Found:
    """What a search leaves.

    Attributes:
        base: the given machine, judged.
        judged: the guess, judged.
        fit: its last fit, or None without effects.
        ranking: the first screening, best first.
        charges: what each part of the guess costs.
        without: for each part the guess without it, fitted and judged; None for the calibration.
        rivals: for each part what was tried in its place.
        weak: a candidate that was clear but smaller than worth naming, or None.
    """

    base: Judged
    judged: Judged
    fit: Fit | None
    ranking: tuple[Screened, ...]
    charges: tuple[float, ...]
    without: tuple[Judged | None, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    weak: Fit | None

    def emptied(self) -> "Found":
        """The same search that named nothing."""
        return replace(self, judged=self.base, fit=None, charges=(), without=(), rivals=())

    @property
    def guess(self) -> Guess:
        """The named effects, and the calibration if there is one."""
        return self.judged.guess


def search(evidence: Evidence, candidates: Sequence[Hypothesis], progress: Progress | None = None) -> Found:
    """Add effects, or calibrate all numbers, as long as that brings enough; then compare rivals.

    Args:
        evidence: on the fit runs, with levels of its own.
        candidates: the hypotheses.
        progress: called with (what is done, share done).

    Returns:
        What was found.
    """
    tell = progress or (lambda text, share: None)
    tell("estimate the noise levels of the given model", 0.0)
    base = evidence.set_base(Guess())
    check_filter_follows(base.tracks, evidence.data.channels)
    evidence.keep(base)
    candidates = timed(candidates, base)
    grown = _begun(evidence, base, candidates, tell)
    jittered = evidence.with_jitter(grown.now)
    before, after = (judged.tracks[0].levels.jitter for judged in (grown.now, jittered))
    if abs(after - before) > _OTHER * max(after, before):  # before, what the model lacked hid it
        tell("repeat the search with sampling jitter", 0.03)
        evidence.set_base(jittered)
        base = evidence.set_base(evidence.judged(Guess(), reopened=True))
        grown = _begun(evidence, base, candidates, tell)
    if grown.fit and not grown.toothed:
        now, fit = _with_teeth(evidence, grown.now, grown.fit, candidates, tell)
        if now is not grown.now:
            begin = replace(grown, now=now, fit=fit, early=(), toothed=True)
            grown = _grow(evidence, base, begin, candidates, tell)
    if grown.fit and mostly_right(grown.now.guess, grown.fit):
        grown = _sparse(evidence, base, grown, candidates, tell)
    grown = _by_number(evidence, _plain(evidence, grown, candidates), candidates)
    grown = _given_back(evidence, grown)
    evidence.keep(grown.now)
    return _compared(evidence, base, grown, tell)


def _begun(evidence: Evidence, base: Judged, candidates: Sequence[Hypothesis], tell: Progress) -> "_Grown":
    """A search from the given machine: how far it gets."""
    tell("evaluate every effect without residual inputs", 0.03)
    bold = without_inputs(evidence, base, candidates)
    options = [option for option in bold.options if option[1] > ENTER]
    ahead, _ = min(options, key=_score, default=(base, 0.0))
    if not calibration_of(ahead.guess):  # else beside it
        teeth = rattling(evidence, base.guess, ahead, shaken(evidence, candidates, (base, ahead)))
        if teeth and teeth.loss < base.loss:
            options.append((teeth, base.loss - teeth.loss - ENTER))
    begin = _Grown(base, early=sorted(options, key=_score), first=bold.ranking)
    return _grow(evidence, base, begin, candidates, tell)


@dataclass(frozen=True)
class _Grown:
    """How far a search has got.

    Attributes:
        now: the guess, judged.
        fit: its last fit, or None without effects.
        first: the first screening, best first.
        rankings: name and location of an effect -> the screening in which it was found.
        weak: a candidate that was clear but smaller than worth naming, or None.
        early: options that were found without a screening, best first.
        calibrates: whether all uncertain numbers may be fitted together.
        toothed: whether teeth were looked for beside a calibration.
    """

    now: Judged
    fit: Fit | None = None
    first: Sequence[Screened] = ()
    rankings: Mapping[tuple[str, str], Sequence[Screened]] = field(default_factory=dict)
    weak: Fit | None = None
    early: Sequence[tuple[Judged, float]] = ()
    calibrates: bool = True
    toothed: bool = False


def _grow(
    evidence: Evidence, base: Judged, begin: _Grown, candidates: Sequence[Hypothesis],
    tell: Progress,
) -> _Grown:  # fmt: skip
    """Add what brings most, again and again."""
    now, fit, weak, first = begin.now, begin.fit, begin.weak, begin.first
    early, rankings = begin.early, dict(begin.rankings)
    refused, tried, roomy, worth, toothed = 0, False, False, 0.0, begin.toothed
    ranked: Sequence[Screened] | None = None  # of the present guess
    ahead: tuple[Judged | None, float] | None = None  # a calibration of the present guess
    if begin.calibrates and _wrong_everywhere(evidence, base, begin):
        tell("calibrate the uncertain parameters", 0.06)
        ahead = other, _ = calibrated(evidence, now)
        if other and lacking(other, evidence) < _NEARLY_NOTHING * lacking(now, evidence):
            now, fit = fit_until_settled(evidence, other)
            now, fit = _with_teeth(evidence, now, fit, candidates, tell)
            tried, toothed, ahead = True, True, None
    while refused < _REFUSED:
        done = 0.85 * (1.0 - 0.7 ** len(now.guess.parts)) + 0.05
        if early and lacking(early[0][0], evidence) < _LITTLE * lacking(base, evidence):
            options = list(early)
        else:
            if ranked is None:
                tell("evaluate every effect", done)
                open_ones = free_of_calibration(_lacked(evidence, candidates, now), now.guess)
                ranked = screen(evidence, now.guess, open_ones)
                first = first if rankings else ranked
            options = sorted([*_best_singles(evidence, now, ranked), *early], key=_score)
            if not options and lacking(now, evidence) > LACKING and len(ranked) > 1:
                options = _best_pairs(evidence, now, ranked)
        early = []  # once: what is refused does not come back
        moved = promoted(evidence, now, fit, candidates) if fit else None
        let_go, ready = _let_go(evidence, now, moved) if moved else (None, None)
        if let_go:
            options = sorted([*options, let_go], key=_score)
            if let_go[1] > _PLAIN * options[0][1] and ended(now.guess):
                options = [let_go, *(one for one in options if one is not let_go)]
        small = []
        while options and not worth_naming(options[0][0].guess, -1, options[0][1]):
            judged, worth = options.pop(0)
            weak = Fit(judged.guess, 0.0, worth, 0.0, np.eye(1))
            small.append(judged.guess.parts[-1][0].key)
        candidates = [c for c in candidates if c.key not in small]
        ranked = _others(ranked, small)
        if small and not options:
            refused += 1
            continue
        best, worth = options[0] if options else (None, 0.0)
        grown, settled = now, fit
        if best:
            added = best.guess.parts[-1][0]
            tell(f"fit {added.name.replace('_', ' ')}", done + 0.02)
            if ready and let_go and best is let_go[0]:
                grown, settled = evidence.set_base(best), ready
            else:
                grown, settled = fit_until_settled(evidence, best)
            grown, settled = _shaped_settled(evidence, grown, settled)
            worth = now.loss - grown.loss - settled.occam_penalty
            last = len(grown.guess.parts) - 1
            if moved and best.guess.hypotheses == moved[0].hypotheses:
                worth = max(worth, moved[1])  # what the number cost is paid already
            if worth < ENTER or strained(grown.guess, -1) or not differs_significantly(grown.guess, settled, last):
                evidence.set_base(now)
                candidates = [c for c in candidates if c.key != added.key]
                ranked = _others(ranked, [added.key])
                refused += 1
                continue
        # effects that take little each: numbers are wrong everywhere, which showed less before them
        nibbled = lacking(grown, evidence) > _NIBBLED * lacking(now, evidence)
        if (
            begin.calibrates
            and not calibration_of(now.guess)
            and lacking(grown, evidence) > LACKING
            and (best is None or not tried or nibbled)
        ):
            tell("calibrate the uncertain parameters", done + 0.04)
            tried = True
            evidence.set_base(now)
            other, gain = ahead or calibrated(evidence, now)
            if other and gain > max(worth, ENTER):
                best = other
                grown, settled = fit_until_settled(evidence, other)
            elif best:
                evidence.set_base(grown)
        if best is None:
            wider = widened(now.guess, calibration=True)
            if roomy or wider.hypotheses == now.guess.hypotheses:
                break
            tell("calibrate with wider bounds", done + 0.04)
            now, fit = fit_until_settled(evidence, evidence.judged(wider))
            ranked, roomy, ahead = None, True, None
            continue
        if calibration_of(grown.guess) and settled and not toothed:
            toothed = True
            grown, settled = _with_teeth(evidence, grown, settled, candidates, tell)
        for part in grown.guess.parts[len(now.guess.parts) :]:
            rankings[part[0].key] = first if ranked is None else ranked
        now, fit, ranked, ahead = grown, settled, None, None
        evidence.keep(now)
    return replace(begin, now=now, fit=fit, first=first, rankings=rankings, weak=weak, toothed=toothed)


def _wrong_everywhere(evidence: Evidence, base: Judged, begin: _Grown) -> bool:
    """Whether nothing is named yet, and forces and commands of all of several axes lack something.

    No effect does that but one of all oil or of the supply, which is found as if nothing unknown
    acted: it is numbers that are wrong, and an effect beside them shows after a calibration.
    """
    axes = set(evidence.data.axes)
    inputs = begin.now.tracks[0].levels.inputs
    found = begin.early and lacking(begin.early[0][0], evidence) < _MOSTLY * lacking(base, evidence)
    return (
        len(axes) > 1 and not begin.now.guess.parts and not found
        and all(axes <= {i.axis for i in inputs if i.balance == kind} for kind in _WRONG)
    )  # fmt: skip


def _with_teeth(
    evidence: Evidence, now: Judged, fit: Fit, candidates: Sequence[Hypothesis], tell: Progress
) -> tuple[Judged, Fit]:
    """A guess with teeth in an axis that still shakes, if that is likelier; else as it is.

    Where all numbers are wrong, teeth explain nothing before these are right; and calibrated
    without teeth, numbers of their own axis make up for them, which therefore begin as given.
    """
    axes = shaken(evidence, candidates, (now,))
    if not axes:
        return now, fit
    tell("search for backlash", 0.7)
    teeth = rattling(evidence, given_again(now.guess, axes), now, axes)
    if teeth is not None:
        other, settled = fit_until_settled(evidence, teeth)
        if other.loss + settled.whole_penalty < now.loss + fit.whole_penalty - ENTER:
            return other, settled
        evidence.set_base(now)
    return now, fit


def _sparse(
    evidence: Evidence, base: Judged, grown: _Grown, candidates: Sequence[Hypothesis],
    tell: Progress,
) -> _Grown:  # fmt: skip
    """The same search without calibration, if that is likelier: few effects in a right machine.

    A calibration takes two effects at once, and a few pins, each by less than it is uncertain, take
    a sensor's offset. Where nearly all numbers stay as they were, that is the unlikelier story.
    """
    tell("repeat the search without calibration", 0.8)
    place = next(i for i, h in enumerate(grown.now.guess.hypotheses) if h.name == CALIBRATION)
    guess, fit, now = grown.now.guess.without(place), None, base
    if guess.parts:
        now, fit = fit_until_settled(evidence, evidence.judged(guess))
    else:
        evidence.set_base(base)
    begin = replace(grown, now=now, fit=fit, early=(), calibrates=False)
    other = _grow(evidence, base, begin, candidates, tell)
    if other.fit is None or _total(other) > _total(grown):
        evidence.set_base(grown.now)
        return grown
    return other


def _plain(evidence: Evidence, grown: _Grown, candidates: Sequence[Hypothesis]) -> _Grown:
    """Effects whose numbers say the same become their form with one number, where that is likelier.

    A dead band that is calibrated already is no candidate, but dead bands by direction are.
    """
    for index, (hypothesis, deviation) in enumerate(grown.now.guess.parts):
        plain = plain_form(hypothesis, candidates)
        if plain is None:
            continue
        assert grown.fit
        first = sum(h.size for h in grown.now.guess.hypotheses[:index])
        own = slice(first, first + hypothesis.size)
        covariance = invert_information(grown.fit.information)[own, own]
        apart = np.diff(np.eye(hypothesis.size), axis=0)  # of the numbers, one from the next
        gone = apart @ deviation
        if gone @ np.linalg.solve(apart @ covariance @ apart.T, gone) > TOLD * len(gone):
            continue
        (p,) = plain.parameters.values()
        start = (np.mean(list(hypothesis.values(deviation).values())) - p.nominal) / p.prior_std
        parts = list(grown.now.guess.parts)
        parts[index] = (plain, np.clip(np.array([start]), plain.low, plain.high))
        keys = {f"{plain.name}.{plain.location}.{key}" for key in plain.parameters}
        guess = uncalibrated(Guess(tuple(parts)), evidence.data.machine, keys)
        now, fit = fit_until_settled(evidence, evidence.judged(guess))
        other = replace(grown, now=now, fit=fit)
        if _total(other) < _total(grown):
            return _plain(evidence, other, candidates)
        evidence.set_base(grown.now)
    return grown


def _by_number(evidence: Evidence, grown: _Grown, candidates: Sequence[Hypothesis]) -> _Grown:
    """Effects that do what fewer calibrated numbers of their place would do become these numbers.

    A calibrated number is no candidate. One that is off by far more than it is uncertain is held
    near by its prior, and a richer effect, as friction of the position over all of its range, does
    the rest.
    """
    group = calibration_of(grown.now.guess)
    if group is None or grown.fit is None:
        return grown
    names = grown.now.guess.names
    slopes = evidence.base_slopes(evidence.slope_step)
    whole = evidence.errors(grown.now.guess, evidence.slope_step)
    place = grown.now.guess.hypotheses.index(group)
    for index, (effect, _) in enumerate(grown.now.guess.parts):
        if effect.name == CALIBRATION or effect.name not in EFFECTS:
            continue
        change: np.ndarray | None = None
        for known in candidates:
            keys = [f"{known.name}.{known.location}.{key}" for key in known.parameters]
            if (
                known.size >= effect.size
                or known.location != effect.location
                or not all(key in group.parameters for key in keys)
            ):
                continue
            if change is None:
                rest = evidence.errors(grown.now.guess.without(index), evidence.slope_step)
                change = whole - rest
            columns = slopes[:, [names.index(f"{CALIBRATION}.{group.location}.{k}") for k in keys]]
            move = np.linalg.lstsq(columns, change, rcond=None)[0]
            left = change - columns @ move
            if left @ left > _ALIKE * (change @ change):
                continue
            other = _replaced(evidence, grown, index, place, known, keys, move)
            if _total(other) < _total(grown):
                return _by_number(evidence, other, candidates)
            evidence.set_base(grown.now)
    return grown


def _replaced(
    evidence: Evidence, grown: _Grown, index: int, place: int, known: Hypothesis,
    keys: Sequence[str], move: np.ndarray,
) -> _Grown:  # fmt: skip
    """The search with an effect replaced by calibrated numbers as an effect, and settled."""
    parts = list(grown.now.guess.parts)
    group, deviation = parts[place]
    moved = deviation.copy()
    order = list(group.parameters)
    for key, more in zip(keys, move, strict=True):
        moved[order.index(key)] += more
    parts[place] = (group, moved)
    del parts[index]
    guess = let_out(evidence, Guess(tuple(parts)), place - (index < place), known)
    now, fit = fit_until_settled(evidence, evidence.judged(guess))
    return replace(grown, now=now, fit=fit)


def _given_back(evidence: Evidence, grown: _Grown) -> _Grown:
    """Effects that are uncertain numbers, and moved no further than these are uncertain.

    Before all effects were found, one of them may have moved so far that it became an effect. With
    the others in place it is back within what the machine file states: it is calibrated again
    unless it brings what an effect must.
    """
    if calibration_of(grown.now.guess) is None or grown.fit is None:
        return grown
    for index in range(len(grown.now.guess.parts)):
        guess = taken_back(grown.now.guess, evidence.data.machine, index)
        if guess is None:
            continue
        now, fit = fit_until_settled(evidence, evidence.judged(guess))
        other = replace(grown, now=now, fit=fit)
        if _total(other) < _total(grown) + ENTER:
            return _given_back(evidence, other)
        evidence.set_base(grown.now)
    return grown


def _total(grown: _Grown) -> float:
    """Loss of a guess and what all its numbers cost."""
    return grown.now.loss + (grown.fit.whole_penalty if grown.fit else 0.0)


def _compared(evidence: Evidence, base: Judged, grown: _Grown, tell: Progress) -> Found:
    """Drop what is needless, and compare each effect with its rivals."""
    now, fit, first = grown.now, grown.fit, tuple(grown.first)
    charges: list[float] = []
    rivals: list[Sequence[Rival]] = []
    without: tuple[Judged | None, ...] = ()
    open_ended, replaced = True, False
    while open_ended:
        tell("remove unnecessary effects", 0.87)
        now, fit, without = pruned(evidence, base, now, fit)
        tell("compare alternative effects", 0.9)
        charges, rivals = [], []
        for index, (hypothesis, _) in enumerate(now.guess.parts):
            assert fit
            charges.append(occam_penalty(moved_last(fit.information, now.guess, index), hypothesis.size))
            ranked, rest = grown.rankings.get(hypothesis.key, first), without[index]
            rivals.append(find_rivals(evidence, now, index, ranked, rest) if rest else ())
        needless = without_needless(now, charges, rivals)
        if needless is not None:
            now, fit = fit_until_settled(evidence, evidence.judged(needless))
            continue
        rivals = [[r for r in others if not idle(r)] for others in rivals]
        open_ended = False
        for index, rest in enumerate(without):
            if replaced or not rest:
                continue
            if rival := better(now, index, charges[index], rest, rivals[index]):
                assert rival.fit
                old = Rival(now.guess.parts[index][0], now, charges[index], fit)
                others = (r for r in rivals[index] if r is not rival)
                now, fit, charges[index] = rival.judged, rival.fit, rival.occam_penalty
                rivals[index] = [old, *others]
                # a rival comes last in its guess
                order = [*(i for i in range(len(without)) if i != index), index]
                charges, rivals = [charges[i] for i in order], [rivals[i] for i in order]
                replaced = True
                evidence.set_base(now)
                rests, scores = rests_of(evidence, base, now, fit)
                without = tuple(rests)
                open_ended = min(scores) < ENTER and len(scores) > 1  # beside it, not needed
                break
    if calibration_of(now.guess):
        now, fit = polished(evidence, now)
    else:
        evidence.set_base(now)
    compared = tuple(
        tuple(r for r in others if not is_case_of(evidence, now.guess, index, r.hypothesis))
        for index, others in enumerate(rivals)
    )
    return Found(base, now, fit, first, tuple(charges), without, compared, grown.weak)


def _let_go(
    evidence: Evidence, now: Judged, moved: tuple[Guess, float]
) -> tuple[tuple[Judged, float] | None, Fit | None]:
    """A guess of `promoted`, judged, and its score; its fit where a number had come to its end."""
    guess, gain = moved
    judged, fit = evidence.judged(guess), None
    if ended(now.guess):
        judged, fit = fit_until_settled(evidence, judged)
        evidence.set_base(now)
        gain += max(0.0, now.loss - judged.loss)
    return (judged, gain) if telling(now, judged, moved[1]) else None, fit


def _shaped_settled(evidence: Evidence, now: Judged, fit: Fit) -> tuple[Judged, Fit]:
    """The same where noise levels follow: with its shape if that is likelier."""
    guess = shaped(now.guess, evidence.data.machine)
    if guess is None:
        return now, fit
    other, settled = fit_until_settled(evidence, evidence.judged(guess, same=True))
    if other.loss + settled.whole_penalty < now.loss + fit.whole_penalty - ENTER:
        return other, settled
    evidence.set_base(now)
    return now, fit


def _lacked(evidence: Evidence, candidates: Sequence[Hypothesis], now: Judged) -> list[Hypothesis]:
    """Candidates without those of balances of an axis in which nothing is lacking any more.

    At first all are tried, beside a calibration, too: an effect may show where unknown inputs are
    too faint to be found.
    """
    if not _named_so_far(now.guess):
        return list(candidates)
    axes = {i.axis for i in now.tracks[0].levels.inputs}
    sound = set(evidence.data.axes) - axes
    return [
        c for c in candidates
        if c.location.partition(".")[0] not in sound
        or c.name not in EFFECTS or EFFECTS[c.name].model_part not in ("force", "flow", "valve")
    ]  # fmt: skip


def lacking(judged: Judged, evidence: Evidence) -> float:
    """Twice the log likelihood that the unknown inputs of a guess bring."""
    return sum(evidence.map(input_excess, judged.tracks))


def _others(ranked: Sequence[Screened] | None, keys: Sequence[tuple[str, str]]) -> Sequence[Screened] | None:
    """A ranking without some candidates."""
    return ranked and [r for r in ranked if r.hypothesis.key not in keys]


def _score(option: tuple[Judged, float]) -> float:
    """Order of options, best first."""
    return -option[1]


def _named_so_far(guess: Guess) -> int:
    return sum(h.name != CALIBRATION for h, _ in guess.parts)


def _best_singles(evidence: Evidence, now: Judged, ranked: Sequence[Screened]) -> list[tuple[Judged, float]]:
    """The best of the first few candidates that bring enough, judged, and their scores."""
    bar = max(0.5 * ENTER, _WORTH * ranked[0].score) if ranked else 0.0
    short = [s for s in ranked[:_SHORT] if s.score > bar]
    if not short:
        return []
    fits = fitted(evidence, now, short)
    inside = [fit for fit in fits if fit.score > ENTER and not strained(fit.guess, -1)]
    close = [f for f in (inside or fits)[:_JUDGED] if f.score > _NEAR * fits[0].score]
    return _judged_best(evidence, now, [f for f in close if f.score > 0.5 * ENTER])


def _judged_best(evidence: Evidence, now: Judged, fits: Sequence[Fit]) -> list[tuple[Judged, float]]:
    """Fits that bring enough with levels of their own and may be believed, and their scores."""
    judged = [evidence.judged(fit.guess) for fit in fits]
    scores = [now.loss - j.loss - fit.occam_penalty for j, fit in zip(judged, fits, strict=True)]
    options = [o for o in zip(judged, scores, strict=True) if o[1] >= ENTER and telling(now, o[0])]
    return sorted(options, key=_score)


def _best_pairs(evidence: Evidence, now: Judged, ranked: Sequence[Screened]) -> list[tuple[Judged, float]]:
    """The best pairs where no single effect helps by its signature, judged, and their scores.

    A single one that does all that a pair does is tried alone: signatures may have been too small.
    """
    pool = list(ranked[:_PAIRED])
    step = max(evidence.step_of(now.guess.plus(s.hypothesis, s.start), COARSE) for s in pool)
    ground = evidence.errors(now.guess, step)

    def shift(s: Screened) -> np.ndarray:
        start = s.start if np.any(s.start) else 0.3 * np.ones(s.hypothesis.size)
        return evidence.errors(now.guess.plus(s.hypothesis, start), step) - ground

    shifts = evidence.map(shift, pool)
    gains = {}
    for a in range(len(pool)):
        for some in [(a,), *((a, b) for b in range(a))]:
            columns = np.column_stack([shifts[k] for k in some])
            size = len(some)
            move = np.linalg.solve(columns.T @ columns + np.eye(size), -columns.T @ ground)
            left = ground + columns @ move
            gain = float(ground @ ground - left @ left - move @ move)
            gains[some] = gain - ENTER * size
    pairs = sorted(gains, key=gains.__getitem__, reverse=True)[:2]
    kept = evidence.base_slopes(evidence.slope_step)

    def fit_pair(pair: tuple[int, ...]) -> Fit:
        more = now.guess
        for index in pair:
            more = more.plus(pool[index].hypothesis, pool[index].start)
        before = loss_of(evidence, now.guess, MIDDLE)
        found = evidence.fit(more, before, parallel=False, step=MIDDLE, kept=kept, steps=FIT_STEPS)
        sizes = sum(h.size for h, _ in more.parts[len(now.guess.parts) :])
        return Fit(found.guess, found.loss, found.gain, occam_penalty(found.information, sizes),
                   found.information)  # fmt: skip

    first = len(now.guess.parts)
    fits = [
        fit for fit in evidence.map(fit_pair, pairs) if fit.score > ENTER
        and not any(strained(fit.guess, k) for k in range(first, len(fit.guess.parts)))
    ]  # fmt: skip
    return _judged_best(evidence, now, fits)
