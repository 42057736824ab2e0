"""The inverse dynamics of a mechanism, as `gap.gap_model.GapModel`.

The errors are the measured less the modelled drive forces, low-passed. They are linear in all columns (`gap.columns`):

    e = gap - X c = w + v.

w is the residual force of each drive, an Ornstein-Uhlenbeck process, and v is noise. The noise's shape, an
autoregression of each drive and the covariance between drives, is estimated once: it is what a model in which
everything may differ leaves. In errors that this shape makes white,
each channel is an Ornstein-Uhlenbeck process plus white noise, followed by a Kalman filter with one state. Both levels
are re-estimated for every guess. For given levels, sums of squares of the whitened columns hold all that a fit needs.

The uncertain parameters of the MJCF are marginalised for every guess. Their scale is one more level. A guess that
explains the data with one parameter therefore needs a smaller scale than one that spreads it over all of them.

Drives are decorrelated by the inverse root of the noise's covariance (Kessy, Lewin and Strimmer 2018, The American
Statistician 72(4)), so that channel k remains closest to drive k.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_toeplitz
from scipy.optimize import minimize
from scipy.stats import chi2

from hydrotele.effects.effect import Parameter
from hydrotele.estimate.evidence import Fit, Judged, fit_guess, invert_information, sandwich_variances
from hydrotele.estimate.filter import MEMORY, Gains, Input
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.estimate.residual_force import innovations, whiten_forces
from hydrotele.estimate.track import Levels
from hydrotele.gap.dictionary import Version
from hydrotele.gap.force_columns import ForceEffect
from hydrotele.gap.gap_model import GapModel
from hydrotele.gap.laws import LawForm
from hydrotele.gap.mechanism_columns import LEAST, TYPICAL, Columns, strengths
from hydrotele.gap.model_search import PARAMETER_SCALES
from hydrotele.gap.regression import (
    OWN_SCALE,
    RESIDUAL_SCALES,
    LevelScale,
    NormalEquations,
    compare_groups,
    hat_weights,
)
from hydrotele.identify.equations import design_low_pass
from hydrotele.identify.estimation import compute_weights, estimate_error_variances

MAX_SIGN_DOUBT = 0.1  # doubt of the sign of dry friction, beyond which a drive counts as sticking: any force may act
NORMAL95 = 1.96  # half-width of a 95 % interval in standard deviations
_ORDER_SHARE = 1.0 / 3.0  # of that time, which the autoregression of the noise may span: it must not follow the motion
_LEAST_NOISE = 0.01  # fraction of the variance of the errors that is noise at least
_NOISE_ROUNDS = 3  # of estimating noise and coefficients in turn
_VARIANCE_ROUNDS = 10  # of Fisher scoring: a few rows where friction changes sign have errors a hundred times larger
_EFFECTS_PER_DRIVE = 3  # rounds of a search: Coulomb and viscous friction and one more of each drive
_MIN_EFFECTS = 8  # rounds
_NOISE_WIDTH = 0.25  # of the log of a noise level: the residual of all columns tells it within some 25 %
_RESIDUAL_WIDTH = 4.0  # of the log of a residual force's size, in units of the noise, as of hydraulic machines
_LOG_SIZES = (-6.0, 9.0)  # between which that log is looked for
_STEPS = 6  # Gauss-Newton steps
_SETTLED = 1.0  # twice the log likelihood; a smaller change ends the alternation of fits and noise levels
_INSTANTS, _FINE = 300, 9  # of a run at which a pulse may start or end; within a row about the best of them
_CHOICE_OF_INTERVAL = 2.0 * float(np.log(0.5 * _INSTANTS * (_INSTANTS - 1)))  # all are equally probable
_LEAST_PULSE = 20.0  # twice the log likelihood that a residual force must bring where a pulse is looked for
_MAX_PULSE = 20.0  # typical sizes
_LEVEL_ROUNDS = 2  # of estimating the marginalised parameters and the noise levels in turn
_LEAST_INFORMATION = 1e-3  # of a combination of uncertain parameters, in units of its prior's; the data say nothing
_KNOTS = {1: 12, 2: 7}  # hat functions of a law along each of its one or two variables
QUANTILES = (0.005, 0.995)
"""Quantiles of a variable, between which the knots of hat functions lie."""


class NoiseShape(NamedTuple):
    """Shape of the noise of k drives.

    Attributes:
        follow: (q, k) autoregression, weights of the previous rows, the latest first.
        white: (k, k) symmetric; makes the innovations uncorrelated, of size 1.
        sign_variances: (k, 2) as of `identify.estimation.compute_weights`.
        std: (k,) standard deviation of the noise of a row [N] or [N m].
    """

    follow: np.ndarray
    white: np.ndarray
    sign_variances: np.ndarray
    std: np.ndarray

    def weights(self, doubt: np.ndarray) -> np.ndarray:
        """Return the weights (n, k) of rows with a doubt (n, k) of the sign of dry friction; 0 where a drive sticks."""
        return compute_weights(self.sign_variances, doubt) * (doubt < MAX_SIGN_DOUBT)

    def prewhiten(self, values: np.ndarray, doubt: np.ndarray, starts: Sequence[int]) -> np.ndarray:
        """Make forces (n, k, ...) white by the shape alone, run by run; the first q rows of each run are left out."""
        order, parts, weight = len(self.follow), [], self.weights(doubt)
        flat = values.reshape(*values.shape[:2], -1) * weight[:, :, None]
        for first, last in zip(starts[:-1], starts[1:], strict=True):
            own = innovations(flat[first:last], weight[first:last] <= 0.0, self.follow)[order:]
            parts.append(np.einsum("ij,njm->nim", self.white, own))
        return np.concatenate(parts).reshape(-1, *values.shape[1:])

    def missing_forces(self, rest: np.ndarray, doubt: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the RMS (k,) of errors (n, k) beyond noise of a level (k,) [N] or [N m], 0 if not significant.

        The variance of n normal errors has the standard error sqrt(2 / n) times itself.
        """
        weight = self.weights(doubt)
        square = np.sum((weight * rest) ** 2, axis=0) / np.maximum(np.sum(weight**2, axis=0), 1.0)
        own = (noise * self.std) ** 2
        error = own * np.sqrt(2.0 / np.maximum(np.sum(weight > 0.0, axis=0), 1))
        return np.sqrt(np.where(square - own > NORMAL95 * error, square - own, 0.0))


def estimate_noise(columns: Columns) -> NoiseShape:
    """Estimate the shape of the noise of some runs from what all columns together leave.

    The noise has a memory of a third of the correlation time of a residual force; what lasts longer is no noise.

    Args:
        columns: of the runs.

    Returns:
        The shape.

    Source: feasible generalised least squares (Aitken 1935; Cochrane and Orcutt 1949).
    """
    n, k, _ = columns.matrix.shape
    wide = typical_sizes(columns)
    matrix = np.concatenate([columns.matrix[:, :, wide > 0.0] * wide[wide > 0.0], _free_laws(columns)], axis=2)
    gap = columns.gap
    std = np.maximum(np.std(gap, axis=0), 1e-12)
    shape = NoiseShape(np.zeros((0, k)), np.diag(1.0 / std), np.tile([1.0, 0.0], (k, 1)), std)
    for _ in range(_NOISE_ROUNDS):
        x = shape.prewhiten(matrix, columns.doubt, columns.starts).reshape(-1, matrix.shape[2])
        y = shape.prewhiten(gap, columns.doubt, columns.starts).ravel()
        square = x.T @ x
        factor = cho_factor(square + np.eye(len(square)))
        rest = gap - matrix @ cho_solve(factor, x.T @ y)
        used = float(np.trace(cho_solve(factor, square))) / len(y)
        shape = _shape_of(rest, columns, max(1.0 - used, 0.1))
    return shape


def _free_laws(columns: Columns) -> np.ndarray:
    """(n, k, l) forces of a typical size: constants of each run, functions of position and rate of the same drive."""
    size, out = TYPICAL * np.sqrt(np.mean(columns.measured**2, axis=0)), []
    runs = np.repeat(np.eye(len(columns.runs)), np.diff(columns.starts), axis=0)
    for k, drive in enumerate(columns.drives):
        constants = np.zeros((*columns.gap.shape, len(columns.runs)))
        constants[:, k] = size[k] * runs
        out.append(constants)
        for name in (f"position.{drive}", f"velocity.{drive}"):
            if name in columns.states:
                made = np.zeros((*columns.gap.shape, _KNOTS[1]))
                made[:, k] = size[k] * _hats([columns.states[name]])
                out.append(made)
    return np.concatenate(out, axis=2)


def _hats(series: Sequence[np.ndarray]) -> np.ndarray:
    """Hat functions (n, l) of one or two variables (n,), or their products."""
    weights = np.ones((len(series[0]), 1))
    for values in series:
        low, high = np.quantile(values, QUANTILES)
        points = np.linspace(low, high, _KNOTS[len(series)])
        weights = (weights[:, :, None] * hat_weights(values, points)[:, None, :]).reshape(len(values), -1)
    return weights


def typical_sizes(columns: Columns) -> np.ndarray:
    """Return the coefficient (m,) of each column that moves a drive by a typical share of its force; 0 without any."""
    share = strengths(columns)
    return np.divide(TYPICAL, share, out=np.zeros(len(share)), where=share > 1e-12)


def _shape_of(rest: np.ndarray, columns: Columns, free: float) -> NoiseShape:
    """Shape of a residual (n, k), of which a fraction is left by the parameters that were fitted."""
    drives = rest.shape[1]
    variances = estimate_error_variances(rest, columns.doubt, _VARIANCE_ROUNDS)
    plain = NoiseShape(np.zeros((0, drives)), np.eye(drives), variances, np.ones(drives))
    weight, starts = plain.weights(columns.doubt), columns.starts
    order = max(1, int(_ORDER_SHARE * MEMORY / columns.spacing))
    total = _fast_covariance(rest * weight, weight, starts, order, columns.spacing)[0]
    plain = plain._replace(std=np.maximum(np.sqrt(np.diag(total) / free), 1e-12))

    def whiten(follow: np.ndarray) -> tuple[NoiseShape, np.ndarray, np.ndarray, np.ndarray, list[int]]:
        shape = plain._replace(follow=follow)
        new, memory = shape.prewhiten(rest, columns.doubt, starts), len(follow)
        there = np.concatenate([weight[a + memory : b] > 0.0 for a, b in zip(starts[:-1], starts[1:], strict=True)])
        fewer = [max(0, a - memory * run) for run, a in enumerate(starts)]
        return shape, new, _fast_covariance(new, there.astype(float), fewer, order, columns.spacing), there, fewer

    passed = follow_low_pass(columns)
    _, new, covariance, *_ = whiten(np.tile(passed[:, None], drives))
    echo = np.diagonal(covariance, axis1=1, axis2=2)
    own = [_autoregression(c, order) for c in echo.T]
    follow = np.column_stack([-np.convolve(np.append(1.0, -passed), np.append(1.0, -one))[1:] for one in own])
    plain, new, covariance, there, fewer = whiten(follow)
    between = covariance[0] / free
    ratio = np.sqrt(_usual_fraction(new, there, fewer, max(1, round(MEMORY / columns.spacing))))
    size, ways = np.linalg.eigh(between * np.outer(ratio, ratio))
    white = (ways / np.sqrt(np.maximum(size, 1e-12 * size.max()))) @ ways.T
    return plain._replace(white=white, std=ratio * plain.std)


def follow_low_pass(columns: Columns) -> np.ndarray:
    """Return the autoregression (q,) of white noise after the low-pass and decimation of the forces."""
    taps, thin = design_low_pass(columns.band, columns.row)
    echo = np.correlate(taps, taps, "full")[len(taps) - 1 :: thin]
    return _autoregression(echo, max(1, int(MEMORY / columns.spacing)))


def _autoregression(covariance: np.ndarray, order: int) -> np.ndarray:
    """Autoregression (order,) of a process with an autocovariance at lags 0, 1, ..., and none at larger lags.

    The spectrum of an estimated covariance may be negative somewhere; it is at least a fraction of its mean.
    """
    if not covariance[0] > 0.0:
        return np.zeros(order)
    spectrum = np.fft.hfft(covariance, 8 * (order + len(covariance)))
    echo = np.fft.ihfft(np.maximum(spectrum, _LEAST_NOISE * spectrum.mean())).real
    return solve_toeplitz(echo[:order], echo[1 : order + 1])


def _usual_fraction(new: np.ndarray, there: np.ndarray, starts: Sequence[int], length: int) -> np.ndarray:
    """Variance (k,) of most windows of innovations (n, k), as a fraction of the variance of all.

    A force that acts for a short time is no noise. Independent normal innovations have a fraction of 1.
    """
    edges = np.concatenate([np.arange(a, b, length) for a, b in zip(starts[:-1], starts[1:], strict=True)])
    squares, counts = np.add.reduceat(new**2 * there, edges), np.add.reduceat(there.astype(float), edges)
    full = counts > 0.5 * length
    out = np.ones(new.shape[1])
    for k in range(new.shape[1]):
        level = squares[full[:, k], k] / counts[full[:, k], k]
        if level.size and level.mean() > 0.0:
            out[k] = float(np.median(level) / level.mean()) * length / float(chi2.ppf(0.5, length))
    return out


def _fast_covariance(
    rest: np.ndarray, weight: np.ndarray, starts: Sequence[int], order: int, spacing: float
) -> np.ndarray:  # fmt: skip
    """Autocovariance of the noise (order + 1, k, k) in weighted errors (n, k).

    The noise has no memory beyond `order` rows. At larger lags, the covariance is that of residual forces; its
    extrapolation to small lags is subtracted. A parabolic window ends the remainder.
    """
    lags = np.arange(max(round(MEMORY / spacing), order + 2) + 1)
    fade, found = np.exp(-lags * spacing / MEMORY), []
    for lag in lags:
        pairs = [(slice(a, b - lag), slice(a + lag, b)) for a, b in zip(starts[:-1], starts[1:], strict=True)]
        total = sum(rest[one].T @ rest[two] for one, two in pairs if one.stop > one.start)
        count = sum(weight[one].T @ weight[two] for one, two in pairs if one.stop > one.start)
        found.append(0.5 * (total + np.transpose(total)) / np.maximum(0.5 * (count + np.transpose(count)), 1.0))
    covariance, far = np.array(found), lags > order
    slow = np.einsum("l,lij->ij", fade[far], covariance[far]) / np.sum(fade[far] ** 2)
    root = np.linalg.cholesky(covariance[0] + 1e-12 * np.trace(covariance[0]) * np.eye(len(slow)))
    part = np.linalg.solve(root, np.linalg.solve(root, slow).T)  # of the whole covariance
    size, ways = np.linalg.eigh(0.5 * (part + part.T))
    slow = root @ (ways * np.clip(size, 0.0, 1.0 - _LEAST_NOISE)) @ ways.T @ root.T
    near = lags[: order + 1]
    return (covariance[near] - fade[near, None, None] * slow) * (1.0 - (near / (order + 1.0)) ** 2)[:, None, None]


@dataclass(frozen=True)
class ForceRun:
    """Rows of one run: name, and time between rows [s]."""

    name: str
    period: float


@dataclass(frozen=True)
class ForceLevels(Levels):
    """Levels of noise and residual forces, and the scale of the uncertain parameters.

    Attributes:
        parameter_scale: standard deviation of the uncertain parameters relative to the stated one.
    """

    parameter_scale: float = 0.0


def levels_of(judged: Judged) -> ForceLevels:
    """Return the levels of a model of forces; all its runs have the same."""
    return cast(ForceLevels, judged.tracks[0].levels)


@dataclass(frozen=True)
class ForceTrack:
    """Errors of one run: as `estimate.track.Track`, without states.

    Attributes:
        run: the run.
        levels: noise and residual forces, in units of the noise's shape.
        loss: -2 log likelihood without its constant.
        whitened: (n, k) prediction errors over their predicted spread, NaN where missing.
        gains: with that spread (n, k).
    """

    run: ForceRun
    levels: ForceLevels
    loss: float
    whitened: np.ndarray
    gains: Gains


class ForceEvidence(GapModel):
    """Force equations of some runs, see `gap.gap_model.GapModel`."""

    def __init__(
        self, columns: Columns, shape: NoiseShape, form: np.ndarray | None = None, uncertain: np.ndarray | None = None,
        scales: Sequence[float] = PARAMETER_SCALES, has_pulses: bool = True,
    ) -> None:  # fmt: skip
        """Prepare the equations.

        Args:
            columns: of the runs, m of them.
            shape: of their noise.
            form: (m, r) root of the covariance of what is never known, along the columns: how friction acts near rest.
            uncertain: (m, r) root of the covariance of the uncertain parameters, along the columns.
            scales: factors on it, among which every guess has one.
            has_pulses: whether force pulses are tried.
        """
        self.columns, self.shape, order = columns, shape, len(shape.follow)
        self.run_names = ()
        self.keep: Callable[[Judged], None] = lambda judged: None
        alike = [LevelScale(size, size) for size in RESIDUAL_SCALES]
        self.level_scales = (*alike, *(LevelScale(1.0, size) for size in (*RESIDUAL_SCALES[1:], 0.0)))
        self.max_effects = max(_MIN_EFFECTS, _EFFECTS_PER_DRIVE * columns.gap.shape[1])
        wide = typical_sizes(columns)
        self._unit = np.where(wide > 0.0, wide, 1.0)
        whole = np.concatenate([columns.matrix * self._unit, columns.gap[:, :, None]], axis=2)
        self._values = shape.prewhiten(whole, columns.doubt, columns.starts)
        pairs = list(zip(columns.starts[:-1], columns.starts[1:], strict=True))
        self._kept = np.concatenate([np.arange(a + order, b) for a, b in pairs])
        self._missing = shape.weights(columns.doubt)[self._kept] <= 0.0
        self._edges = np.cumsum([0, *(max(b - a - order, 0) for a, b in pairs)])
        self._first = np.zeros(len(self._kept), bool)
        self._first[self._edges[:-1][np.diff(self._edges) > 0]] = True
        self._place = {name: k for k, name in enumerate(columns.names)}
        self._choices, self._has_pulses = scales, has_pulses
        empty = np.zeros((len(self._unit), 0))
        self._prior_variance = np.sum(np.square(empty if uncertain is None else uncertain), axis=1)
        mixes = [self._keep_visible(empty if root is None else root) for root in (form, uncertain)]
        self._mix = np.concatenate(mixes, axis=1)
        self._is_form = np.arange(self._mix.shape[1]) < mixes[0].shape[1]
        self._nuisance = self._values[:, :, :-1] @ self._mix
        self._fade = float(np.exp(-columns.spacing / MEMORY))
        self.tracks: tuple[ForceTrack, ...] = ()
        ones = np.ones(columns.gap.shape[1])
        self._levels: ForceLevels = ForceLevels(ones, self._inputs, ones)
        self._roots: dict[bytes, tuple[np.ndarray, float]] = {}
        self._root, _ = self._root_of(self._levels)

    def _keep_visible(self, root: np.ndarray) -> np.ndarray:
        """(m, r) independent combinations of scaled columns with the same covariance, those that the data show."""
        out = root / self._unit[:, None]
        flat = (self._values[:, :, :-1] @ out).reshape(-1, root.shape[1])
        size, ways = np.linalg.eigh(flat.T @ flat)
        return out @ ways[:, size > _LEAST_INFORMATION]

    @property
    def _inputs(self) -> tuple[Input, ...]:
        return tuple(Input("force", drive) for drive in self.columns.drives)

    # -- errors --

    def coefficients(self, guess: Guess) -> np.ndarray:
        """Return what some effects add along all columns (m,)."""
        out = np.zeros(len(self._place))
        for hypothesis, deviation in guess.parts:
            assert isinstance(hypothesis, ForceEffect)
            values = np.array(list(hypothesis.values(deviation).values()))
            np.add.at(out, [self._place[name] for name in hypothesis.columns], hypothesis.coefficients(values))
        return out

    def errors(self, guess: Guess) -> np.ndarray:
        """Return errors (m + 1,) whose squares add up to those of all whitened errors, all else marginalised."""
        return self._root @ self._sum_columns(guess)

    def _sum_columns(self, guess: Guess) -> np.ndarray:
        return np.append(-self.coefficients(guess) / self._unit, 1.0)

    def _slopes(self, guess: Guess, errors: np.ndarray) -> np.ndarray:
        moves = self._moves(guess, guess.nudges())
        return self._root @ moves if moves.size else np.zeros((len(errors), 0))

    def _moves(self, guess: Guess, nudges: np.ndarray) -> np.ndarray:
        """(m + 1, P) change of the combination of columns per deviation."""
        here, out = self._sum_columns(guess), []
        for k, nudge in enumerate(nudges):
            moved = guess.deviation
            moved[k] += nudge
            out.append((self._sum_columns(guess.at(moved)) - here) / nudge)
        return np.column_stack(out) if out else np.zeros((len(here), 0))

    def _columns(self, values: np.ndarray) -> np.ndarray:
        """(E, m) whitened columns of the base, as its errors."""
        rows, channels, count = values.shape
        return self._filter_errors(values, self._levels)[0].reshape(rows * channels, count)

    def _filter_errors(self, values: np.ndarray, levels: Levels) -> tuple[np.ndarray, np.ndarray]:
        """Whitened values (n, k, m) with their spread (n, k)."""
        return whiten_forces(values, self._missing, self._first, self._fade, levels.noise, levels.sizes)

    def _root_of(self, levels: ForceLevels) -> tuple[np.ndarray, float]:
        """Root (m + 1, m + 1) of the marginalised sums of squares, and twice the log of its spreads."""
        key = b"".join(np.asarray(x).tobytes() for x in (levels.noise, levels.sizes, levels.parameter_scale))
        if key not in self._roots:
            whole = np.concatenate([self._values, self._nuisance], axis=2)
            whitened, spread = self._filter_errors(whole, levels)
            count, flat = self._values.shape[2], whitened.reshape(-1, whole.shape[2])
            square = flat.T @ flat
            cross = self._scales(levels)[:, None] * square[count:, :count]
            inner = self._inner(square[count:, count:], levels)
            size, ways = np.linalg.eigh(square[:count, :count] - cross.T @ np.linalg.solve(inner, cross))
            wide = 2.0 * float(np.log(spread).sum()) + float(np.linalg.slogdet(inner)[1])
            if len(self._roots) >= len(self.level_scales) * self.max_effects:
                self._roots.pop(next(iter(self._roots)))
            self._roots[key] = np.sqrt(np.maximum(size, 0.0))[:, None] * ways.T, wide
        return self._roots[key]

    def _scales(self, levels: ForceLevels) -> np.ndarray:
        """(r,) prior standard deviations of the marginalised parameters."""
        return np.where(self._is_form, 1.0, levels.parameter_scale)

    def _inner(self, square: np.ndarray, levels: ForceLevels) -> np.ndarray:
        """(r, r) posterior precision of the marginalised parameters, per prior standard deviation."""
        scales = self._scales(levels)
        return np.eye(len(scales)) + scales[:, None] * square * scales

    def _marginalise(
        self, rest: np.ndarray, levels: ForceLevels, choices: Sequence[float]
    ) -> tuple[ForceLevels, np.ndarray, float]:
        """Choose the scale of the uncertain parameters; levels, marginalised parameters (r,) and their cost."""
        filtered, _ = self._filter_errors(np.concatenate([self._nuisance, rest[:, :, None]], axis=2), levels)
        flat = filtered.reshape(-1, filtered.shape[2])
        square, found = flat.T @ flat, []
        for choice in choices:
            tried = replace(levels, parameter_scale=choice)
            scales, inner = self._scales(tried), self._inner(square[:-1, :-1], tried)
            pull = scales * square[:-1, -1]
            mean = np.linalg.solve(inner, pull)
            cost = float(mean @ mean) + float(np.linalg.slogdet(inner)[1])
            found.append((float(np.linalg.slogdet(inner)[1] - pull @ mean), tried, scales * mean, cost))
        return min(found, key=lambda one: one[0])[1:]

    # -- noise levels --

    def judge(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """Re-estimate the levels of noise and residual forces of a set of effects."""
        return self._judge(guess, self._choices)

    def _judge(self, guess: Guess, choices: Sequence[float]) -> Judged:
        levels, rest = self._levels, self._values @ self._sum_columns(guess)
        for _ in range(_LEVEL_ROUNDS):
            levels, value, _ = self._marginalise(rest, levels, choices)
            levels = self._most_likely(rest - self._nuisance @ value, levels)
        levels, value, cost = self._marginalise(rest, levels, choices)
        levels = replace(levels, penalty=levels.penalty + cost)
        whitened, spread = self._filter_errors((rest - self._nuisance @ value)[:, :, None], levels)
        whitened = np.where(self._missing, np.nan, whitened[:, :, 0])
        tracks = []
        for name, a, b in zip(self.columns.runs, self._edges[:-1], self._edges[1:], strict=True):
            rows = np.where(self._missing[a:b], 0.0, whitened[a:b] ** 2 + 2.0 * np.log(spread[a:b]))
            gains = Gains(np.zeros(0), np.zeros(0), spread[a:b])
            run = ForceRun(name, self.columns.spacing)
            tracks.append(ForceTrack(run, levels, float(rows.sum()), whitened[a:b], gains))
        found: Any = tuple(tracks)
        return Judged(guess, found, sum(t.loss for t in tracks) + levels.penalty + guess.prior)

    def judge_from(self, guess: Guess, judged: Judged) -> Judged:
        """Re-estimate the levels of a set of effects from those of another model."""
        own, self._levels = self._levels, levels_of(judged)
        try:
            return self.judge(guess)
        finally:
            self._levels = own

    def _most_likely(self, left: np.ndarray, levels: ForceLevels) -> ForceLevels:
        """Levels of the noise and of the residual forces, channel by channel, by maximum posterior density."""
        noise, sizes, penalty = levels.noise.copy(), levels.sizes.copy(), 0.0
        for k in range(left.shape[1]):
            values, missing = left[:, k : k + 1, None], self._missing[:, k : k + 1]

            def loss(x: np.ndarray, values=values, missing=missing) -> float:
                noise, size = np.exp(x)
                out, spread = whiten_forces(
                    values, missing, self._first, self._fade, np.array([noise]), np.array([size])
                )
                return float(np.sum(out**2) + 2.0 * np.sum(np.log(spread))) + _level_prior(x)

            starts = [np.log([noise[k], sizes[k]]), np.array([0.0, _LOG_SIZES[0] / 2.0])]
            best = min(
                (minimize(loss, x, method="L-BFGS-B", bounds=[(-2.0, 2.0), _LOG_SIZES]) for x in starts),
                key=lambda found: found.fun,
            )  # fmt: skip
            noise[k], sizes[k] = np.exp(best.x)
            penalty += _level_prior(best.x)
        return replace(levels, noise=noise, sizes=sizes, penalty=penalty)

    def residual_gain(self, judged: Judged) -> np.ndarray:
        """Return twice the log likelihood ratio (k,) of a residual force in each channel against none."""
        levels = levels_of(judged)
        left, losses = self._left(judged)[:, :, None], []
        for sizes in (levels.sizes, np.full(len(levels.sizes), np.exp(_LOG_SIZES[0]))):
            whitened, spread = self._filter_errors(left, replace(levels, sizes=sizes))
            losses.append(np.sum(whitened[:, :, 0] ** 2 + 2.0 * np.log(spread), axis=0))
        return losses[1] - losses[0]

    # -- search --

    def prepare(self, candidates: Sequence[Hypothesis], given: Judged) -> list[Hypothesis]:
        """Return the candidates: all are linear enough to start from nominal."""
        return list(candidates)

    def uncertain_parameters(self, guess: Guess, scale: float = 1.0) -> Hypothesis:
        """Return no group: the uncertain parameters are marginalised for every guess."""
        return Hypothesis(CALIBRATION, "all", {})

    def set_base(self, judged: Judged) -> Judged:
        """Whiten with the levels of a set of effects."""
        self.tracks = cast("tuple[ForceTrack, ...]", judged.tracks)
        self._levels = levels_of(judged)
        self._root, _ = self._root_of(self._levels)
        return judged

    def fit(self, guess: Guess, steps: int = _STEPS) -> Fit:
        """Fit with the levels of the base."""
        return fit_guess(guess, 0.0, steps, self.errors, self._slopes)

    def settle(self, judged: Judged, wanted: float = np.inf) -> tuple[Judged, Fit]:
        """Alternate fits and estimates of the levels."""
        for _ in range(_STEPS):
            self.set_base(judged)
            fit = self.fit(judged.guess)
            again = self.judge(fit.guess)
            if again.loss > judged.loss - _SETTLED:
                break
            judged = again
        self.set_base(judged)
        fit = self.fit(judged.guess)
        return judged, replace(fit, guess=judged.guess)

    def refine(self, now: Judged, guess: Guess, scale: LevelScale, dense: bool) -> tuple[Judged, Fit] | None:
        """Fit an extension with scaled residual forces, and re-estimate the levels."""
        self._levels = _shrink_levels(levels_of(now), scale)
        self._root, _ = self._root_of(self._levels)
        fit = self.fit(guess)
        judged = self.judge(fit.guess)
        self.set_base(now)
        return judged, fit

    def linearise(self, guess: Guess, versions: Sequence[Version], uncertain: Hypothesis) -> "ForceLinearisation":
        """Return combinations of the columns."""
        here, groups = self._sum_columns(guess), []
        for version in versions:
            parts = [self._sum_columns(guess.plus(version.hypothesis, step)) - here for step in version.steps.T]
            groups.append(np.column_stack(parts) / version.lengths)
        whole = guess.plus(uncertain, np.zeros(uncertain.size)) if uncertain.size else guess
        moves = self._moves(whole, whole.nudges())
        own = np.arange(moves.shape[1]) < len(guess.deviation)
        kept = [k for k, g in enumerate(groups) if np.any(g)]
        return ForceLinearisation(
            self, here, tuple(versions[k] for k in kept), [groups[k] for k in kept], moves, own,
        )  # fmt: skip

    def compare_disturbances(
        self, judged: Judged, candidates: Sequence[Hypothesis]
    ) -> list[tuple[tuple[Hypothesis, np.ndarray], float, LevelScale]]:
        """Return the most likely force pulse on a drive with a residual force, in one run; its column is added.

        A pulse is the difference of two steps, so the Gram matrix of steps at all instants gives the Bayes factor of
        every interval.
        """
        self.set_base(judged)
        lacking = np.flatnonzero(self.residual_gain(judged) > _LEAST_PULSE) if self._has_pulses else ()
        columns, rest = self.columns, self._values @ self._sum_columns(judged.guess)
        losses, found = [], []
        for scale in self.level_scales[: len(RESIDUAL_SCALES)] if len(lacking) else ():
            levels = _shrink_levels(self._levels, scale)
            levels, value, cost = self._marginalise(rest, levels, [levels.parameter_scale])
            left = rest - self._nuisance @ value
            whitened, spread = self._filter_errors(left[:, :, None], levels)
            losses.append(float(np.sum(whitened**2) + 2.0 * np.log(spread).sum()) + cost)
            for run, (a, b) in enumerate(zip(columns.starts[:-1], columns.starts[1:], strict=True)):
                times = columns.time[np.unique(np.linspace(a, b - 1, min(b - a, _INSTANTS)).astype(int))]
                for k in map(int, lacking):
                    factor, *_, start, end = self._best_interval(run, k, times, levels, left)
                    fine = np.linspace(-columns.spacing, columns.spacing, _FINE)
                    near = np.concatenate([start + fine, end + fine])
                    factor, size, start, end = self._best_interval(run, k, near, levels, left)
                    gain = losses[0] - losses[-1] + factor - _CHOICE_OF_INTERVAL
                    found.append((gain, scale, run, k, start, end, size))
        gain, scale, run, k, start, end, size = max(found, default=(0.0, LevelScale(), *(0.0,) * 5))
        if not gain > 0.0 or self._depends_on_motion(judged, int(k), max(f[0] for f in found if f[1].residual == 1.0)):
            return []
        return [((self._pulse(judged.guess, int(run), int(k), start, end), np.array([size])), gain, scale)]

    def _depends_on_motion(self, judged: Judged, drive: int, gain: float) -> bool:
        """Return whether a law over a position or rate explains the errors of a drive better than a pulse.

        Args:
            judged: the base.
            drive: index of the drive.
            gain: twice the log Bayes factor of the pulse.
        """
        force = np.zeros(self.columns.gap.shape)
        force[:, drive] = self._pulse_size(drive)
        factors, _ = self.compare_laws(judged, force, [[values] for values in self.columns.states.values()])
        return float(factors.max()) > gain

    def _best_interval(
        self, run: int, drive: int, times: np.ndarray, levels: ForceLevels, left: np.ndarray
    ) -> tuple[float, float, float, float]:
        """Return the largest of twice the log Bayes factors of pulses between some times, its size, start and end."""
        (a, b), rows = self.columns.starts[run : run + 2], slice(*self._edges[run : run + 2])
        steps = np.zeros((b - a, left.shape[1], len(times)))
        steps[:, drive] = -self._pulse_size(drive) * self._steps(slice(a, b), times)
        series = self.shape.prewhiten(steps, self.columns.doubt[a:b], (0, b - a))
        series = np.concatenate([series, left[rows, :, None]], axis=2)
        flat = whiten_forces(
            series, self._missing[rows], self._first[rows], self._fade, levels.noise, levels.sizes
        )[0].reshape(-1, len(times) + 1)  # fmt: skip
        square, right = flat[:, :-1].T @ flat[:, :-1], flat[:, :-1].T @ flat[:, -1]
        width = np.diag(square)
        precision = 1.0 + np.maximum(width[:, None] + width - 2.0 * square, 0.0)
        pull = right[:, None] - right
        factors = np.where(times[:, None] < times, pull**2 / precision - np.log(precision), -np.inf)
        first, last = np.unravel_index(int(np.argmax(factors)), factors.shape)
        size = float(pull[first, last] / precision[first, last])
        return float(factors[first, last]), size, float(times[first]), float(times[last])

    def _steps(self, rows: slice, times: np.ndarray) -> np.ndarray:
        """(n, s) unit steps at some times, low-passed as the forces are."""
        low, _ = design_low_pass(self.columns.band, self.columns.row)
        edge = self.columns.row * (np.arange(len(low)) - 0.5 * (len(low) - 1))
        return np.interp(self.columns.time[rows, None] - times, edge, np.cumsum(low) / np.sum(low), 0.0, 1.0)

    def _pulse_size(self, drive: int) -> float:
        """Typical size of a force pulse [N] or [N m]."""
        return TYPICAL * float(np.sqrt(np.mean(self.columns.measured[:, drive] ** 2)))

    def _pulse(self, guess: Guess, run: int, drive: int, start: float, end: float) -> ForceEffect:
        """Force pulse on a drive in one run; its column becomes one of those of the runs."""
        columns, size = self.columns, self._pulse_size(drive)
        place = f"{columns.drives[drive]}.{columns.runs[run]}"
        column = f"pulse.{place}.{start!r}.{end!r}"
        if column not in self._place:
            rows, force = slice(*columns.starts[run : run + 2]), np.zeros((*columns.gap.shape, 1))
            force[rows, drive] = np.diff(self._steps(rows, np.array([start, end])), axis=1)  # the drive needs less
            white = self.shape.prewhiten(size * force, columns.doubt, columns.starts)
            self._place[column] = len(columns.names)
            self.columns = replace(
                columns, names=(*columns.names, column), matrix=np.concatenate([columns.matrix, force], axis=2)
            )
            self._unit = np.append(self._unit, size)
            self._values = np.concatenate([self._values[:, :, :-1], white, self._values[:, :, -1:]], axis=2)
            self._mix = np.concatenate([self._mix, np.zeros((1, self._mix.shape[1]))])
            self._prior_variance = np.append(self._prior_variance, 0.0)
            self._roots.clear()
            self._root, _ = self._root_of(self._levels)
        before = sum(h.location.startswith(place) for h in guess.hypotheses)
        bound, least = _MAX_PULSE * size, LEAST / TYPICAL * size
        return ForceEffect(
            "force_pulse", f"{place}.{before + 1}" if before else place,
            {"size": Parameter(columns.units[drive], 0.0, -bound, bound, size, least)}, None, (column,),
            interval=(start, end - start), choice_cost=_CHOICE_OF_INTERVAL,
        )  # fmt: skip

    def try_start_values(self, judged: Judged, candidates: Sequence[Hypothesis]) -> list[Judged]:
        """Return none; the columns of forces need no start values."""
        return []

    def search_backlash(
        self, judged: Judged, effect: Hypothesis, tell: Callable[[str, float], None]
    ) -> Judged | None:  # fmt: skip
        """Return None; mechanisms have no backlash."""
        return None

    def propose_noise(self, judged: Judged, min_gain: float) -> Judged | None:
        """Return None: the shape of the noise holds its colour."""
        return None

    def compare_noise(self, judged: Judged, min_gain: float) -> Judged:
        """Return the model: the shape of the noise holds its colour."""
        return judged

    # -- after the search --

    def _posterior(self, judged: Judged) -> tuple[np.ndarray, np.ndarray]:
        """(m, P + r) change along the columns per deviation, and covariance of the deviations of all parameters.

        The covariance is widened by how unlike stretches of the runs are.
        """
        self.set_base(judged)
        moves = self._moves(judged.guess, judged.guess.nudges())
        mix = self._mix * self._scales(self._levels)
        slopes = self._columns(np.concatenate([self._values @ moves, self._values[:, :, :-1] @ mix], axis=2))
        covariance = invert_information(slopes.T @ slopes + np.eye(slopes.shape[1]))
        errors = np.concatenate([np.nan_to_num(t.whitened).ravel() for t in judged.tracks])
        plain, tracks = np.diag(covariance), judged.tracks
        wide = np.sqrt(np.maximum(plain, sandwich_variances(tracks, errors, slopes, covariance)) / plain)
        along = np.concatenate([-moves[:-1], mix], axis=1) * self._unit[:, None]
        return along, covariance * np.outer(wide, wide)

    def covariance(self, judged: Judged) -> np.ndarray:
        """Return the covariance (P, P) of the deviations of the effects about those of a model.

        It is averaged over the scale of the uncertain parameters: the most likely scale alone would make it too small.
        """
        count, losses, found = len(judged.guess.deviation), [], []
        for scale in self._choices if np.any(~self._is_form) else (levels_of(judged).parameter_scale,):
            self.set_base(judged)
            one = self._judge(judged.guess, (scale,))
            self.set_base(one)
            fit = self.fit(judged.guess)
            losses.append(self._judge(fit.guess, (scale,)).loss + fit.whole_penalty)
            off = fit.guess.deviation - judged.guess.deviation
            found.append(self._posterior(one)[1][:count, :count] + np.outer(off, off))
        self.set_base(judged)
        weights = np.exp(-0.5 * (np.array(losses) - min(losses)))
        return np.einsum("s,sij->ij", weights / weights.sum(), np.array(found))

    def uncertainty(self, judged: Judged) -> np.ndarray:
        """Return a root (m, r) of the covariance along the columns of all that was estimated."""
        along, covariance = self._posterior(judged)
        return along @ np.linalg.cholesky(covariance)

    def calibration(self, judged: Judged) -> tuple[np.ndarray, np.ndarray]:
        """Return the change (m,) of the uncertain parameters along the columns, and its standard deviation (m,)."""
        along, covariance = self._posterior(judged)
        count = len(judged.guess.deviation)
        own = along[:, count:] * ~self._is_form
        hidden = np.maximum(self._levels.parameter_scale**2 * self._prior_variance - np.sum(own**2, axis=1), 0.0)
        spread = np.sqrt(np.einsum("mr,rs,ms->m", own, covariance[count:, count:], own) + hidden)
        return self._unit * (self._mix[:, ~self._is_form] @ self._marginal_mean(judged)[~self._is_form]), spread

    def judge_alike(self, guess: Guess, other: Judged) -> Judged:
        """Re-estimate the noise levels of a set of effects with the scale of the uncertain parameters of another."""
        self.set_base(other)
        return self._judge(guess, (levels_of(other).parameter_scale,))

    def calibration_gain(self, judged: Judged) -> float:
        """Return twice the log evidence that the uncertain parameters bring against those of the given model."""
        self.set_base(judged)
        return self._judge(judged.guess, (0.0,)).loss - judged.loss if levels_of(judged).parameter_scale else 0.0

    def _marginal_mean(self, judged: Judged) -> np.ndarray:
        """(r,) marginalised parameters."""
        levels = levels_of(judged)
        return self._marginalise(self._values @ self._sum_columns(judged.guess), levels, [levels.parameter_scale])[1]

    def _left(self, judged: Judged) -> np.ndarray:
        """(n, k) errors in which the noise's shape is white, after effects and marginalised parameters."""
        return self._values @ self._sum_columns(judged.guess) - self._nuisance @ self._marginal_mean(judged)

    def changes(self, judged: Judged) -> np.ndarray:
        """Return what effects and marginalised parameters add along all columns (m,)."""
        return self._unit * (self._mix @ self._marginal_mean(judged)) + self.coefficients(judged.guess)

    def remaining_force(self, judged: Judged) -> np.ndarray:
        """Return the errors (n, k) after effects and marginalised parameters [N] or [N m]."""
        return self.columns.gap - self.columns.matrix @ self.changes(judged)

    def force_of(self, guess: Guess) -> np.ndarray:
        """Return the drive forces (n, k) that some effects add to the given model [N] or [N m]."""
        return self.columns.matrix @ self.coefficients(guess)

    def compare_laws(
        self, judged: Judged, force: np.ndarray, variables: Sequence[Sequence[np.ndarray]]
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """Compare functions of one or two variables each, times a force, with nothing in addition to a model.

        Args:
            judged: the model.
            force: (n, k) that a value 1 of the function stands for [N] or [N m]; its values have a unit prior.
            variables: one or two series (n,) per function.

        Returns:
            Twice the log Bayes factors, and the values of the functions at their knots.
        """
        self.set_base(judged)
        groups = []
        for series in variables:
            made = force[:, :, None] * _hats(series)[:, None, :]
            groups.append(self._columns(self.shape.prewhiten(made, self.columns.doubt, self.columns.starts)))
        own = self._values @ self._moves(judged.guess, judged.guess.nudges())
        nuisance = self._columns(np.concatenate([own, self._nuisance], axis=2))
        left = self._columns((self._values @ self._sum_columns(judged.guess))[:, :, None])[:, 0]
        terms = NormalEquations.of(left, groups, nuisance)
        marginal = terms.marginalise(np.append(np.full(own.shape[2], OWN_SCALE), self._scales(self._levels)))
        return compare_groups(terms.edges, marginal.right, marginal.blocks)


@dataclass(frozen=True)
class ForceLinearisation:
    """Combinations of the columns of a `ForceEvidence`, see `gap.gap_model.Linearisation`."""

    evidence: ForceEvidence
    along: np.ndarray
    versions: Sequence[Version]
    groups: Sequence[np.ndarray]
    nuisance: np.ndarray
    is_own: np.ndarray
    fraction: float = 1.0
    laws: Sequence[LawForm] = ()
    parameters: Sequence[tuple[str, float]] = ()

    def list_laws(self, judged: Judged, effects: Collection[str], has_laws: bool) -> list[LawForm]:
        """Return no laws: `ForceEvidence.compare_laws` compares them after the effects."""
        return []

    def list_pairs(self, single: LawForm) -> list[LawForm]:
        """Return no laws."""
        return []

    def with_laws(self, laws: Sequence[LawForm]) -> "ForceLinearisation":
        """Return the same."""
        return self

    def equations(self, scale: LevelScale, joined: Sequence[int] = ()) -> tuple[list[NormalEquations], float]:
        """Return the normal equations from the sums of squares at scaled residual forces."""
        root, wide = self.evidence._root_of(_shrink_levels(self.evidence._levels, scale))
        groups = [root @ g for g in self.groups]
        if joined:
            groups = [np.hstack([groups[g] for g in joined])]
        errors = root @ self.along
        return [NormalEquations.of(-errors, groups, root @ self.nuisance)], float(errors @ errors) + wide


def _shrink_levels(levels: ForceLevels, scale: LevelScale) -> ForceLevels:
    """Scale what stands in for missing effects: residual forces and uncertain parameters."""
    sizes, parameters = scale.residual * levels.sizes, scale.parameters * levels.parameter_scale
    return replace(levels, sizes=sizes, parameter_scale=parameters)


def _level_prior(x: np.ndarray) -> float:
    return float((x[0] / _NOISE_WIDTH) ** 2 + (x[1] / _RESIDUAL_WIDTH) ** 2)
