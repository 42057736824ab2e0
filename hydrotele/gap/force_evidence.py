"""The inverse dynamics of a mechanism, as `gap.gap_model.GapModel`.

The errors are the measured less the modelled drive forces, low-passed. They are linear in all columns (`gap.columns`):

    e = gap - X c = w + v.

w is the residual force of each drive, an Ornstein-Uhlenbeck process, and v is noise. The noise's shape, an
autoregression of each drive and the covariance between drives, is estimated once: it is what a model in which
everything may differ leaves. In errors that this shape makes white,
each channel is an Ornstein-Uhlenbeck process plus white noise, followed by a Kalman filter with one state. Both levels
are re-estimated for every guess. For given levels, sums of squares of the whitened columns hold all that a fit needs.

Drives are decorrelated by the inverse root of the noise's covariance (Kessy, Lewin and Strimmer 2018, The American
Statistician 72(4)), so that channel k remains closest to drive k.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.signal import lfilter

from hydrotele.estimate.evidence import Fit, Judged, fit_guess, invert_information, sandwich_variances
from hydrotele.estimate.filter import MEMORY, Gains, Input
from hydrotele.estimate.hypothesis import CALIBRATION, Guess, Hypothesis
from hydrotele.estimate.residual_force import whiten_forces
from hydrotele.estimate.track import Levels
from hydrotele.gap.dictionary import Version
from hydrotele.gap.force_columns import ForceEffect
from hydrotele.gap.gap_model import GapModel
from hydrotele.gap.laws import LawForm
from hydrotele.gap.mechanism_columns import TYPICAL, Columns, strengths
from hydrotele.gap.regression import OWN_SCALE, NormalEquations, compare_groups, hat_weights
from hydrotele.identify.estimation import compute_weights, estimate_error_variances
from hydrotele.identify.linear_least_squares import fit_autoregression

MAX_SIGN_DOUBT = 0.25  # doubt of the sign of dry friction, beyond which a drive counts as sticking: any force may act
_ORDER_SHARE = 1.0 / 3.0  # of that time, which the autoregression of the noise may span: it must not follow the motion
_NOISE_ROUNDS = 3  # of estimating noise and coefficients in turn
_EFFECTS_PER_DRIVE = 3  # rounds of a search: Coulomb and viscous friction and one more of each drive
_MIN_EFFECTS = 8  # rounds
_NOISE_WIDTH = 0.25  # of the log of a noise level: the residual of all columns tells it within some 25 %
_RESIDUAL_WIDTH = 4.0  # of the log of a residual force's size, in units of the noise, as of hydraulic machines
_LOG_SIZES = (-6.0, 9.0)  # between which that log is looked for
_STEPS = 6  # Gauss-Newton steps
_SETTLED = 1.0  # twice the log likelihood; a smaller change ends the alternation of fits and noise levels
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
        order, parts = len(self.follow), []
        flat = values.reshape(*values.shape[:2], -1) * self.weights(doubt)[:, :, None]
        for first, last in zip(starts[:-1], starts[1:], strict=True):
            own = np.empty((max(last - first - order, 0), *flat.shape[1:]))
            for k in range(flat.shape[1]):
                fresh = np.concatenate([[1.0], -self.follow[:, k]])
                own[:, k] = lfilter(fresh, 1.0, flat[first:last, k], axis=0)[order:]
            parts.append(np.einsum("ij,njm->nim", self.white, own))
        return np.concatenate(parts).reshape(-1, *values.shape[1:])

    def missing_forces(self, rest: np.ndarray, doubt: np.ndarray) -> np.ndarray:
        """Return the RMS (k,) of errors (n, k) beyond the noise [N] or [N m]."""
        weight = self.weights(doubt)
        square = np.sum((weight * rest) ** 2, axis=0) / np.maximum(np.sum(weight**2, axis=0), 1.0)
        return np.sqrt(np.maximum(square - self.std**2, 0.0))


def estimate_noise(columns: Columns) -> NoiseShape:
    """Estimate the shape of the noise of some runs from what all columns together leave.

    The autoregression spans a third of the correlation time of a residual force; what lasts longer is no noise.

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
    variances = estimate_error_variances(rest, columns.doubt)
    plain = NoiseShape(np.zeros((0, drives)), np.eye(drives), variances, np.ones(drives))
    weight = plain.weights(columns.doubt)
    left, starts = rest * weight, columns.starts
    std = np.sqrt(np.sum(left**2, axis=0) / np.maximum(np.sum(weight**2, axis=0), 1.0) / free)
    runs = [left[a:b] for a, b in zip(starts[:-1], starts[1:], strict=True)]
    longest = max(1, int(_ORDER_SHARE * MEMORY / columns.spacing))  # what lasts longer is a residual force
    order = min(len(fit_autoregression(max(runs, key=len))), longest)
    follow = np.mean([fit_autoregression(run, order) for run in runs if len(run) > 4 * order], axis=0)
    plain = plain._replace(follow=follow, std=np.maximum(std, 1e-12))
    new = plain.prewhiten(rest, columns.doubt, starts)
    there = np.concatenate([weight[a + order : b] > 0.0 for a, b in zip(starts[:-1], starts[1:], strict=True)])
    between = new.T @ new / np.maximum(there.T.astype(float) @ there, 1.0) / free
    size, ways = np.linalg.eigh(between)
    return plain._replace(white=(ways / np.sqrt(np.maximum(size, 1e-12 * size.max()))) @ ways.T)


@dataclass(frozen=True)
class ForceRun:
    """Rows of one run: name, and time between rows [s]."""

    name: str
    period: float


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
    levels: Levels
    loss: float
    whitened: np.ndarray
    gains: Gains


class ForceEvidence(GapModel):
    """Force equations of some runs, see `gap.gap_model.GapModel`."""

    def __init__(
        self, columns: Columns, shape: NoiseShape, uncertain: Hypothesis | None = None,
        form: dict[str, float] | None = None,
    ) -> None:  # fmt: skip
        """Prepare the equations.

        Args:
            columns: of the runs.
            shape: of their noise.
            uncertain: parameters of the model with their priors.
            form: column -> standard deviation of what is never known: the form of friction near rest. It is
                marginalised for every guess.
        """
        self.columns, self.shape, order = columns, shape, len(shape.follow)
        self.run_names = ()
        self.keep: Callable[[Judged], None] = lambda judged: None
        self.max_effects = max(_MIN_EFFECTS, _EFFECTS_PER_DRIVE * columns.gap.shape[1])
        self._uncertain = uncertain or Hypothesis(CALIBRATION, "all", {})
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
        self._form = np.array([self._place[name] for name in form or {}], int)
        self._form_precision = np.array([(self._unit[self._place[n]] / s) ** 2 for n, s in (form or {}).items()])
        self._fade = float(np.exp(-columns.spacing / MEMORY))
        self.tracks: tuple[ForceTrack, ...] = ()
        self._levels = Levels(np.ones(columns.gap.shape[1]), self._inputs, np.ones(columns.gap.shape[1]))
        self._roots: dict[bytes, tuple[np.ndarray, float]] = {}
        self._root, _ = self._root_of(self._levels)

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
        """Return errors (m + 1,) whose squares add up to those of all whitened errors, with the form marginalised."""
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

    def _root_of(self, levels: Levels) -> tuple[np.ndarray, float]:
        """Root (m + 1, m + 1) of the sums of squares with the form marginalised, and twice the log of its spreads."""
        key = levels.noise.tobytes() + levels.sizes.tobytes()
        if key not in self._roots:
            whitened, spread = self._filter_errors(self._values, levels)
            flat = whitened.reshape(-1, whitened.shape[2])
            square, own = flat.T @ flat, self._form
            inner = square[np.ix_(own, own)] + np.diag(self._form_precision)
            square = square - square[:, own] @ np.linalg.solve(inner, square[own])
            size, ways = np.linalg.eigh(square)
            wide = 2.0 * float(np.log(spread).sum() + 0.5 * self._log_det(inner))
            if len(self._roots) >= 2 * self.max_effects:
                self._roots.pop(next(iter(self._roots)))
            self._roots[key] = np.sqrt(np.maximum(size, 0.0))[:, None] * ways.T, wide
        return self._roots[key]

    def _log_det(self, inner: np.ndarray) -> float:
        return float(np.linalg.slogdet(inner)[1] - np.log(self._form_precision).sum())

    # -- noise levels --

    def judge(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """Re-estimate the levels of noise and residual forces of a set of effects."""
        along, levels = self._sum_columns(guess), self._levels
        rest, form = self._values @ along, self._values[:, :, self._form]
        for _ in range(2):  # the form of friction and the levels in turn
            filtered, _ = self._filter_errors(np.concatenate([form, rest[:, :, None]], axis=2), levels)
            flat = filtered.reshape(-1, filtered.shape[2])
            square = flat.T @ flat
            inner = square[:-1, :-1] + np.diag(self._form_precision)
            value = np.linalg.solve(inner, square[:-1, -1])
            left = rest - form @ value
            levels = self._most_likely(left, levels)
        whitened, spread = self._filter_errors(left[:, :, None], levels)
        whitened = np.where(self._missing, np.nan, whitened[:, :, 0])
        more = float(value @ (self._form_precision * value)) + self._log_det(inner)
        tracks = []
        for name, a, b in zip(self.columns.runs, self._edges[:-1], self._edges[1:], strict=True):
            rows = np.where(self._missing[a:b], 0.0, whitened[a:b] ** 2 + 2.0 * np.log(spread[a:b]))
            gains = Gains(np.zeros(0), np.zeros(0), spread[a:b])
            run = ForceRun(name, self.columns.spacing)
            tracks.append(ForceTrack(run, levels, float(rows.sum()), whitened[a:b], gains))
        found: Any = tuple(tracks)
        return Judged(guess, found, sum(t.loss for t in tracks) + levels.penalty + more + guess.prior)

    def judge_from(self, guess: Guess, judged: Judged) -> Judged:
        """Re-estimate the levels of a set of effects from those of another model."""
        own, self._levels = self._levels, judged.tracks[0].levels
        try:
            return self.judge(guess)
        finally:
            self._levels = own

    def _most_likely(self, left: np.ndarray, levels: Levels) -> Levels:
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
        return Levels(noise, self._inputs, sizes, penalty=penalty)

    def residual_gain(self, judged: Judged) -> np.ndarray:
        """Return twice the log likelihood ratio (k,) of a residual force in each channel against none."""
        levels = judged.tracks[0].levels
        left, losses = (self._values @ self._sum_columns(judged.guess))[:, :, None], []
        for sizes in (levels.sizes, np.full(len(levels.sizes), np.exp(_LOG_SIZES[0]))):
            whitened, spread = self._filter_errors(left, replace(levels, sizes=sizes))
            losses.append(np.sum(whitened[:, :, 0] ** 2 + 2.0 * np.log(spread), axis=0))
        return losses[1] - losses[0]

    # -- search --

    def prepare(self, candidates: Sequence[Hypothesis], given: Judged) -> list[Hypothesis]:
        """Return the candidates: all are linear enough to start from nominal."""
        return list(candidates)

    def uncertain_parameters(self, guess: Guess, scale: float = 1.0) -> Hypothesis:
        """Return the uncertain parameters of the MJCF, without those of effects with one parameter."""
        if any(h.name == CALIBRATION for h in guess.hypotheses):
            return Hypothesis(CALIBRATION, "all", {})
        taken = {h.columns[0] for h in guess.hypotheses if isinstance(h, ForceEffect) and h.size == 1}
        group = self._uncertain
        table = {n: replace(p, prior_std=scale * p.prior_std) for n, p in group.parameters.items() if n not in taken}
        return calibration_of(table)

    def set_base(self, judged: Judged) -> Judged:
        """Whiten with the levels of a set of effects."""
        self.tracks, self._levels = judged.tracks, judged.tracks[0].levels  # type: ignore[assignment]
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

    def refine(self, now: Judged, guess: Guess, residual_scale: float, dense: bool) -> tuple[Judged, Fit] | None:
        """Fit an extension with scaled residual forces, and re-estimate the levels."""
        levels = now.tracks[0].levels
        self._levels = replace(levels, sizes=residual_scale * levels.sizes)
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

    def propose_noise(self, judged: Judged, min_gain: float) -> Judged | None:
        """Return None: the shape of the noise holds its colour."""
        return None

    def compare_noise(self, judged: Judged, min_gain: float) -> Judged:
        """Return the model: the shape of the noise holds its colour."""
        return judged

    # -- after the search --

    def covariance(self, judged: Judged) -> np.ndarray:
        """Return the covariance (P, P) of the deviations, widened by how unlike stretches of the runs are."""
        self.set_base(judged)
        values = self._values @ self._moves(judged.guess, judged.guess.nudges())
        slopes = self._columns(values)
        covariance = invert_information(slopes.T @ slopes + np.eye(slopes.shape[1]))
        errors = np.concatenate([np.nan_to_num(t.whitened).ravel() for t in judged.tracks])
        plain, tracks = np.diag(covariance), judged.tracks
        wide = np.sqrt(np.maximum(plain, sandwich_variances(tracks, errors, slopes, covariance)) / plain)
        return covariance * np.outer(wide, wide)

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
        form = self._values[:, :, self._form] / np.sqrt(self._form_precision)
        nuisance = self._columns(np.concatenate([own, form], axis=2))
        left = self._columns((self._values @ self._sum_columns(judged.guess))[:, :, None])[:, 0]
        terms = NormalEquations.of(left, groups, nuisance)
        scales = np.repeat([OWN_SCALE, 1.0], [own.shape[2], form.shape[2]])
        marginal = terms.marginalise(scales)
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

    def equations(self, residual_scale: float, joined: Sequence[int] = ()) -> tuple[list[NormalEquations], float]:
        """Return the normal equations from the sums of squares at scaled residual forces."""
        levels = self.evidence._levels
        root, wide = self.evidence._root_of(replace(levels, sizes=residual_scale * levels.sizes))
        groups = [root @ g for g in self.groups]
        if joined:
            groups = [np.hstack([groups[g] for g in joined])]
        errors = root @ self.along
        return [NormalEquations.of(-errors, groups, root @ self.nuisance)], float(errors @ errors) + wide


def calibration_of(parameters: dict) -> ForceEffect:
    """Return the uncertain parameters of a model, column -> prior, as one effect."""
    nominal = np.array([p.nominal for p in parameters.values()])
    return ForceEffect(
        CALIBRATION, "all", parameters, None, tuple(parameters), lambda values: values - nominal,
    )  # fmt: skip


def _level_prior(x: np.ndarray) -> float:
    return float((x[0] / _NOISE_WIDTH) ** 2 + (x[1] / _RESIDUAL_WIDTH) ** 2)
