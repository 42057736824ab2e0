"""From the errors of the given model to named effects: screen, fit, calibrate, compare rivals.

Every guess is judged with noise levels of its own (`prediction.levels`): what it leaves over is
counted as unknown inputs, so that a model that is only nearly right is not refuted by the first
reading that it misses. A guess is better if it is more likely over most stretches of the runs, not
in a few readings (`weights`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.gap.screening import Screened, screen
from hydrotele.prediction.calibration import CALIBRATION, calibration, numbers
from hydrotele.prediction.evidence import MIDDLE, Evidence, Fit, Judged, charge
from hydrotele.prediction.hypothesis import Guess, Hypothesis
from hydrotele.prediction.inputs import Input
from hydrotele.prediction.levels import input_excess, smoothed_inputs
from hydrotele.prediction.track import COARSE

ENTER = 15.0  # twice the log evidence an effect must bring; 100 clean machines stay below 14.7
LACKING = 30.0  # twice the log likelihood that unknown inputs must bring to be there at all
_BEYOND_DOUBT = 300.0  # score of an effect that is named however small: an integrator of first
# order at 1 ms alone looks like a delay of 0.5 ms with a score of 267
_SETTLES = 6  # rounds of levels and fit: what inputs took at first is given back bit by bit
_ROOM = 3.0  # times the room to a bound that an effect gets that stands there
_STEPS = 3  # of Gauss-Newton for a candidate
_SHORT = 5  # candidates that are fitted after a screening
_JUDGED = 3  # of them that are judged with levels of their own
_NEAR = 0.3  # of the best fitted score: below it a candidate is not judged
_RIVALS = 3  # candidates that are judged in the place of a named effect
_HOPELESS = 500.0  # loss above the effect's after two steps, beyond which a rival is let go
_WORTH = 0.1  # of the best screened score: below it a candidate is not fitted
_PAIRED = 6  # candidates that are tried in pairs where no single one helps
_REFUSED = 3  # effects that may turn out to be none before a search ends
_DRAWS = 4000  # of the Bayesian bootstrap
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Rival:
    """Another effect in the place of a named one: its guess judged, and its charge."""

    hypothesis: Hypothesis
    judged: Judged
    charge: float


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

    @property
    def guess(self) -> Guess:
        """The named effects, and the calibration if there is one."""
        return self.judged.guess


def search(
    evidence: Evidence, candidates: Sequence[Hypothesis], progress: Progress | None = None
) -> Found:
    """Add effects, or calibrate all numbers, as long as that brings enough; then compare rivals.

    Args:
        evidence: on the fit runs, with levels of its own.
        candidates: the hypotheses.
        progress: called with (what is done, share done).

    Returns:
        What was found.
    """
    tell = progress or (lambda text, share: None)
    tell("find noise levels of the given model", 0.0)
    base = now = evidence.set_base(Guess())
    fit, weak, first, refused, tried = None, None, (), 0, False
    candidates = _timed(candidates, base)
    rankings: dict[tuple[str, str], Sequence[Screened]] = {}
    worth = 0.0
    while refused < _REFUSED:
        done = 0.85 * (1.0 - 0.7 ** len(now.guess.parts)) + 0.05
        tell(f"try every effect ({_named_so_far(now.guess)} named so far)", done)
        ranked = screen(evidence, now.guess, _free(candidates, now.guess))
        first = first or tuple(ranked)
        best, worth = _best_single(evidence, now, ranked)
        if best is None and lacking(now, evidence) > LACKING and len(ranked) > 1:
            best, worth = _best_pair(evidence, now, ranked)
        grown, settled = now, fit
        if best:
            added = best.guess.parts[-1][0]
            if not worth_naming(best.guess, -1, worth):
                weak = Fit(best.guess, 0.0, worth, 0.0, np.eye(1))
                candidates = [c for c in candidates if c.key != added.key]
                refused += 1
                continue
            tell(f"fit {added.name.replace('_', ' ')}", done + 0.02)
            grown, settled = settle(evidence, best)
            worth = now.loss - grown.loss - settled.charge
            if worth < ENTER or _strained(grown.guess, -1):
                evidence.set_base(now)
                candidates = [c for c in candidates if c.key != added.key]
                refused += 1
                continue
        if (
            not _calibration_of(now.guess)
            and lacking(grown, evidence) > LACKING
            and (best is None or not tried)
        ):
            tell("calibrate the uncertain numbers", done + 0.04)
            tried = True
            evidence.set_base(now)
            other, gain = _calibrated(evidence, now)
            if other and gain > max(worth, ENTER):
                best = other
                grown, settled = settle(evidence, other)
            elif best:
                evidence.set_base(grown)
        if best is None:
            break
        for part in grown.guess.parts[len(now.guess.parts) :]:
            rankings[part[0].key] = ranked
        now, fit = grown, settled
        now, fit = _promoted(evidence, now, fit, candidates)
    tell("drop what is needless", 0.87)
    now, fit, without = _pruned(evidence, base, now, fit)
    tell("compare rivals", 0.9)
    charges, rivals = [], []
    for index, (hypothesis, _) in enumerate(now.guess.parts):
        assert fit
        charges.append(charge(_last(fit.information, now.guess, index), hypothesis.size))
        ranked = rankings.get(hypothesis.key, first)
        rest = without[index]
        rivals.append(_rivals(evidence, now, index, ranked, rest) if rest else ())
    return Found(base, now, fit, first, tuple(charges), without, tuple(rivals), weak)


def _timed(candidates: Sequence[Hypothesis], base: Judged) -> list[Hypothesis]:
    """Candidates of which those that act for a while only begin when the unknown inputs say so."""
    inputs = base.tracks[0].levels.inputs
    series = None
    found = []
    for candidate in candidates:
        acts = Input("force", candidate.location)
        if not {"size", "start", "duration"} <= candidate.parameters.keys() or acts not in inputs:
            found.append(candidate)
            continue
        if series is None:
            series = [smoothed_inputs(t) for t in base.tracks]
        place = inputs.index(acts)
        spans = [
            _loudest(u[:, place], t.run.period) for u, t in zip(series, base.tracks, strict=True)
        ]
        best = int(np.argmax([span[0] for span in spans]))
        _, size, first, rows = spans[best]
        run, table = base.tracks[best].run, dict(candidate.parameters)
        table["size"] = replace(table["size"], starts=(size,))
        for key, value in (
            ("start", run.start + first * run.period),
            ("duration", rows * run.period),
        ):
            table[key] = replace(table[key], nominal=value)
        found.append(replace(candidate, parameters=table))
    return found


def _loudest(u: np.ndarray, period: float) -> tuple[float, float, int, int]:
    """The span of a series (n,) whose mean stands out most: its score, mean, first row, rows."""
    total = np.concatenate([[0.0], np.cumsum(u - np.median(u))])
    best = (0.0, 0.0, 0, 1)
    rows = max(2, round(0.1 / period))
    while rows < 0.7 * len(u):
        sums = total[rows:] - total[:-rows]
        at = int(np.argmax(np.abs(sums)))
        score = float(sums[at] ** 2 / rows)
        if score > best[0]:
            best = score, float(sums[at] / rows), at, rows
        rows = max(rows + 1, int(1.3 * rows))
    return best


def lacking(judged: Judged, evidence: Evidence) -> float:
    """Twice the log likelihood that the unknown inputs of a guess bring."""
    return sum(evidence.map(input_excess, judged.tracks))


def weights(blocks: Sequence[np.ndarray], charges: Sequence[float], seed: int = 0) -> np.ndarray:
    """(K,) probabilities of K guesses from the blocks of their runs.

    Stretches of the runs are drawn anew with weights of their own (Bayesian bootstrap), so that a
    guess that is better in a few places only is not preferred for sure (pseudo-BMA+ of Yao et al.
    2018, Bayesian Analysis 13(3), section 3.4, with the likelihood of one-step predictions).

    Args:
        blocks: K arrays (B,) of -2 log likelihood.
        charges: what each guess's parameters cost, in the same unit.
        seed: of the draws.

    Returns:
        Probabilities that sum to 1.
    """
    table = np.stack(list(blocks))
    count = table.shape[1]
    draws = count * np.random.default_rng(seed).dirichlet(np.ones(count), _DRAWS)
    totals = draws @ (table - table.min(axis=0)).T + np.asarray(charges)
    chances = np.exp(-0.5 * (totals - totals.min(axis=1, keepdims=True)))
    return (chances / chances.sum(axis=1, keepdims=True)).mean(axis=0)


def _named_so_far(guess: Guess) -> int:
    return sum(h.name != CALIBRATION for h, _ in guess.parts)


def _calibration_of(guess: Guess) -> Hypothesis | None:
    return next((h for h, _ in guess.parts if h.name == CALIBRATION), None)


def _free(candidates: Sequence[Hypothesis], guess: Guess) -> list[Hypothesis]:
    """Candidates that change no number that is calibrated already."""
    group = _calibration_of(guess)
    if group is None:
        return list(candidates)
    return [
        c for c in candidates
        if not any(f"{c.name}.{c.location}.{key}" in group.parameters for key in c.parameters)
    ]  # fmt: skip


def _best_single(
    evidence: Evidence, now: Judged, ranked: Sequence[Screened]
) -> tuple[Judged | None, float]:
    """The best of the first few candidates, judged, and its score; None if none may enter."""
    bar = max(0.5 * ENTER, _WORTH * ranked[0].score) if ranked else 0.0
    short = [s for s in ranked[:_SHORT] if s.score > bar]
    if not short:
        return None, 0.0
    evidence.base_slopes(MIDDLE)

    def fitted(candidate: Screened) -> Fit:
        more = now.guess.plus(candidate.hypothesis, candidate.start)
        step = evidence.step_of(more, MIDDLE)
        kept = evidence.base_slopes(step, parallel=False)
        before = _loss_of(evidence, now.guess, step)
        return evidence.fit(more, before, parallel=False, step=step, kept=kept, steps=_STEPS)

    fits = sorted(evidence.map(fitted, short), key=lambda fit: -fit.score)
    inside = [fit for fit in fits if fit.score > ENTER and not _strained(fit.guess, -1)]
    close = [f for f in (inside or fits)[:_JUDGED] if f.score > _NEAR * fits[0].score]
    close = [f for f in close if f.score > 0.5 * ENTER]
    return _best_of(evidence, now, close)


def _best_of(evidence: Evidence, now: Judged, fits: Sequence[Fit]) -> tuple[Judged | None, float]:
    """The best of some fits with levels of their own, and its score."""
    judged = [evidence.judged(fit.guess) for fit in fits]
    scores = [now.loss - j.loss - fit.charge for j, fit in zip(judged, fits, strict=True)]
    if not scores or max(scores) < ENTER:
        return None, 0.0
    best = int(np.argmax(scores))
    return judged[best], scores[best]


def _best_pair(
    evidence: Evidence, now: Judged, ranked: Sequence[Screened]
) -> tuple[Judged | None, float]:
    """The best pair of effects where no single one helps, judged, and its score."""
    pool = list(ranked[:_PAIRED])
    step = max(evidence.step_of(now.guess.plus(s.hypothesis, s.start), COARSE) for s in pool)
    ground = evidence.errors(now.guess, step)

    def shift(s: Screened) -> np.ndarray:
        start = s.start if np.any(s.start) else 0.3 * np.ones(s.hypothesis.size)
        return evidence.errors(now.guess.plus(s.hypothesis, start), step) - ground

    shifts = evidence.map(shift, pool)
    gains = {}
    for a in range(len(pool)):
        for b in range(a):
            columns = np.column_stack([shifts[a], shifts[b]])
            move = np.linalg.solve(columns.T @ columns + np.eye(2), -columns.T @ ground)
            left = ground + columns @ move
            gains[a, b] = float(ground @ ground - left @ left - move @ move)
    pairs = sorted(gains, key=gains.__getitem__, reverse=True)[:2]

    def fitted(pair: tuple[int, int]) -> Fit:
        more = now.guess
        for index in pair:
            start = pool[index].start
            more = more.plus(pool[index].hypothesis, start)
        kept = evidence.base_slopes(MIDDLE, parallel=False)
        before = _loss_of(evidence, now.guess, MIDDLE)
        found = evidence.fit(more, before, parallel=False, step=MIDDLE, kept=kept)
        sizes = sum(h.size for h, _ in more.parts[len(now.guess.parts) :])
        return Fit(found.guess, found.loss, found.gain, charge(found.information, sizes),
                   found.information)  # fmt: skip

    fits = [f for f in evidence.map(fitted, pairs) if f.score > ENTER
            and not _strained(f.guess, -1) and not _strained(f.guess, -2)]  # fmt: skip
    return _best_of(evidence, now, fits)


def _calibrated(evidence: Evidence, now: Judged) -> tuple[Judged | None, float]:
    """All uncertain numbers fitted together, judged, and the score of that."""
    taken = {f"{h.name}.{h.location}.{key}" for h, _ in now.guess.parts for key in h.parameters}
    group = calibration(evidence.data.machine, frozenset(taken))
    if not group.parameters:
        return None, 0.0
    judged, gain, cost = now, 0.0, 0.0
    guess = now.guess.plus(group, np.zeros(group.size))
    for _ in range(3):
        step = evidence.step_of(guess, MIDDLE)
        errors = evidence.errors(guess, step)
        slopes = evidence.slopes(guess, errors, step=step)
        fit = evidence.fit(guess, 0.0, step=step, kept=slopes, steps=3)
        before, judged = judged.loss, evidence.judged(fit.guess)
        guess, cost = fit.guess, charge(fit.information, group.size)
        gain = now.loss - judged.loss - cost
        if before - judged.loss < ENTER:
            break
        evidence.set_base(judged)
    evidence.set_base(now)
    return (judged, gain) if gain > ENTER else (None, 0.0)


def _promoted(
    evidence: Evidence, now: Judged, fit: Fit, candidates: Sequence[Hypothesis]
) -> tuple[Judged, Fit]:
    """Numbers that calibration moves beyond what is uncertain become effects of their own.

    What the others move by is what uncertain means: the scale of all deviations, if it is larger
    than the stated one, is taken for each.
    """
    place = next((i for i, (h, _) in enumerate(now.guess.parts) if h.name == CALIBRATION), -1)
    if place < 0:
        return now, fit
    group, deviation = now.guess.parts[place]
    table = numbers(evidence.data.machine)
    keys = list(group.parameters)
    usual = max(1.0, 1.4826 * float(np.median(np.abs(deviation))))
    moved: dict[tuple[str, str], float] = {}
    for key, d in zip(keys, deviation, strict=True):
        effect = table[key].effect
        if effect is None:
            continue
        known = next((c for c in candidates if c.key == effect[:2]), None)
        if known is None or abs(d * table[key].parameter.scale) < known.parameters[effect[2]].least:
            continue
        ratio = usual * table[key].parameter.scale / known.parameters[effect[2]].scale
        gain = (d / usual) ** 2 * (1.0 - min(ratio, 1.0) ** 2) + 2.0 * np.log(min(ratio, 1.0))
        moved[effect[:2]] = moved.get(effect[:2], 0.0) + gain
    effects = [key for key, gain in moved.items() if gain > ENTER]
    if not effects:
        return now, fit
    parts, gone = list(now.guess.parts), set()
    for name, location in effects:
        known = next(c for c in candidates if c.key == (name, location))
        start = []
        for key, p in known.parameters.items():
            full = f"{name}.{location}.{key}"
            if full in keys:
                gone.add(full)
                value = p.nominal + deviation[keys.index(full)] * table[full].parameter.scale
                start.append((value - p.nominal) / p.scale)
            else:
                start.append(0.0)
        parts.append((known, np.clip(start, known.low, known.high)))
    rest = calibration(evidence.data.machine, frozenset(set(table) - set(keys) | gone))
    kept = np.array([d for key, d in zip(keys, deviation, strict=True) if key not in gone])
    parts[place] = (rest, kept)
    return settle(evidence, evidence.judged(Guess(tuple(parts))))


def settle(evidence: Evidence, judged: Judged) -> tuple[Judged, Fit]:
    """Fit with levels and gains computed anew until they no longer matter."""
    fit = None
    for _ in range(_SETTLES):
        evidence.set_base(judged)
        kept = evidence.base_slopes(MIDDLE) if _calibration_of(judged.guess) else None
        fit = evidence.fit(judged.guess, 0.0, kept=kept, step=MIDDLE if kept is not None else None)
        moved = fit.guess.deviation - judged.guess.deviation
        spread = np.sqrt(np.diag(np.linalg.inv(fit.information)))
        if np.all(np.abs(moved) < 0.3 * spread):
            break
        judged = evidence.judged(_widened(fit.guess))
    assert fit
    if fit.guess is not judged.guess:
        judged = evidence.set_base(evidence.judged(fit.guess))
    return judged, fit


def _widened(guess: Guess) -> Guess:
    """A guess in which effects that stand at a bound have three times as much room.

    A bound at zero is physical and stays.
    """
    parts = []
    for hypothesis, deviation in guess.parts:
        table, values = dict(hypothesis.parameters), hypothesis.values(deviation)
        for key, p in hypothesis.parameters.items():
            if hypothesis.name == CALIBRATION:
                continue
            if values[key] >= p.high:
                table[key] = replace(p, high=p.nominal + _ROOM * (p.high - p.nominal))
            elif values[key] <= p.low and p.low != 0.0:
                low = p.low / _ROOM if p.low > 0.0 else p.nominal - _ROOM * (p.nominal - p.low)
                table[key] = replace(p, low=low)
        parts.append((replace(hypothesis, parameters=table), deviation))
    return Guess(tuple(parts))


def worth_naming(guess: Guess, index: int, score: float) -> bool:
    """Whether an effect is as large as its least size in any parameter, or beyond doubt."""
    hypothesis, deviation = guess.parts[index]
    return score >= _BEYOND_DOUBT or bool(np.any(np.abs(deviation) >= hypothesis.least))


def _strained(guess: Guess, index: int) -> bool:
    """Whether a part stands at the edge of what is physically plausible."""
    h, d = guess.parts[index]
    if h.name == CALIBRATION:
        return False
    return bool(np.any(((d <= h.low) | (d >= h.high)) & (np.abs(d) > h.least)))


def _loss_of(evidence: Evidence, guess: Guess, step: float) -> float:
    errors = evidence.errors(guess, step)
    return float(errors @ errors + guess.deviation @ guess.deviation)


def _pruned(
    evidence: Evidence, base: Judged, now: Judged, fit: Fit | None
) -> tuple[Judged, Fit | None, tuple[Judged | None, ...]]:
    """Take out effects that the others have made needless; each effect's rest, judged."""
    while True:
        rests, scores = _rests(evidence, base, now, fit)
        if len(scores) < 2 or min(scores) >= ENTER:
            return now, fit, tuple(rests)
        worst = rests[int(np.argmin(scores))]
        assert worst
        now, fit = settle(evidence, worst)


def _rests(
    evidence: Evidence, base: Judged, now: Judged, fit: Fit | None
) -> tuple[list[Judged | None], list[float]]:
    """For each part the guess without it, fitted and judged (None for calibration); scores."""
    rests: list[Judged | None] = []
    scores: list[float] = []
    slopes = evidence.base_slopes(MIDDLE) if now.guess.parts else np.zeros((0, 0))
    sizes = np.cumsum([0, *(h.size for h, _ in now.guess.parts)])
    for index, (hypothesis, _) in enumerate(now.guess.parts):
        assert fit
        if hypothesis.name == CALIBRATION:
            rests.append(None)
            scores.append(np.inf)
            continue
        smaller = now.guess.without(index)
        kept = np.delete(slopes, np.s_[sizes[index] : sizes[index + 1]], axis=1)
        if smaller.parts:
            smaller = evidence.fit(smaller, 0.0, kept=kept, steps=2, step=MIDDLE).guess
        rest = evidence.judged(smaller, base.tracks) if smaller.parts else base
        cost = charge(_last(fit.information, now.guess, index), hypothesis.size)
        score = rest.loss - now.loss - cost
        if not worth_naming(now.guess, index, score):
            score = min(score, 0.0)
        rests.append(rest)
        scores.append(score)
    return rests, scores


def _last(information: np.ndarray, guess: Guess, index: int) -> np.ndarray:
    """Information with the parameters of one effect moved to the end."""
    sizes = [h.size for h, _ in guess.parts]
    first = sum(sizes[:index])
    own = list(range(first, first + sizes[index]))
    order = [i for i in range(len(information)) if i not in own] + own
    return information[np.ix_(order, order)]


def _rivals(
    evidence: Evidence, now: Judged, index: int, ranking: Sequence[Screened], rest: Judged
) -> tuple[Rival, ...]:
    """What else could stand in the place of an effect, fitted and judged.

    Args:
        evidence: with the guess as base.
        now: all effects.
        index: the one to replace.
        ranking: the screening in which the effect was found.
        rest: the guess without it.

    Returns:
        Rivals, the most likely first.
    """
    taken = {h.key for h, _ in now.guess.parts}
    free = {c.key for c in _free([s.hypothesis for s in ranking], now.guess)}
    pool = [s for s in ranking if s.hypothesis.key not in taken and s.score > 0.0
            and s.hypothesis.key in free][: 2 * _RIVALS]  # fmt: skip
    if not pool:
        return ()
    evidence.set_base(rest)
    evidence.base_slopes(MIDDLE)

    def fitted(candidate: Screened) -> Fit:
        more = rest.guess.plus(candidate.hypothesis, candidate.start)
        step = evidence.step_of(more, MIDDLE)
        kept = evidence.base_slopes(step, parallel=False)
        before = _loss_of(evidence, rest.guess, step)
        return evidence.fit(more, before, parallel=False, step=step, kept=kept, steps=_STEPS)

    fits = sorted(evidence.map(fitted, pool), key=lambda fit: -fit.score)
    plausible = [f for f in fits if f.score > 0.0 and not _strained(f.guess, -1)][:_RIVALS]
    found = []
    for fit in plausible:
        judged = evidence.judged(fit.guess)
        if not np.isfinite(judged.loss):
            continue
        if judged.loss < now.loss + _HOPELESS:  # worth a second look at its own levels
            evidence.set_base(judged)
            step = evidence.step_of(judged.guess, MIDDLE)
            again = evidence.fit(
                judged.guess, 0.0, step=step, kept=evidence.base_slopes(step), steps=3
            )
            better = evidence.judged(again.guess)
            judged = min(judged, better, key=lambda j: j.loss)
            evidence.set_base(rest)
        found.append(Rival(judged.guess.parts[-1][0], judged, fit.charge))
    evidence.set_base(now)
    return tuple(sorted(found, key=lambda r: r.judged.loss + r.charge))
