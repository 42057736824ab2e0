"""How well effects explain the gap of a mechanism, given noise that is found in the data.

Everything is linear in the columns, so all that is needed are sums of squares of the columns and
the gap, whitened by the noise: its autoregression drive by drive, and its covariance between them.
Numbers of the model that may be off are integrated out; effects are judged by their marginal
likelihood (Laplace's approximation where they are not linear).

What is left unexplained in a mechanism's forces: on which drive, on what it depends, and when.

A sensor's noise cannot be foretold from the motion. Functions of the joints' positions and rates
are fitted to what is left of the fitted runs; what they foretell of the run that was not fitted is
a law that the model lacks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import lfilter
from scipy.stats import chi2

from hydrotele.gap.mechanism_columns import TYPICAL, Columns, MechanismEffect, strengths
from hydrotele.identify.estimation import compute_weights, estimate_error_variances
from hydrotele.identify.linear_least_squares import fit_autoregression
from hydrotele.identify.mechanism import Mechanism
from hydrotele.multibody.regressor import BODY_PARAMETERS

_POINTS, _FINE, _GRID = 10, 40, 7  # of hat functions along one variable; of a grid of two
_RIDGE = 1e-3
_TOLD = 0.25  # share of the held-out residual's square that must be foretold: the best of many
# functions foretells up to a tenth of noise, and the form of a named law is not known exactly
_LAWS = 3  # functions that are added up at most
_WINDOW = 0.5  # s
_BURST = 4.0  # times the usual size of a window
_SMALL = 0.02  # share of a drive's force RMS below which nothing is lacking
_AGREES = 1.25  # times the fitted runs' noise, on the run that was not fitted
_SURE = 1e-4  # chance of a window of noise alone


@dataclass(frozen=True)
class Law:
    """A function of the state that foretells a part of one drive's residual.

    Attributes:
        drive: its place.
        variables: one or two, such as `position.slide_1`.
        share: of the held-out residual's square that it foretells.
        size: its RMS on the held-out run [N] or [N m].
    """

    drive: int
    variables: tuple[str, ...]
    share: float
    size: float


@dataclass(frozen=True)
class Left:
    """What is left.

    Attributes:
        laws: functions of the state, drive by drive, the most telling first.
        share: (k,) of the held-out residual's square that the laws of a drive foretell together.
        size: (k,) RMS of what is lacking [N] or [N m].
        tests: as of `Gap`.
        lacking: (k,) whether a drive's force lacks something.
    """

    laws: tuple[Law, ...]
    share: np.ndarray
    size: np.ndarray
    tests: Mapping[str, Mapping[str, float | bool]]
    lacking: np.ndarray


def find_left(
    fit: Columns, judge: Columns, rest: np.ndarray, judged: np.ndarray, std: np.ndarray,
    weight: np.ndarray, judge_weight: np.ndarray, spread: np.ndarray,
) -> Left:  # fmt: skip
    """Look for what is left.

    Args:
        fit: equations of the fitted runs; their states and times count.
        judge: of the run that was not fitted.
        rest: (n, k) residuals of the fitted runs [N] or [N m].
        judged: (j, k) of the other one.
        std: (k,) noise of the fitted runs.
        weight: (n, k) of the rows, lower where the sign of friction is in doubt.
        judge_weight: (j, k).
        spread: (k,) RMS of what the fit's own uncertainty does to the run that was not fitted.

    Returns:
        What is left.
    """
    drives = rest.shape[1]
    force = np.sqrt(np.mean(judge.measured**2, axis=0))
    laws, share, size = [], np.zeros(drives), np.zeros(drives)
    for k in range(drives):
        own, told = _laws(
            fit.states, judge.states, weight[:, k] * rest[:, k],
            judge_weight[:, k] * judged[:, k], weight[:, k], judge_weight[:, k], k,
        )  # fmt: skip
        share[k], size[k] = told
        if share[k] > _TOLD and size[k] > _SMALL * force[k]:
            laws += own
    burst, limit, loud = _bursts([(fit, weight * rest), (judge, judge_weight * judged)], std)
    grown = np.sqrt(np.mean((judge_weight * judged) ** 2, axis=0)
                    / np.mean(judge_weight**2, axis=0))  # fmt: skip
    std = np.hypot(std, spread)
    grown = grown / std
    excess = std * np.sqrt(np.maximum(grown**2 - 1.0, 0.0))
    by_state = (share > _TOLD) & (size > _SMALL * force)
    by_time = (burst > limit) & (loud > _SMALL * force)
    by_run = (grown > _AGREES) & (excess > _SMALL * force)
    laws.sort(key=lambda law: -law.size)
    worst = int(np.argmax(burst / limit))
    tests = {
        "state": _test(float(np.where(size > _SMALL * force, share, 0.0).max()), _TOLD,
                       not by_state.any()),
        "windows": _test(float(burst[worst]), float(limit[worst]), not by_time.any()),
        "heldout": _test(float(np.where(excess > _SMALL * force, grown, np.minimum(
            grown, _AGREES)).max()), _AGREES, not by_run.any()),
    }  # fmt: skip
    lacking = by_state | by_time | by_run
    size = np.maximum(np.where(by_state, size, 0.0), np.where(by_run, excess, 0.0))
    size = np.maximum(size, np.where(by_time, loud, 0.0))
    return Left(tuple(laws), share, size, tests, lacking)


def with_variation(left: Left, moved: np.ndarray, std: np.ndarray) -> Left:
    """What is left, with effects that are not the same in all parts of the fitted runs.

    Args:
        left: without them.
        moved: (k,) RMS of what they do to the drives' forces [N] or [N m].
        std: (k,) of the forces' noise; what is smaller says nothing.

    Returns:
        What is left.
    """
    loud = moved > std
    tests = {**left.tests, "constant": _test(float((moved / std).max()), 1.0, not loud.any())}
    return replace(
        left, tests=tests, lacking=left.lacking | loud,
        size=np.maximum(left.size, np.where(loud, moved, 0.0)),
    )  # fmt: skip


def _test(value: float, limit: float, passed: bool) -> dict[str, float | bool]:
    return {"value": value, "limit": limit, "passed": bool(passed)}


def _laws(states, other, rest, judged, weight, judge_weight, drive: int):
    """Functions of the state, one after the other; and share and RMS of all together."""
    whole = float(np.sum(judged**2))
    laws, left, after = [], rest.copy(), judged.copy()
    names = list(states)
    for _ in range(_LAWS):
        best, pick = 0.0, None
        for variables in _choices(names):
            for points in (_POINTS, _FINE) if len(variables) == 1 else (_GRID,):
                made = _fitted(states, other, variables, points, left, weight, judge_weight)
                if made is None:
                    continue
                told, foretold = made
                gained = float(np.sum(after**2) - np.sum((after - foretold) ** 2)) / whole
                if gained > best:
                    best, pick = gained, (variables, told, foretold)
        if pick is None or best < 0.5 * _TOLD:
            break
        variables, told, foretold = pick
        left, after = left - told, after - foretold
        laws.append(Law(drive, variables, best, float(np.sqrt(np.mean(foretold**2)))))
    gone = judged - after
    return laws, (1.0 - float(np.sum(after**2)) / whole, float(np.sqrt(np.mean(gone**2))))


def _choices(names: Sequence[str]):
    for k, one in enumerate(names):
        yield (one,)
        for two in names[k + 1 :]:
            yield one, two


def _fitted(states, other, variables, points, rest, weight, judge_weight):
    """A smooth function of one or two variables: its values on both sets of rows."""
    edges = []
    for name in variables:
        low, high = np.quantile(states[name], [0.005, 0.995])
        if not high > low:
            return None
        edges.append(np.linspace(low, high, points))
    here = _hats(states, variables, edges) * weight[:, None]
    there = _hats(other, variables, edges) * judge_weight[:, None]
    square = here.T @ here
    square[np.diag_indices_from(square)] += _RIDGE * len(rest) / len(square) + 1e-12
    value = np.linalg.solve(square, here.T @ rest)
    return here @ value, there @ value


def _hats(states, variables, edges) -> np.ndarray:
    """Hat functions, or products of two."""
    out = None
    for name, points in zip(variables, edges, strict=True):
        at = np.clip((states[name] - points[0]) / (points[1] - points[0]), 0.0, len(points) - 1.0)
        hats = np.maximum(1.0 - np.abs(at[:, None] - np.arange(len(points))), 0.0)
        out = hats if out is None else (out[:, :, None] * hats[:, None, :]).reshape(len(hats), -1)
    assert out is not None
    return out


def _bursts(parts: Sequence[tuple[Columns, np.ndarray]], std: np.ndarray):
    """Largest window of a drive over its usual window, the limit of noise alone, and its RMS."""
    drives, levels = len(std), []
    for columns, rest in parts:
        length = max(4, round(_WINDOW / columns.spacing))
        for first, last in zip(columns.starts[:-1], columns.starts[1:], strict=True):
            count = (last - first) // length
            blocks = rest[first : first + count * length].reshape(count, length, drives)
            levels.append(np.mean(blocks**2, axis=1))
    level = np.concatenate(levels)
    usual = np.maximum(np.median(level, axis=0), 1e-24)
    free = max(_WINDOW * 2.0 * parts[0][0].band / 3.0, 2.0)  # rows of a band follow each other
    limit = max(_BURST**2, float(chi2.isf(_SURE / level.size, free) / free))
    loud = np.sqrt(np.maximum(level.max(axis=0) - usual, 0.0))
    return np.sqrt(level.max(axis=0) / usual), np.full(drives, np.sqrt(limit)), loud


def loud_windows(
    time: np.ndarray, whitened: np.ndarray, most: int = 5
) -> tuple[tuple[float, float], ...]:  # fmt: skip
    """Windows of half a second in which errors (n,) are largest.

    Args:
        time: (n,) [s].
        whitened: (n,) errors over their noise.
        most: number of windows.

    Returns:
        (start, end) [s], in order of time; those at least twice the usual size.
    """
    spacing = float(np.median(np.diff(time)))
    length = max(1, round(_WINDOW / spacing))
    count = len(time) // length
    if count < 2:
        return ()
    level = np.nanmean(whitened[: count * length].reshape(count, length) ** 2, axis=1)
    usual = np.median(level)
    picked = sorted(int(k) for k in np.argsort(-level)[:most] if level[k] > 4.0 * usual)
    return tuple((round(float(time[k * length]), 2), round(float(time[k * length] + _WINDOW), 2)) for k in picked)


_ROUNDS, _STEPS = 3, 40
_STICKS = 0.25  # doubt of a sign from which a drive counts as sticking
_PARTS, _LONG = 3, 2.0  # parts of the fitted runs that an effect must be alike in, at least, and
# how long they are at most [s]
_VARIES, _CHANCE = 0.6, 1e-3  # share of an effect by which it differs from part to part, where it
# counts as one that is not constant, and the chance of that by noise
_SLOW = 0.1  # share of a drive's Coulomb friction by which its form near rest may differ
_SHARP = 0.5  # of the way from the expected sign of an uncertain rate to the sign of a calm one


@dataclass(frozen=True)
class Noise:
    """Noise of the equations of k drives.

    Attributes:
        follow: (q, k) weights of the rows before.
        white: (k, k) that makes what is new in a row white and of size 1.
        weight: (n, k) of the rows, lower where the sign of dry friction is in doubt.
        std: (k,) of the forces' noise [N] or [N m].
        rest: (n, k) what even all columns together do not explain [N] or [N m].
        doubtful: (k, 2) how the weights follow from the doubt; see `identify.estimation.weights`.
    """

    follow: np.ndarray
    white: np.ndarray
    weight: np.ndarray
    std: np.ndarray
    rest: np.ndarray
    doubtful: np.ndarray


def whitened(values: np.ndarray, noise: Noise, starts: Sequence[int]) -> np.ndarray:
    """Values (n, k, ...) freed of the noise's memory and covariance.

    Args:
        values: one row per equation.
        noise: of the equations.
        starts: first rows of the runs, and the number of rows.

    Returns:
        Fewer rows, (n', k, ...): the first ones of every run have no past.
    """
    order, parts = len(noise.follow), []
    flat = values.reshape(*values.shape[:2], -1) * noise.weight[:, :, None]
    for first, last in zip(starts[:-1], starts[1:], strict=True):
        own = np.empty((max(last - first - order, 0), *flat.shape[1:]))
        for k in range(flat.shape[1]):
            fresh = np.concatenate([[1.0], -noise.follow[:, k]])
            own[:, k] = lfilter(fresh, 1.0, flat[first:last, k], axis=0)[order:]
        parts.append(np.einsum("ij,njm->nim", noise.white, own))
    return np.concatenate(parts).reshape(-1, *values.shape[1:])


def find_noise(columns: Columns) -> Noise:
    """Noise of the equations: what is left by a model in which everything may differ.

    Args:
        columns: of the runs.

    Returns:
        The noise. What repeats with the motion but has no column counts as noise, too; what is
        constant in a run but differs from run to run does not.

    Source: generalised least squares, feasible (Aitken 1935; Cochrane and Orcutt 1949).
    """
    n, k, _ = columns.matrix.shape
    wide = TYPICAL / np.maximum(strengths(columns), 1e-300)
    used = np.isfinite(wide) & (wide < 1e200)
    gap = columns.gap
    matrix = np.concatenate([columns.matrix[:, :, used] * wide[used], _run_offsets(columns)], axis=2)
    std = np.maximum(np.std(gap, axis=0), 1e-12)
    noise = Noise(np.zeros((0, k)), np.diag(1.0 / std), np.ones((n, k)), std, gap, np.zeros((k, 2)))
    for _ in range(_ROUNDS):
        x = whitened(matrix, noise, columns.starts).reshape(-1, matrix.shape[2])
        y = whitened(gap, noise, columns.starts).ravel()
        square = x.T @ x
        factor = cho_factor(square + np.eye(len(square)))
        value = cho_solve(factor, x.T @ y)
        free = max(1.0 - float(np.trace(cho_solve(factor, square))) / len(y), 0.1)
        noise = noise_of(gap - matrix @ value, columns, free)
    return noise


def _run_offsets(columns: Columns) -> np.ndarray:
    """(n, k, k r) constants of every drive in every one of r runs, of a typical size."""
    rows, drives = columns.measured.shape
    size = TYPICAL * np.sqrt(np.mean(columns.measured**2, axis=0))
    runs = len(columns.starts) - 1
    out = np.zeros((rows, drives, runs, drives))
    for run, (a, b) in enumerate(zip(columns.starts[:-1], columns.starts[1:], strict=True)):
        out[a:b, np.arange(drives), run, np.arange(drives)] = size
    return out.reshape(rows, drives, -1)


def noise_of(rest: np.ndarray, columns: Columns, free: float = 1.0) -> Noise:
    """Noise of the equations, from what a model leaves.

    Args:
        rest: (n, k) [N] or [N m].
        columns: of the runs.
        free: share of the equations that the model's numbers have not used up.

    Returns:
        The noise.
    """
    drives = rest.shape[1]
    doubtful = estimate_error_variances(rest, columns.doubt)
    weight = row_weights(doubtful, columns.doubt)
    left = rest * weight
    follow = _follow(left, columns.starts)
    std = np.sqrt(np.mean(left**2, axis=0) / np.mean(weight**2, axis=0) / free)
    plain = Noise(follow, np.eye(drives), weight, std, rest, doubtful)
    new = whitened(rest, plain, columns.starts)
    between = new.T @ new / len(new) / free
    between += 1e-12 * np.trace(between) / drives * np.eye(drives)
    return replace(plain, white=np.linalg.inv(np.linalg.cholesky(between)))


def row_weights(doubtful: np.ndarray, doubt: np.ndarray) -> np.ndarray:
    """Weights of equations: none where a drive sticks, whose dry friction may then be anything.

    Args:
        doubtful: (k, 2) of `Noise`.
        doubt: (n, k) how uncertain the sign of the drives' dry friction is.

    Returns:
        (n, k), 1 at most.
    """
    return compute_weights(doubtful, doubt) * (doubt < _STICKS)


def _follow(rest: np.ndarray, starts: Sequence[int]) -> np.ndarray:
    """Autoregression (q, k) of the longest run, long enough for all."""
    longest = int(np.argmax(np.diff(starts)))
    found = [fit_autoregression(rest[a:b]) for a, b in zip(starts[:-1], starts[1:], strict=True)]
    order = len(found[longest])
    fixed = [fit_autoregression(rest[a:b], order) for a, b in zip(starts[:-1], starts[1:], strict=True)
             if b - a > 4 * order]  # fmt: skip
    return np.mean(fixed, axis=0)


@dataclass(frozen=True)
class Fitted:
    """Effects fitted together.

    Attributes:
        effects: the effects.
        values: their parameters, each (p,).
        covariance: of all parameters, one after the other.
        score: twice the logarithm of the marginal likelihood over that of no effect.
        gain: the fall of the squared errors alone.
    """

    effects: tuple[MechanismEffect, ...]
    values: tuple[np.ndarray, ...]
    covariance: np.ndarray
    score: float
    gain: float


@dataclass(frozen=True)
class Evidence:
    """Sums of squares of m columns and the gap, numbers of the model integrated out.

    Attributes:
        names: of the m columns.
        square: (m, m) of the columns.
        cross: (m,) of the columns and the gap.
        places: name -> its place.
        calibrate: names of the columns that are integrated out.
        towards: (t, m) how the calibrated numbers follow from the columns' coefficients.
        posterior: (t,) calibrated deviations without any effect.
        known: (t, t) covariance of these.
        evidence: twice the log evidence of the calibration over numbers as given.
    """

    names: tuple[str, ...]
    square: np.ndarray
    cross: np.ndarray
    calibrate: tuple[str, ...]
    towards: np.ndarray
    posterior: np.ndarray
    known: np.ndarray
    evidence: float
    places: dict[str, int] = field(default_factory=dict)

    def fit(self, effects: Sequence[MechanismEffect], start: Sequence[np.ndarray] | None = None) -> Fitted:
        """Fit effects together.

        Args:
            effects: any number, also none.
            start: parameters to start from; the priors' means by default.

        Returns:
            The most probable parameters, and what they are worth.
        """
        if not effects:
            return Fitted((), (), np.zeros((0, 0)), 0.0, 0.0)
        if len(effects) == 1 and len(effects[0].columns) == len(effects[0].start) == 1:
            return self._fit_one(effects[0])
        picked = [np.array([self.places[c] for c in one.columns]) for one in effects]
        union = np.unique(np.concatenate(picked))
        square, cross = self.square[np.ix_(union, union)], self.cross[union]
        slots = [np.searchsorted(union, one) for one in picked]
        mean = np.concatenate([one.start for one in effects])
        scale = np.concatenate([one.scale for one in effects])
        low = np.concatenate([one.low for one in effects])
        high = np.concatenate([one.high for one in effects])
        ends = np.cumsum([0, *(len(one.start) for one in effects)])

        def along(p: np.ndarray) -> np.ndarray:
            out = np.zeros(len(union))
            for e, one in enumerate(effects):
                np.add.at(out, slots[e], one.coefficients(p[ends[e] : ends[e + 1]]))
            return out

        def worth(p: np.ndarray) -> float:
            c = along(p)
            return float(2.0 * c @ cross - c @ square @ c - np.sum(((p - mean) / scale) ** 2))

        best, most = mean, -np.inf
        for first in self._starts(effects, start, mean, scale, low, high, ends):
            p, value = _climb(first, worth, along, square, cross, mean, scale, low, high)
            if value > most:
                best, most = p, value
        slope = _slope(along, best, scale)
        held = slope.T @ square @ slope + np.diag(1.0 / scale**2)
        size = scale[:, None] * held * scale
        score = most - float(np.linalg.slogdet(size)[1])
        c = along(best)
        values = tuple(best[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True))
        return Fitted(
            tuple(effects), values, np.linalg.inv(held), score,
            float(2.0 * c @ cross - c @ square @ c),
        )  # fmt: skip

    def _fit_one(self, one: MechanismEffect) -> Fitted:
        """A single effect that is linear in one number."""
        k, step, low, high = self.places[one.columns[0]], one.scale[0], one.low[0], one.high[0]
        slope = float(one.coefficients(one.start + step)[0] - one.coefficients(one.start)[0]) / step
        held = slope**2 * self.square[k, k] + step**-2
        p = float(np.clip(one.start[0] + slope * self.cross[k] / held, low, high))
        c = slope * (p - one.start[0])
        gain = float(2.0 * c * self.cross[k] - c * self.square[k, k] * c)
        score = gain - ((p - one.start[0]) / step) ** 2 - float(np.log(step**2 * held))
        return Fitted((one,), (np.array([p]),), np.array([[1.0 / held]]), score, gain)

    def _starts(self, effects, start, mean, scale, low, high, ends):
        """Where to climb from: what is known, and both sides of an effect that is a product."""
        first = mean.copy() if start is None else np.concatenate(start)
        yield np.clip(first, low, high)
        last = effects[-1]
        if last.name in ("payload", "joint_spring"):
            for sign in (1.0, -1.0):
                other = first.copy()
                other[ends[-2]] += sign * 0.3 * scale[ends[-2]]
                yield np.clip(other, low, high)

    def beside(self, found: Fitted) -> "Evidence":
        """Evidence of what is left beside some effects, whose numbers stay free.

        A fit of one more effect to it tells what that adds to the score of these, exactly so where
        they are linear.

        Args:
            found: the effects, fitted.

        Returns:
            The evidence.
        """
        if not found.effects:
            return self
        value, slope = self._whole(found)
        inner = slope.T @ self.square @ slope + np.diag(1.0 / np.concatenate([one.scale for one in found.effects]) ** 2)
        across = self.square @ slope
        cross = self.cross - self.square @ value
        step = np.linalg.solve(inner, np.column_stack([across.T, slope.T @ cross]))
        return replace(self, square=self.square - across @ step[:, :-1], cross=cross - across @ step[:, -1])

    def _whole(self, found: Fitted) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (m,) of effects, and their slopes (m, p) over the parameters."""
        value, slopes = np.zeros(len(self.names)), []
        for one, numbers in zip(found.effects, found.values, strict=True):
            at = [self.places[name] for name in one.columns]
            np.add.at(value, at, one.coefficients(numbers))
            own = np.zeros((len(self.names), len(numbers)))
            own[at] = _slope(one.coefficients, numbers, one.scale)
            slopes.append(own)
        return value, np.concatenate(slopes, axis=1)

    def coefficients(self, found: Fitted) -> np.ndarray:
        """What some effects add along all columns (m,)."""
        return self._whole(found)[0] if found.effects else np.zeros(len(self.names))

    def predicted_variance(self, found: Fitted, matrix: np.ndarray) -> np.ndarray:
        """Variance that the uncertainty of all that is fitted has in predictions.

        Args:
            found: the effects, fitted.
            matrix: (n, k, m) columns of what is predicted.

        Returns:
            (n, k).
        """
        at = [self.places[name] for name in self.calibrate]
        own = matrix[:, :, at]
        variance = np.einsum("nkt,tu,nku->nk", own, self.known, own)
        if found.effects:
            _, slope = self._whole(found)
            along = (matrix - own @ self.towards) @ slope
            variance += np.einsum("nkp,pq,nkq->nk", along, found.covariance, along)
        return variance

    def calibrated(self, found: Fitted) -> tuple[np.ndarray, np.ndarray]:
        """Deviations (t,) of the model's numbers beside some effects, and their covariance."""
        c = self.coefficients(found)
        return self.posterior - self.towards @ c, self.known


def effects_by_part(columns: Columns, noise: Noise, off: dict[str, float], found: Fitted) -> list[list[np.ndarray]]:
    """Parameters of effects in every part of the runs, where they differ from part to part.

    Args:
        columns: of the runs, which are cut into parts of some seconds.
        noise: of their equations.
        off: see `gather_evidence`.
        found: effects that are fitted to all runs.

    Returns:
        For each effect its parameters in every part; an empty list where they are alike, that is,
        where noise explains the differences, or these are not worth naming.
    """
    runs = list(zip(columns.starts[:-1], columns.starts[1:], strict=True))
    cuts = -(-_PARTS // len(runs))
    edges = [np.linspace(a, b, max(cuts, round((b - a) * columns.spacing / _LONG)) + 1).astype(int) for a, b in runs]
    values: list[list[np.ndarray]] = [[] for _ in found.effects]
    precisions: list[list[np.ndarray]] = [[] for _ in found.effects]
    for first, last in [pair for e in edges for pair in zip(e[:-1], e[1:], strict=True)]:
        if last - first <= 2 * len(noise.follow):
            continue
        here = replace(noise, weight=noise.weight[first:last])
        part = gather_evidence(columns.part(first, last), here, off)
        fitted, begin = part.fit(found.effects, found.values), 0
        for k, value in enumerate(fitted.values):
            block = slice(begin, begin + len(value))
            begin += len(value)
            values[k].append(value)
            least = [facts.min_relevant_change for facts in found.effects[k].parameters.values()]
            own = fitted.covariance[block, block] + np.diag(np.square(least))
            precisions[k].append(np.linalg.inv(own))
    out = []
    for effect, many, known in zip(found.effects, values, precisions, strict=True):
        mean = np.linalg.solve(sum(known), sum(w @ v for w, v in zip(known, many, strict=True)))
        away = np.array(many) - mean
        square = sum(float(d @ w @ d) for d, w in zip(away, known, strict=True))
        size = sum(float((mean - effect.start) @ w @ (mean - effect.start)) for w in known)
        free = len(mean) * (len(many) - 1)
        varies = chi2.sf(square, free) < _CHANCE and square - free > _VARIES**2 * size
        out.append(many if varies else [])
    return out


def _climb(first, worth, along, square, cross, mean, scale, low, high):
    """Gauss-Newton steps with halving; parameters and what they are worth."""
    p, value = first, worth(first)
    for _ in range(_STEPS):
        slope = _slope(along, p, scale)
        uphill = slope.T @ (cross - square @ along(p)) - (p - mean) / scale**2
        held = slope.T @ square @ slope + np.diag(1.0 / scale**2)
        fixed = ((p <= low) & (uphill < 0.0)) | ((p >= high) & (uphill > 0.0))
        step, free = np.zeros(len(p)), ~fixed
        if free.any():
            step[free] = np.linalg.solve(held[np.ix_(free, free)], uphill[free])
        for _ in range(12):
            there = np.clip(p + step, low, high)
            gained = worth(there) - value
            if gained >= 0.0:
                break
            step = 0.5 * step
        else:
            break
        p, value = there, value + gained
        if gained < 1e-6:
            break
    return p, value


def _slope(along, p: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(c, p) by central differences: coefficients are polynomials of the second degree at most."""
    out = []
    for k, step in enumerate(1e-4 * scale):
        away = np.zeros(len(p))
        away[k] = step
        out.append((along(p + away) - along(p - away)) / (2.0 * step))
    return np.stack(out, axis=1)


def possible_errors(mechanism: Mechanism, columns: Columns, share: float = 1.0) -> dict[str, float]:
    """By how much numbers of the model may be off: column -> standard deviation.

    Masses, moments and inertias by the mapping's uncertainty of the body's own, friction by that of
    its own; forces and positions may be half a row apart in time, dry friction near rest is never
    known as well as far from it, nor how sharply it turns.

    Args:
        mechanism: the given model.
        columns: of its runs.
        share: of the stated uncertainty.

    Returns:
        The standard deviations.
    """
    off, chain, out = share * mechanism.mapping.relative_uncertainty, mechanism.setup.chain, {}
    for body, ten in zip(chain.bodies, chain.inertia, strict=True):
        mass, spread = float(ten[0]), float(ten[4] + ten[7] + ten[9]) / 2.0
        reach = np.sqrt(max(spread, 0.0) * max(mass, 0.0))
        for kind in BODY_PARAMETERS:
            own = mass if kind == "mass" else reach if kind.startswith("moment") else spread
            out[f"{kind}.{body}"] = off * own
    for one in mechanism.setup.friction_terms:
        for kind, value in one.nominal.items():
            out[f"{kind}.{one.location}"] = off * abs(value)
        if one.location in chain.drives:
            dry = abs(one.nominal.get("coulomb", 0.0)) + abs(one.nominal.get("stribeck", 0.0))
            out[f"stribeck0.{one.location}"] = out[f"stribeck2.{one.location}"] = _SLOW * dry
            out[f"sharpness.{one.location}"] = _SHARP * dry
    for joint in mechanism.setup.drive_inertia:
        out[f"drive_inertia.{joint}"] = off * abs(float(chain.armature[chain.index(joint)]))
    out["delay.force"] = 0.5 * columns.row
    return out


def gather_evidence(columns: Columns, noise: Noise, off: dict[str, float]) -> Evidence:
    """Evidence of some runs.

    Args:
        columns: of the runs.
        noise: of their equations.
        off: column -> standard deviation by which a number of the model may be off.

    Returns:
        The evidence.
    """
    whole = np.concatenate([columns.matrix, columns.gap[:, :, None]], axis=2)
    x = whitened(whole, noise, columns.starts).reshape(-1, whole.shape[2])
    gram = x.T @ x
    square, cross = gram[:-1, :-1], gram[:-1, -1]
    names = columns.names
    free = tuple(name for name in names if off.get(name, 0.0) > 0.0)
    places = {name: k for k, name in enumerate(names)}
    if not free:
        empty = np.zeros((0, len(names)))
        return Evidence(names, square, cross, (), empty, np.zeros(0), np.zeros((0, 0)), 0.0, places)
    at = np.array([places[name] for name in free])
    std = np.array([off[name] for name in free])
    inner = std[:, None] * square[np.ix_(at, at)] * std + np.eye(len(at))
    factor = cho_factor(inner)
    towards = std[:, None] * cho_solve(factor, std[:, None] * square[at])
    posterior = std * cho_solve(factor, std * cross[at])
    known = std[:, None] * cho_solve(factor, np.diag(std))
    worth = float(cross[at] @ posterior - np.linalg.slogdet(inner)[1])
    return Evidence(
        names, square - square[:, at] @ towards, cross - towards.T @ cross[at], free, towards,
        posterior, known, worth, places,
    )  # fmt: skip
