"""How well effects explain the gap of a mechanism, given noise that is found in the data.

Everything is linear in the columns, so all that is needed are sums of squares of the columns and
the gap, whitened by the noise: its autoregression drive by drive, and its covariance between them.
Numbers of the model that may be off are integrated out; effects are judged by their marginal
likelihood (Laplace's approximation where they are not linear).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.signal import lfilter
from scipy.stats import chi2

from hydrotele.gap.mechanism_columns import Columns
from hydrotele.gap.mechanism_effects import TYPICAL, MechanismEffect, strengths
from hydrotele.identify.estimation import autoregression, find_doubtful, weights
from hydrotele.identify.mechanism import Mechanism
from hydrotele.multibody.regressor import BODY_PARAMETERS

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
    matrix = np.concatenate(
        [columns.matrix[:, :, used] * wide[used], _run_offsets(columns)], axis=2
    )
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
    doubtful = find_doubtful(rest, columns.doubt)
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
    return weights(doubtful, doubt) * (doubt < _STICKS)


def _follow(rest: np.ndarray, starts: Sequence[int]) -> np.ndarray:
    """Autoregression (q, k) of the longest run, long enough for all."""
    longest = int(np.argmax(np.diff(starts)))
    found = [autoregression(rest[a:b]) for a, b in zip(starts[:-1], starts[1:], strict=True)]
    order = len(found[longest])
    fixed = [autoregression(rest[a:b], order) for a, b in zip(starts[:-1], starts[1:], strict=True)
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

    def fit(
        self, effects: Sequence[MechanismEffect], start: Sequence[np.ndarray] | None = None
    ) -> Fitted:
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
        inner = slope.T @ self.square @ slope + np.diag(
            1.0 / np.concatenate([one.scale for one in found.effects]) ** 2
        )
        across = self.square @ slope
        cross = self.cross - self.square @ value
        step = np.linalg.solve(inner, np.column_stack([across.T, slope.T @ cross]))
        return replace(
            self, square=self.square - across @ step[:, :-1], cross=cross - across @ step[:, -1]
        )

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


def effects_by_part(
    columns: Columns, noise: Noise, off: dict[str, float], found: Fitted
) -> list[list[np.ndarray]]:
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
    edges = [
        np.linspace(a, b, max(cuts, round((b - a) * columns.spacing / _LONG)) + 1).astype(int)
        for a, b in runs
    ]
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
            least = [facts.least for facts in found.effects[k].parameters.values()]
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
    off, chain, out = share * mechanism.mapping.uncertainty, mechanism.setup.chain, {}
    for body, ten in zip(chain.bodies, chain.inertia, strict=True):
        mass, spread = float(ten[0]), float(ten[4] + ten[7] + ten[9]) / 2.0
        reach = np.sqrt(max(spread, 0.0) * max(mass, 0.0))
        for kind in BODY_PARAMETERS:
            own = mass if kind == "mass" else reach if kind.startswith("moment") else spread
            out[f"{kind}.{body}"] = off * own
    for one in mechanism.setup.rubbing:
        for kind, value in one.nominal.items():
            out[f"{kind}.{one.place}"] = off * abs(value)
        if one.place in chain.drives:
            dry = abs(one.nominal.get("coulomb", 0.0)) + abs(one.nominal.get("stribeck", 0.0))
            out[f"stribeck0.{one.place}"] = out[f"stribeck2.{one.place}"] = _SLOW * dry
            out[f"sharpness.{one.place}"] = _SHARP * dry
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
