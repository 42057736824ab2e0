"""Which effects are worth a fit: every candidate by what a few steps along it change.

Effects that act for a while: when they begin is read from the unknown inputs.

Teeth with a gap: found where a motor's axis is shaken in a way that no smooth law explains.

Unknown inputs keep their sign for a while; what hits teeth does not, and counts as white noise on
the rate. With that noise a filter follows any motion, so that a gap in the teeth, whose numbers are
not yet right, makes nothing better. Here it is looked for without: the gap, the drive's own inertia
and the damping of the contact that leave the smallest errors when the sensors' noise is all there
is. The likelihood has many small dents in these numbers (every contact is one), so the search needs
no slopes: gaps of several sizes first, then the simplex of Nelder and Mead 1965 (Comput. J. 7(4)),
which also moves where the drive rests in the gap as the stretch begins.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import OptimizeResult, lsq_linear, minimize

from hydrotele.effects import EFFECTS
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.filter import Input
from hydrotele.estimate.hypothesis import WIDE, Guess, Hypothesis
from hydrotele.estimate.levels import noise_prior, rippled_at, smoothed_inputs
from hydrotele.estimate.track import COARSE, Levels, Track, first_rows, track_run
from hydrotele.logs.dataset import RunData
from hydrotele.machine.machine import Machine

_FEW = 16  # candidates that are tried on all runs
_GLANCE = 20.0  # s of the run that fits worst on which all are tried
_ROOM = 1e-9  # deviations, between bounds that are one
_BENT = 0.5  # sides of nominal that differ by this share of their squares are no straight line


@dataclass(frozen=True)
class Screened:
    """A candidate by its signature alone.

    Attributes:
        hypothesis: the candidate.
        score: twice the log of the evidence it would bring, as far as a few steps along it show.
        gain: fall of the loss by the same token.
        start: (p,) deviation from which to fit it.
    """

    hypothesis: Hypothesis
    score: float
    gain: float
    start: np.ndarray


def screen(evidence: Evidence, guess: Guess, candidates: Sequence[Hypothesis]) -> list[Screened]:
    """Rank candidates by their signatures in the base's errors.

    All are tried on the run that fits worst, the best of them on all runs. A signature is taken
    from both sides of nominal. Where it is a straight line, the candidate is rated by the best
    deviation on it; where not, as with friction that sticks or slips, by the best of what was
    tried, too.

    Args:
        evidence: with the guess as its base.
        guess: what is already there.
        candidates: what may be added.

    Returns:
        The candidates that were tried on all runs and are not there yet, best first.
    """
    taken = {h.key for h, _ in guess.parts}
    open_ones = [h for h in candidates if h.key not in taken]
    worst = max(evidence.tracks, key=lambda t: float(np.nanmean(t.whitened**2)))
    if len(evidence.tracks) > 1 and len(open_ones) > _FEW:
        rows = round(_GLANCE / worst.run.period)
        first = _rank(evidence, guess, open_ones, (first_rows(worst, rows),))
        open_ones = [s.hypothesis for s in first[:_FEW]]
    return _rank(evidence, guess, open_ones, evidence.tracks)


@dataclass(frozen=True)
class _Ground:
    """Where candidates start: errors (E,), slopes (E, P) and deviation (P,) of what is there.

    `pull` (P,) is half the slope of -2 log of its prior, `matrix` the (P, P) information of these
    slopes with the prior's, `low` and `high` (P,) are the bounds of the deviation.
    """

    errors: np.ndarray
    slopes: np.ndarray
    present: np.ndarray
    pull: np.ndarray
    matrix: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _rank(
    evidence: Evidence, guess: Guess, candidates: Sequence[Hypothesis], tracks: Sequence[Track]
) -> list[Screened]:
    def errors_of(moved: Guess, step: float) -> np.ndarray:
        return evidence.errors(moved, step, tracks)

    present = guess.deviation
    slopes = evidence.base_slopes_of(tracks) if len(present) else None
    pull = guess.prior_weight
    matrix = np.zeros((0, 0)) if slopes is None else slopes.T @ slopes + np.diag(pull)
    low = np.concatenate([np.zeros(0), *(h.low for h in guess.hypotheses)])
    high = np.concatenate([np.zeros(0), *(h.high for h in guess.hypotheses)])

    def ground_of(step: float) -> _Ground:
        errors = errors_of(guess, step)
        there = np.zeros((len(errors), 0)) if slopes is None else slopes
        return _Ground(errors, there, present, pull * present, matrix, low, high)

    steps = {h.key: evidence.step_of(guess.plus(h, h.starts[-1]), COARSE) for h in candidates}
    unlike = sorted(set(steps.values()))
    grounds = dict(zip(unlike, evidence.map(ground_of, unlike), strict=True))

    def rate(hypothesis: Hypothesis) -> Screened:
        step = steps[hypothesis.key]
        ground = grounds[step]

        def shift_to(d: np.ndarray) -> np.ndarray:
            return errors_of(guess.plus(hypothesis, d), step) - ground.errors

        rated = []
        for start in hypothesis.starts:
            if np.any(start) and hypothesis.size > 1:
                rated.append(_point(hypothesis, ground, start, shift_to(start)))
            elif np.any(start):
                line = _line(hypothesis, ground, (shift_to(start) / start[0])[:, None], start)
                rated.append(Screened(hypothesis, line.score, line.gain, start))
            else:
                rated.append(_around_nominal(hypothesis, ground, shift_to))
        return max(rated, key=lambda s: s.score)

    return sorted(evidence.map(rate, candidates), key=lambda s: -s.score)


def _around_nominal(hypothesis: Hypothesis, ground: _Ground, shift_to: Callable[[np.ndarray], np.ndarray]) -> Screened:
    """By both sides of nominal, parameter by parameter."""
    slopes, tried, bent = np.zeros((len(ground.errors), hypothesis.size)), [], False
    for k in range(hypothesis.size):
        shifts = []
        for side in hypothesis.sides(k, WIDE):
            d = np.zeros(hypothesis.size)
            d[k] = side
            shift = shift_to(d)
            shifts.append(shift / side)
            tried.append(_point(hypothesis, ground, d, shift))
        slopes[:, k] = np.mean(shifts, axis=0)
        unlike = float(np.sum((shifts[0] - shifts[-1]) ** 2))
        bent |= unlike > _BENT * float(np.sum(shifts[0] ** 2) + np.sum(shifts[-1] ** 2))
    line = _line(hypothesis, ground, slopes, np.zeros(hypothesis.size))
    best = max(tried, key=lambda s: s.gain)
    if not bent or best.gain <= 0.0:
        return line
    return Screened(hypothesis, max(line.score, best.score), max(line.gain, best.gain), best.start)


def _point(hypothesis: Hypothesis, ground: _Ground, d: np.ndarray, shift: np.ndarray) -> Screened:
    """As tried, what is there following."""
    now = _without_present(ground, ground.errors)
    moved = _without_present(ground, ground.errors + shift)
    along = shift / np.linalg.norm(d)
    cost = float(np.log1p(along @ along - _explained(ground, along)))
    gain = now - moved - hypothesis.prior(d)
    return Screened(hypothesis, gain - cost, gain, d)


def _without_present(ground: _Ground, errors: np.ndarray) -> float:
    """Least loss when what is there may follow, within its bounds."""
    pull = ground.slopes.T @ errors + ground.pull
    fall = _least(ground.matrix, pull, ground.low - ground.present, ground.high - ground.present)[1]
    return float(errors @ errors + fall)


def _least(matrix: np.ndarray, pull: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Least `x' A x + 2 b' x` within bounds on x, which hold 0: (x, that)."""
    x = -np.linalg.solve(matrix, pull)
    if np.any((x < low) | (x > high)):
        squares, axes = np.linalg.eigh(matrix)  # signatures may be alike to the last digits
        lengths = np.sqrt(np.maximum(squares, np.finfo(float).eps * squares[-1]))
        low, high = np.minimum(low, -_ROOM), np.maximum(high, _ROOM)
        root = lengths[:, None] * axes.T
        x = lsq_linear(root, -(axes.T @ pull) / lengths, (low, high), method="bvls").x
    return x, float(x @ matrix @ x + 2.0 * pull @ x)


def _explained(ground: _Ground, along: np.ndarray) -> float:
    """Part of a signature's square that what is there could take over."""
    pull = ground.slopes.T @ along
    return float(pull @ np.linalg.solve(ground.matrix, pull))


def _line(hypothesis: Hypothesis, ground: _Ground, slopes: np.ndarray, start: np.ndarray) -> Screened:
    """Best deviation inside the bounds, with straight signatures, what is there following."""
    weight = hypothesis.prior_weight(start)
    own = slopes.T @ slopes + np.diag(weight)
    cross = ground.slopes.T @ slopes
    whole = np.block([[ground.matrix, cross], [cross.T, own]])
    pull = np.concatenate([ground.slopes.T @ ground.errors + ground.pull,
                           slopes.T @ ground.errors])  # fmt: skip
    low = np.concatenate([ground.low - ground.present, hypothesis.low])
    high = np.concatenate([ground.high - ground.present, hypothesis.high])
    x, fall = _least(whole, pull, low, high)
    there = len(ground.present)
    found = x[there:]
    fall += hypothesis.prior(found) - float(weight @ found**2)
    gain = _without_present(ground, ground.errors) - float(ground.errors @ ground.errors) - fall
    cost = float(np.linalg.slogdet(whole)[1])
    if there:
        cost -= float(np.linalg.slogdet(ground.matrix)[1])
    return Screened(hypothesis, gain - cost, gain, found)


def timed(candidates: Sequence[Hypothesis], base: Judged) -> list[Hypothesis]:
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
        place, table = inputs.index(acts), dict(candidate.parameters)
        told = [(t, u[:, place]) for t, u in zip(base.tracks, series, strict=True)]
        spans = _spans(told)
        columns = zip(("size", "start", "duration"), zip(*spans, strict=True), strict=True)
        for key, values in columns:
            nominal = table[key].nominal if key == "size" else values[0]
            table[key] = replace(table[key], nominal=nominal, start_values=values)
        found.append(replace(candidate, parameters=table))
    return found


def _spans(told: Sequence[tuple[Track, np.ndarray]]) -> list[tuple[float, float, float]]:
    """Sizes, starts [s] and durations [s] of a pulse, from an unknown input (n,) of every run.

    The span that stands out most in one run, and the one in which all runs lack most: where other
    unknown inputs do a part, that of a single run may be neither long enough nor of the right size.
    """
    loud = [_loudest(u, track.run.period) for track, u in told]
    best = int(np.argmax([span[0] for span in loud]))
    _, size, first, rows = loud[best]
    run = told[best][0].run
    spans = [(size, run.start + first * run.period, rows * run.period)]
    clocks = [t.run.start + t.run.period * np.arange(len(u)) for t, u in told]
    window = busy_window([(c, np.isfinite(u), u) for c, (_, u) in zip(clocks, told, strict=True)])
    if window:
        begin, end = window
        within = [u[(c >= begin) & (c < end)] for c, (_, u) in zip(clocks, told, strict=True)]
        spans.append((float(np.nanmean(np.concatenate(within))), begin, end - begin))
    return spans


_BLOCK = 0.25  # s, of the search for a window: less than the memory of an unknown input
_CONTRAST = 4.0  # times the mean square beyond a window that there is within


def busy_window(
    lacks: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    share: float = 0.0,
) -> tuple[float, float] | tuple[()]:
    """Times between which a lack is large, and small beyond, in all runs; or none.

    The change points of the largest likelihood, with one variance within and one beyond, told from
    the smoother's answer in blocks of `_BLOCK` seconds.

    Args:
        lacks: of every run the clock (n,) [s], the rows (n,) in which the lack is known, and the
            lack (n,).
        share: of the mean square within that the first and the last block must have; what a filter
            takes for a lack fades after the lack has ended.

    Returns:
        Begin and end [s].
    """
    edges = np.arange(0.0, max(float(c[-1]) for c, _, _ in lacks) + _BLOCK, _BLOCK)
    squares, counts = np.zeros(len(edges)), np.zeros(len(edges))
    for clock, known, lack in lacks:
        squares[1:] += np.histogram(clock[known], edges, weights=lack[known] ** 2)[0]
        counts[1:] += np.histogram(clock[known], edges)[0]
    squares, counts = np.cumsum(squares), np.cumsum(counts)
    if not squares[-1] > 0.0:
        return ()
    best, found, least = 0.0, (0, 0), 1.0 / _BLOCK * counts[-1] / max(1, len(edges) - 1)
    for a in range(len(edges) - 1):
        within = counts[a + 1 :] - counts[a]
        beyond = counts[-1] - within
        inside = squares[a + 1 :] - squares[a]
        with np.errstate(divide="ignore", invalid="ignore"):  # spans without rows are left out
            high, low = inside / within, (squares[-1] - inside) / beyond
            fall = -within * np.log(high) - beyond * np.log(np.maximum(low, 1e-6 * high))
        fits = (np.minimum(within, beyond) >= least) & (high > _CONTRAST * low)
        fall = np.where(fits, counts[-1] * np.log(squares[-1] / counts[-1]) + fall, 0.0)
        k = int(np.argmax(fall))
        if fall[k] > best:
            best, found = float(fall[k]), (a, a + 1 + k)
    if not best > 0.0:
        return ()
    own = slice(*found)
    each = np.diff(squares)[own] / np.maximum(np.diff(counts)[own], 1.0)
    loud = found[0] + np.flatnonzero(each >= share * np.mean(each))
    return float(edges[loud[0]]), float(edges[loud[-1] + 1])


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


_TEETH, _SPRING = "backlash", "joint_flexibility"
_GAPS = (0.002, 0.0035, 0.006, 0.01, 0.018, 0.03)  # rad; further apart, one may be jumped over
_SHAKEN = 3.0  # times its floor, of the white noise on a rate; teeth may be hidden in other lacks
_DAMPING = 0.05  # damping ratio to begin with: hard teeth, hardly oiled
_STRETCH = 3.0  # s where a run is busiest: some reversals of a motor
_STRETCHES = 4  # at most, each of another run, that are taken together at last
_SIMPLEX = (0.15, 0.5, 1.0, 0.4, 0.3)  # of the logarithms of the numbers of teeth; of the rest
_SIMPLEXES = (1.0, 0.3)  # times that, one after the other
_STARTS = 2  # gaps from which to search
_EVALUATIONS = 60  # of a simplex
_CLOSE = 0.01  # ends the search


def rattling(evidence: Evidence, guess: Guess, ahead: Judged, axes: Collection[str]) -> Judged | None:
    """Teeth with a gap for an axis that shakes, with levels of their own.

    Args:
        evidence: on the fit runs.
        guess: what acts beside the teeth.
        ahead: the best other explanation so far: a spring in it is a rival.
        axes: that shake, see `shaken`; looking at one takes minutes.

    Returns:
        The guess with teeth in the axis in which they explain most, which need not be likelier than
        the guess: with wrong numbers, only both together are. None where no axis has teeth that are
        likelier than none as long as nothing unknown acts.
    """
    given, found = evidence.data.machine, []
    for axis in axes:
        whole = Hypothesis(_TEETH, axis, EFFECTS[_TEETH].parameters(given, axis))
        springs = (_SPRING, axis) in {h.key for h in ahead.guess.hypotheses}
        rival = ahead.guess.machine(given) if springs else None
        deviation = _likeliest(evidence, guess.machine(given), whole, rival)
        if deviation is not None and deviation[0] >= whole.least[0]:
            toothed = guess.plus(whole, deviation)
            found.append(evidence.judged_from(toothed, _sensors_only(evidence)))
    return min(found, key=lambda judged: judged.loss, default=None)


def shaken(evidence: Evidence, candidates: Sequence[Hypothesis], guesses: Sequence[Judged]) -> list[str]:
    """Axes that may have teeth with a gap, and that shake by all of some guesses without them."""
    return [
        c.location for c in candidates
        if c.name == _TEETH
        and all(has_unexplained_impacts(evidence, judged, c.location) for judged in guesses)
        and all(c.key not in {h.key for h in judged.guess.hypotheses} for judged in guesses)
    ]  # fmt: skip


def has_unexplained_impacts(evidence: Evidence, judged: Judged, axis: str) -> bool:
    """Whether an axis moves as if hit: with white noise on its rate that a guess does not have."""
    joint = evidence.data.machine.axes[axis].joint
    return rippled_at(judged.tracks[0].levels, f"rate.{joint}", _SHAKEN)


def _sensors_only(evidence: Evidence) -> Levels:
    jitter = evidence.tracks[0].levels.jitter
    return Levels(noise_prior(evidence.data).noise, jitter=jitter)


def _likeliest(evidence: Evidence, toothless: Machine, teeth: Hypothesis, rival: Machine | None) -> np.ndarray | None:
    """Deviations of the likeliest teeth of a machine; None where none are likelier than none.

    Nor are there any where a spring of the same drive, the rival, explains the busiest stretch
    better than the best of them.
    """
    data, levels = evidence.data, _sensors_only(evidence)
    column = list(data.axes).index(teeth.location)
    parts = sorted((_busiest_part(run, column) for run in evidence.runs), key=lambda p: -p[0])
    stretches = [run for _, run in parts[:_STRETCHES]]
    nominal, size = np.array([p.nominal for p in teeth.parameters.values()]), teeth.size
    scale = np.array([p.prior_std for p in teeth.parameters.values()])

    def deviation(x: np.ndarray) -> np.ndarray:
        return np.clip((np.exp(x[:size]) - nominal) / scale, teeth.low, teeth.high)

    def track(x: np.ndarray | None, run: RunData, rest: np.ndarray | None = None) -> Track:
        machine = toothless if x is None else teeth.machine(toothless, deviation(x))
        return track_run(machine, data, run, None, evidence.step, levels, rest=rest)

    starts = [np.log([gap, nominal[1], _DAMPING, nominal[3]]) for gap in _GAPS]
    none, *tracks = evidence.map(lambda x: track(x, stretches[0]), [None, *starts])
    order = sorted(range(len(starts)), key=lambda k: tracks[k].loss)
    if not tracks[order[0]].loss < none.loss:
        return None

    def first(x: np.ndarray) -> float:
        """On one stretch, together with where the drive rests as it begins."""
        return track(x, stretches[0], np.clip(x[size:], -1.0, 1.0)).loss

    def climbed(k: int) -> OptimizeResult:
        return _simplex(first, np.append(starts[k], tracks[k].rest), _SIMPLEXES[0])

    best = min(evidence.map(climbed, order[:_STARTS]), key=lambda answer: answer.fun)
    if rival and best.fun > track_run(rival, data, stretches[0], None, evidence.step, levels).loss:
        return None
    # the simplex shrinks into a dent: once more from there
    best = _simplex(first, best.x, _SIMPLEXES[-1]).x[:size]
    rests = evidence.map(lambda run: track(best, run).rest, stretches)

    def loss(x: np.ndarray) -> float:
        pairs = list(zip(stretches, rests, strict=True))
        return sum(evidence.map(lambda pair: track(x, *pair).loss, pairs))

    return deviation(_simplex(loss, best, _SIMPLEXES[-1]).x)


def _simplex(loss: Callable[[np.ndarray], float], begin: np.ndarray, size: float) -> OptimizeResult:
    simplex = np.vstack([begin, *(begin + size * np.diag(_SIMPLEX[: len(begin)]))])
    return minimize(
        loss, begin, method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": _EVALUATIONS, "xatol": _CLOSE, "fatol": 1.0},
    )  # fmt: skip


def _busiest_part(run: RunData, column: int) -> tuple[float, RunData]:
    """By how much a command changes in the stretch in which it changes most; and the stretch."""
    rows = min(round(_STRETCH / run.period), len(run.command) - 1)
    passed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(run.command[:, column])))])
    changes = passed[rows:] - passed[: len(passed) - rows]
    first = int(np.argmax(changes))
    return float(changes[first]), run.select_rows(first, first + rows)
