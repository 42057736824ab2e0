"""How well a guess explains the fit runs: prediction errors, slopes, and a step to a better one.

Errors are whitened with gains that are kept while a guess moves, so that they are smooth functions
of its deviations d. The loss is `sum e(d)^2` and what the prior adds; a hypothesis is charged
`log det(1 + S'S)` for the room that its parameters take (Laplace's approximation of the evidence).

How well the numbers of named effects are known: noise, run-to-run scatter, integrator steps.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear
from scipy.special import ndtr, ndtri

from hydrotele.estimate.filter import MEMORY
from hydrotele.estimate.hypothesis import DomainError, Guess, Hypothesis
from hydrotele.estimate.levels import columns_of, find_levels, with_jitter
from hydrotele.estimate.track import (
    COARSE,
    STEP,
    Levels,
    Track,
    fine_enough,
    known_levels,
    track_run,
)
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine

_CLIP = 1.0e3  # a prediction error beyond a thousand spreads says no more than that
_STEPS = 6
MIDDLE = 2.0e-3  # s, step at which guesses are fitted
_MANY = 10  # numbers of a base from which their slopes are taken at a coarser step
BLOCK = 2.0  # s of a run that count as one witness: longer than what a model lacks remembers
_ROUNDS = 2  # of linearisation for the levels of the first base; later ones start from near by
_NEW = 6  # numbers more than the base before had, for whose directions its own ones do
_UNKNOWN = 2500.0  # information of a new one, until it is known: it shows by its fiftieth
_MOVE = 1.0  # of the errors, by which they are moved for the slopes of many numbers
_TRACE = 1.0e-9  # of a typical deviation
_GLANCE = 0.1  # of the steps for slopes: a move of all numbers that tells whether there are any
_RIPPLE, _BENT = 0.01, 0.1  # squares of errors, and share of a change's squares, by which twice
# the move may change more or less than twice as much
_CLOSE = 0.05  # fall of the loss that ends a search: far below any threshold


@dataclass(frozen=True)
class Fit:
    """A guess fitted with kept gains.

    Attributes:
        guess: the guess.
        loss: `sum e^2`, and -2 log of the prior.
        gain: fall of the loss against the guess without its last part.
        occam_penalty: what the last part's parameters cost.
        information: (P, P) `S'S + 1` of all parts.
    """

    guess: Guess
    loss: float
    gain: float
    occam_penalty: float
    information: np.ndarray

    @property
    def score(self) -> float:
        """Twice the log of the evidence gained."""
        return self.gain - self.occam_penalty

    @property
    def whole_penalty(self) -> float:
        """What all parameters cost."""
        return occam_penalty(self.information, len(self.information))


@dataclass(frozen=True)
class Judged:
    """A guess with noise levels of its own.

    Attributes:
        guess: the guess.
        tracks: its tracks of the fit runs, linearised.
        loss: -2 log of their likelihood times the prior of levels and deviations.
    """

    guess: Guess
    tracks: tuple[Track, ...]
    loss: float

    def compact(self) -> "Judged":
        """Return the same without gains and Jacobians, most of its memory; `set_base` computes them again."""
        return dataclasses.replace(self, tracks=tuple(track.compact() for track in self.tracks))

    def blocks(self, seconds: float = BLOCK) -> np.ndarray:
        """(B,) -2 log likelihood of stretches of the runs, without constant."""
        return np.concatenate([_blocks(track, seconds) for track in self.tracks])


def _threads(jobs: int, runs: int) -> int:
    """Workers: one for each run where jobs are all processors, which take turns then.

    Three runs on two workers would take as long as four.
    """
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(max(jobs, runs), 2 * jobs) if 1 < jobs >= (processors or 1) else jobs


class Evidence:
    """Runs of a dataset, tracks of a base guess, and workers to try other guesses."""

    def __init__(
        self, data: Dataset, runs: Sequence[RunData], jobs: int = 2, step: float = STEP,
        lacking: bool = False,
    ):  # fmt: skip
        """Take the runs to judge by and the largest step [s]; `close` ends the workers.

        A search calls `keep` with every guess that it accepts.

        With `lacking`, or where a channel's accuracy is not stated, noise levels are found from
        the data for every base (`estimate.levels`); otherwise they are those that are stated.
        """
        self.step, self.lacking, self.jobs = step, lacking or not known_levels(data), jobs
        self.data, self.runs = dataclasses.replace(data, fit=tuple(runs)), tuple(runs)
        self.keep: Callable[[Judged], None] = lambda judged: None
        self._pool = ThreadPoolExecutor(_threads(jobs, len(self.runs)))
        self.tracks: tuple[Track, ...] = ()
        self._base, self._steps = Guess(), dict[tuple[str, float], np.ndarray]()
        self._slopes, self._smooth = dict[float, np.ndarray](), dict[float, bool]()
        self._information = list[str](), np.zeros((0, 0))
        self._restored: tuple[Judged, Judged] | None = None
        self._responses = dict[int, tuple[Hypothesis, np.ndarray | None]]()

    def close(self) -> None:
        """End the workers; what has not begun is dropped."""
        self._pool.shutdown(cancel_futures=True)

    def track(self, machine: Machine, own: Mapping[str, Machine]) -> tuple[Track, ...]:
        """Tracks with gains of their own and the levels that the machine states.

        Args:
            machine: that the runs share.
            own: run -> machine where it differs.
        """
        return tuple(self._pool.map(
            lambda run: track_run(own.get(run.name, machine), self.data, run, None, self.step), self.runs
        ))  # fmt: skip

    def judged(self, guess: Guess, same: bool = False, reopened: bool = False) -> Judged:
        """A guess with noise levels of its own, found from those of the base.

        With `same`, the base is nearly the same machine: its Jacobians are used again, which is
        enough on the way to a fit, not for comparing it. With `reopened`, unknown inputs that the
        base has no need of are tried again: a guess with fewer parts may need them.

        Outside the model's domain the likelihood is zero: the tracks of the base, an infinite loss.
        """
        try:
            machine, own = guess.machines(self.data.machine)
        except DomainError:
            if not self.tracks:
                raise
            return Judged(guess, self.tracks, np.inf)
        if not self.lacking:
            tracks = self.track(machine, own)
        else:
            rounds = 1 + reopened if self.tracks else _ROUNDS
            tracks = find_levels(
                self.data, machine, self.tracks, self._pool.map, self.step, rounds, same, reopened, own
            )
        loss = sum(track.loss for track in tracks) + tracks[0].levels.penalty
        return Judged(guess, tracks, loss + guess.prior)

    def judged_from(self, guess: Guess, levels: Levels) -> Judged:
        """A guess with noise levels found from given ones instead of from those of the base.

        What the base needs where it does not follow the readings at all may hide what a guess does.
        Unknown inputs that the given levels lack are tried, too.
        """
        try:
            machine, own = guess.machines(self.data.machine)
        except DomainError:
            return Judged(guess, self.tracks, np.inf)

        def cross(near: Track) -> Track:
            there = own.get(near.run.name, machine)
            return track_run(there, self.data, near.run, None, self.step, levels, None, True, near.rest)

        tracks = self.map(cross, self.tracks)
        tracks = find_levels(self.data, machine, tracks, self.map, self.step, _ROUNDS, reopened=True, own=own)
        loss = sum(track.loss for track in tracks) + tracks[0].levels.penalty
        return Judged(guess, tracks, loss + guess.prior)

    def with_jitter(self, judged: Judged) -> Judged:
        """A guess with instants that jitter, if its readings tell so; else as given."""
        if not self.lacking:
            return judged
        machine, own = judged.guess.machines(self.data.machine)
        tracks = with_jitter(self.data, machine, judged.tracks, self.map, self.step, own)
        if tracks is judged.tracks:
            return judged
        loss = sum(track.loss for track in tracks) + tracks[0].levels.penalty
        return Judged(judged.guess, tracks, loss + judged.guess.prior)

    def set_base(self, guess: Guess | Judged) -> Judged:
        """Compute gains anew for a guess; later errors are whitened with them."""
        judged = self._linearised(guess) if isinstance(guess, Judged) else self.judged(guess)
        self.tracks, self._base = judged.tracks, judged.guess
        self._steps, self._slopes, self._smooth, self._responses = {}, {}, {}, {}
        return judged

    def _linearised(self, judged: Judged) -> Judged:
        """Return a model with the gains and Jacobians that `Judged.compact` left out."""
        if not any(track.is_compact for track in judged.tracks):
            return judged
        if self._restored and self._restored[0] is judged:
            return self._restored[1]
        machine, own = judged.guess.machines(self.data.machine)

        def cross(pair: tuple[Track, Track]) -> Track:
            track, near = pair
            there, levels = own.get(track.run.name, machine), track.levels
            columns = columns_of(there, near, levels.inputs) if levels.inputs else None
            return track_run(there, self.data, track.run, None, self.step, levels, columns, True, track.rest)

        tracks = tuple(self.map(cross, list(zip(judged.tracks, self.tracks, strict=True))))
        loss = sum(track.loss for track in tracks) + tracks[0].levels.penalty
        self._restored = judged, Judged(judged.guess, tracks, loss + judged.guess.prior)
        return self._restored[1]

    @property
    def base_errors(self) -> np.ndarray:
        """(E,) whitened errors of the base, all runs."""
        return np.concatenate([flat(track.whitened) for track in self.tracks])

    def errors(
        self, guess: Guess, step: float | None = None, tracks: Sequence[Track] | None = None,
        parallel: bool = False,
    ) -> np.ndarray:  # fmt: skip
        """(E,) whitened errors of a guess with the base's gains, in all or some of its tracks.

        What another step than the evidence's own changes for the base is taken out, lest an effect
        be preferred because it makes up for the integrator. With `parallel` the workers take a run
        each, which must not be asked for from within one. Outside the model's domain, and from where a
        filter breaks down, all errors have the largest size that counts.
        """
        step = step or self.step
        tracks = self.tracks if tracks is None else tracks
        try:
            machine, own = guess.machines(self.data.machine)
        except DomainError:
            return np.full(sum(track.whitened.size for track in tracks), _CLIP)

        def one(track: Track) -> np.ndarray:
            return self._errors(own.get(track.run.name, machine), track, step) + self._made_by(step, track)

        return np.concatenate(self.map(one, tracks) if parallel else [one(t) for t in tracks])

    def step_effect(self, guess: Guess, step: float) -> np.ndarray:
        """(E,) what another step than the evidence's own changes for a guess near the base."""

        def one(track: Track) -> np.ndarray:
            machine = guess.machine(self.data.machine, track.run.name)
            return self._errors(machine, track, step) - self._errors(machine, track, self.step)

        return np.concatenate(self.map(one, self.tracks))

    def _errors(self, machine: Machine, track: Track, step: float) -> np.ndarray:
        return flat(track_run(machine, self.data, track.run, track, step).whitened)

    def _made_by(self, step: float, track: Track) -> np.ndarray | float:
        """What the evidence's own step takes back from the errors of the base in a track."""
        if step == self.step:
            return 0.0
        key = f"{track.run.name} {len(track.whitened)}", step
        if key not in self._steps:
            machine = self._base.machine(self.data.machine, track.run.name)
            self._steps[key] = flat(track.whitened) - self._errors(machine, track, step)
        return self._steps[key]

    def step_of(self, guess: Guess, step: float) -> float:
        """Largest step that a guess takes where others take `step` [s].

        Guesses are compared at equal steps, lest a finer one be taken for a better machine.
        """
        if step > MIDDLE and not self._is_smooth(step):
            step = MIDDLE
        try:
            machine = guess.machine(self.data.machine)
        except DomainError:
            machine = self._base.machine(self.data.machine)
        return fine_enough(machine, step)

    def map(self, function: Callable, items: Sequence) -> list:
        """Apply a function to items on the workers."""
        return list(self._pool.map(function, items))

    def slopes(
        self, guess: Guess, errors: np.ndarray, parallel: bool = True, step: float | None = None,
        first: int = 0,
    ) -> np.ndarray:  # fmt: skip
        """(E, P - first) change of the errors per deviation, from the given one on.

        Differences are taken to the other side where the first one is outside the model's domain; 0 where
        both are.
        """
        nudges, machine, runs = guess.nudges(), self.data.machine, guess.parameter_runs
        linear = self._linear_slopes(guess, parallel)

        def column(index: int) -> np.ndarray:
            if index in linear:
                return linear[index]
            found = np.zeros(len(errors))
            acts = [not runs[index] or track.run.name in runs[index] for track in self.tracks]
            rows = np.repeat(acts, [track.whitened.size for track in self.tracks])
            if not rows.any():
                return found
            for nudge in (nudges[index], -nudges[index]):
                moved = guess.deviation
                moved[index] += nudge
                there = guess.at(moved)
                if np.array_equal(there.deviation, moved) and there.is_in_domain(machine):
                    tracks = [track for track, own in zip(self.tracks, acts, strict=True) if own]
                    found[rows] = (self.errors(there, step, tracks) - errors[rows]) / nudge
                    break
            return found

        columns = range(first, len(guess.deviation))
        found = self.map(column, columns) if parallel else [column(i) for i in columns]
        return np.column_stack(found) if found else np.zeros((len(errors), 0))

    def responses(
        self, hypothesis: Hypothesis, tracks: Sequence[Track], parallel: bool = True
    ) -> np.ndarray | None:  # fmt: skip
        """Return the change (E, p) of the base's errors per deviation of what is linear, see `Hypothesis.responses`."""
        machine = self._base.machine(self.data.machine)
        each = self.map if parallel else map
        parts = list(each(lambda track: hypothesis.responses(machine, self.data, track), tracks))
        return None if any(part is None for part in parts) else np.concatenate([p for p in parts if p is not None])

    def _linear_slopes(self, guess: Guess, parallel: bool) -> dict[int, np.ndarray]:
        """Return index -> slope (E,) of the deviations of a guess that need no simulation."""
        found, first = {}, 0
        for hypothesis in guess.hypotheses:
            if id(hypothesis) not in self._responses:
                self._responses[id(hypothesis)] = hypothesis, self.responses(hypothesis, self.tracks, parallel)
            columns = self._responses[id(hypothesis)][1]
            if columns is not None:
                found |= {first + k: column for k, column in enumerate(columns.T)}
            first += hypothesis.size
        return found

    @property
    def slope_step(self) -> float:
        """Largest step for slopes of the base's numbers [s]: coarser where they are many."""
        many = len(self._base.deviation) > _MANY
        return COARSE if many and self._is_smooth(COARSE) else MIDDLE

    def _is_smooth(self, step: float) -> bool:
        """Whether errors at a step are smooth functions of the base's numbers [s].

        Where a piston slips and sticks, a coarse step may hit either by the last digit of a number,
        and slopes say nothing.
        """
        if not len(self._base.deviation):
            return True
        if step not in self._smooth:
            way = _GLANCE * self._base.nudges()
            guesses = [self._base.at(self._base.deviation + k * way) for k in (0.0, 1.0, 2.0)]
            errors = [self.errors(guess, step, parallel=True) for guess in guesses]
            change, twice = errors[1] - errors[0], errors[2] - errors[0]
            bend = float(np.sum((twice - 2.0 * change) ** 2))
            self._smooth[step] = bend < max(_RIPPLE, _BENT * float(change @ change))
        return self._smooth[step]

    def base_slopes(self, step: float | None = None, parallel: bool = True) -> np.ndarray:
        """(E, P) slopes of the base, kept until there is another base.

        Many numbers together may hardly show, as a scale of all areas, flows and masses, although
        each alone does; the differences of the single slopes are then their errors. So slopes are
        taken a second time along the principal directions of the first ones, or of those of the
        base before, if it had nearly the same numbers.
        """
        step = step or self.step
        if step not in self._slopes:
            errors = self.errors(self._base, step, parallel=parallel)
            names = self._base.names
            linear = self._linear_slopes(self._base, parallel)
            if len(names) - len(linear) <= _MANY:
                self._slopes[step] = self.slopes(self._base, errors, parallel, step)
                return self._slopes[step]
            others = [k for k in range(len(names)) if k not in linear]
            own = [names[k] for k in others]
            information = self._known_information(own)
            if information is None:
                rough = self.slopes(self._base, errors, parallel, step)[:, others]
                information = rough.T @ rough + np.eye(len(others))
            found = np.empty((len(errors), len(names)))
            found[:, others] = self._along(information, errors, parallel, step, others)
            for k, column in linear.items():
                found[:, k] = column
            self._information = own, found[:, others].T @ found[:, others] + np.eye(len(others))
            self._slopes[step] = found
        return self._slopes[step]

    def _known_information(self, names: list[str]) -> np.ndarray | None:
        """(P, P) information of numbers by the base before; None if it had too few of them."""
        known, information = self._information
        there = [known.index(name) for name in names if name in known]
        if len(names) - len(there) > _NEW:
            return None
        own = [k for k, name in enumerate(names) if name in known]
        found = np.diag(np.full(len(names), _UNKNOWN))
        found[np.ix_(own, own)] = information[np.ix_(there, there)]
        return found

    def _along(
        self, information: np.ndarray, errors: np.ndarray, parallel: bool, step: float, own: Sequence[int]
    ) -> np.ndarray:  # fmt: skip
        """(E, P) slopes of some deviations of the base from differences along the directions of their information."""
        base, sizes, ways = self._base, *np.linalg.eigh(information)
        here = base.deviation

        def moved_by(way: np.ndarray) -> np.ndarray:
            there = here.copy()
            there[own] += way
            return there

        moves = (_MOVE / np.sqrt(np.maximum(sizes, 1.0))) * ways  # 1 of the prior; less is rounding
        for way in moves.T:  # to the side where bounds leave more room
            ahead, back = (base.at(moved_by(s * way)).deviation[own] - here[own] for s in (1.0, -1.0))
            way[:] = ahead if ahead @ ahead >= back @ back else back

        def change(way: np.ndarray) -> np.ndarray:
            moved = base.at(moved_by(way))
            return self.errors(moved, step) - errors if moved.is_in_domain(self.data.machine) else np.zeros(len(errors))

        changes = self.map(change, list(moves.T)) if parallel else [change(way) for way in moves.T]
        return (np.linalg.pinv(moves.T) @ np.array(changes)).T

    def fit(
        self, guess: Guess, before: float, parallel: bool = True, steps: int = _STEPS,
        step: float | None = None, kept: np.ndarray | None = None,
    ) -> Fit:  # fmt: skip
        """Gauss-Newton with halved steps, from the guess.

        Args:
            guess: where to start.
            before: loss of the guess without its last part, for the gain.
            parallel: whether this may use the workers (not from within one).
            steps: largest number of Gauss-Newton steps.
            step: largest step of the integrator [s]; the evidence's own if None.
            kept: (E, K) slopes of the first K deviations, which are then not computed anew.

        Returns:
            The fit.
        """
        first = 0 if kept is None else kept.shape[1]

        def slopes_at(there: Guess, errors: np.ndarray) -> np.ndarray:
            fresh = self.slopes(there, errors, parallel, step, first)
            return fresh if kept is None else np.hstack([kept, fresh])

        return fit_guess(guess, before, steps, lambda g: self.errors(g, step, parallel=parallel), slopes_at)


def fit_guess(
    guess: Guess, before: float, steps: int, errors_of: Callable[[Guess], np.ndarray],
    slopes_of: Callable[[Guess, np.ndarray], np.ndarray],
) -> Fit:  # fmt: skip
    """Fit the parameters of a guess by Gauss-Newton with halved steps.

    Args:
        guess: where to start.
        before: loss of the guess without its last part, for the gain.
        steps: largest number of Gauss-Newton steps.
        errors_of: function guess -> (E,) whitened errors.
        slopes_of: function (guess, its errors) -> (E, P) change of the errors per deviation.

    Returns:
        The fit.
    """
    errors = errors_of(guess)
    loss = _loss(errors, guess)
    slopes = slopes_of(guess, errors)
    for _ in range(steps):
        d, move = guess.deviation, _move(guess, slopes, errors)
        better = None
        for shrink in (1.0, 0.5, 0.2, 0.05):
            moved = guess.at(d + shrink * move)
            tried = errors_of(moved)
            if (lower := _loss(tried, moved)) < loss - 1e-9:
                better = (moved, tried, lower)
                break
        if better is None:
            break
        fall = loss - better[2]
        guess, errors, loss = better
        if fall < _CLOSE:
            break
        slopes = slopes_of(guess, errors)
    information = slopes.T @ slopes + np.eye(slopes.shape[1])
    last = guess.parts[-1][0].size if guess.parts else 0
    return Fit(guess, loss, before - loss, occam_penalty(information, last), information)


def _move(guess: Guess, slopes: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """(P,) Gauss-Newton step to the best deviations within bounds, as far as slopes (E, P) tell.

    Where a number would leave its bounds the others move as is best with that one at its end.
    """
    d = guess.deviation
    if not len(d):  # a guess of nothing, or of what is held
        return d
    weight = guess.prior_weight
    root = factor_information(slopes.T @ slopes + np.diag(weight))
    target = -solve_triangular(root, slopes.T @ errors + weight * d, lower=True)
    move = solve_triangular(root.T, target)
    low, high = (np.concatenate([getattr(h, side) for h in guess.hypotheses]) - d for side in ("low", "high"))
    if np.all((move >= low) & (move <= high)):
        return move
    # a trace beyond the ends, so that `at` puts what ends there at its end exactly
    return lsq_linear(root.T, target, (low - _TRACE, high + _TRACE), method="bvls").x


_LEAST_EIGENVALUE = 1.0e-12  # of an information scaled to a unit diagonal: below it is rounding


def factor_information(information: np.ndarray) -> np.ndarray:
    """Return the lower Cholesky factor (P, P) of a symmetric information (P, P), scaled so that it exists.

    Its rows and columns are scaled to a unit diagonal, and rounding is kept from making it indefinite.
    """
    scale = np.sqrt(np.diag(information))
    scaled = information / np.outer(scale, scale)
    scaled = 0.5 * (scaled + scaled.T) + _LEAST_EIGENVALUE * np.eye(len(scale))
    return scale[:, None] * np.linalg.cholesky(scaled)


def invert_information(information: np.ndarray) -> np.ndarray:
    """Return the covariance (P, P) of an information (P, P) that includes a unit prior of each deviation.

    Its eigenvalues are at least 1, that of the prior; less is rounding. So no variance is negative, and none
    exceeds that of the prior.

    >>> import numpy as np
    >>> bool(np.all(np.diag(invert_information(np.full((3, 3), 1e30) + np.eye(3))) > 0.0))
    True
    """
    sizes, directions = np.linalg.eigh(0.5 * (information + information.T))
    return (directions / np.maximum(sizes, 1.0)) @ directions.T


def occam_penalty(information: np.ndarray, last: int) -> float:
    """Occam's charge of the last parameters, given the others: `log det` of their information."""
    if last == 0:
        return 0.0
    whole = np.linalg.slogdet(information)[1]
    rest = np.linalg.slogdet(information[:-last, :-last])[1] if last < len(information) else 0.0
    return float(whole - rest)


def flat(whitened: np.ndarray) -> np.ndarray:
    """Whitened errors (n, c) as one row (n c,), 0 where missing."""
    return np.clip(np.nan_to_num(whitened.ravel(), nan=0.0), -_CLIP, _CLIP)


def _loss(errors: np.ndarray, guess: Guess) -> float:
    return float(errors @ errors) + guess.prior


def _blocks(track: Track, seconds: float) -> np.ndarray:
    """-2 log likelihood of stretches of a run; the last, shorter one joins the one before."""
    there = np.isfinite(track.whitened)
    width = np.where(there, track.gains.spread, 1.0)
    lost = np.where(np.isinf(track.whitened), np.inf, 0.0)  # the filter broke down
    rows = np.where(there, track.whitened**2 + 2.0 * np.log(width), lost).sum(axis=1)
    count = max(1, int(len(rows) * track.run.period / seconds))
    edges = np.linspace(0, len(rows), count + 1).astype(int)
    return np.add.reduceat(rows, edges[:-1])


_FEW = 10  # numbers up to which slopes are taken at the finest step
_CHANCE = 3.0  # chi-square per degree of freedom that two degrees exceed in 5 % of all cases
_STRETCHES = 40  # of the runs, if they are not shorter than what unknown inputs remember
_DENTED = ("backlash",)  # effects whose likelihood is full of dents, see `gap.backlash`
_NEAR = (0.5, 1.0, 2.0)  # standard deviations, within which the depth of dents is looked for
_MOST = 0.8  # of the dents seen are no deeper; where a filter loses its machine one is far deeper
_FARTHEST = 256.0  # standard deviations to which dents are followed


def posterior_covariance(evidence: Evidence, guess: Guess, scatter: float = 1.0) -> np.ndarray:
    """Return the covariance of a fitted guess's parameters (Laplace), widened by what its curvature leaves out.

    Where errors hang together over time, as those of a law of another form do, stretches of the
    runs pull at the numbers more unlike than independent noise would, and the spread follows their
    pulls (White 1982, Econometrica 50(1), section 3: the sandwich covariance). Where runs by
    themselves ask for sizes that scatter beyond chance, it is widened to that scatter (Birge 1932,
    Phys. Rev. 40, 207). What halving the integrator's step would change is added as the half-width
    of a uniform error, for neither step is the truth (Guide to the expression of uncertainty in
    measurement, 4.3.7). A likelihood with dents widens them to the dents' reach.

    Noise and scatter keep the correlations of the inverse information. The change by the step moves all
    parameters together.

    Args:
        evidence: with the guess as its base.
        guess: fitted.
        scatter: chi-square per degree of freedom of the sizes that the runs ask for.

    Returns:
        (P, P) covariance of the normalised deviations.
    """
    step = evidence.step_of(guess, evidence.step)
    few = len(guess.deviation) <= _FEW
    if few:
        slopes = evidence.slopes(guess, evidence.errors(guess, step), step=step)
    else:
        slopes = evidence.base_slopes(evidence.slope_step)
    information = slopes.T @ slopes + np.eye(slopes.shape[1])
    covariance = invert_information(information)
    plain = np.diag(covariance)
    scores = sandwich_variances(evidence.tracks, evidence.base_errors, slopes, covariance)
    widening = np.sqrt(np.maximum(plain, scores) / plain)
    shift = covariance @ (slopes.T @ evidence.step_effect(guess, 0.5 * step))
    widened = scatter if scatter > _CHANCE else 1.0
    whole = widened * covariance * np.outer(widening, widening) + np.outer(shift, shift) / 3.0
    factors = _beyond_dents(evidence, guess, 1.0 / np.sqrt(np.diag(information)))
    return whole * np.outer(factors, factors)


def standard_deviations(evidence: Evidence, guess: Guess, scatter: float = 1.0) -> np.ndarray:
    """Return the standard deviations (P,) of a fitted guess's parameters, in normalised deviations.

    They are the square roots of the diagonal of `posterior_covariance`, which has the same arguments.
    """
    return np.sqrt(np.diag(posterior_covariance(evidence, guess, scatter)))


_SEED = 0
_BATCH, _MAX_BATCHES = 1000, 100  # normal samples that are drawn at once, and how often
_SWEEPS = 20  # of the Gibbs sampler between two samples
_MAX_CHECKS = 10  # points of the Gibbs sampler per sample that are tested for the domain


def draw_truncated_normal(
    mean: np.ndarray, covariance: np.ndarray, bounds: tuple[np.ndarray, np.ndarray],
    is_valid: Callable[[np.ndarray], bool], count: int,
) -> np.ndarray:  # fmt: skip
    """Draw samples of a normal distribution inside bounds and a domain, with a fixed seed.

    A sample outside is drawn again. If fewer than `count` of 100 000 samples are inside, as with many estimates
    at their bounds, a Gibbs sampler draws parameter by parameter (Geweke 1991, section 3).

    Args:
        mean: (P,) inside the bounds.
        covariance: (P, P) positive definite.
        bounds: lower (P,) and upper (P,).
        is_valid: function (P,) -> whether a point inside the bounds belongs to the domain.
        count: number of samples.

    Returns:
        (n, P) samples; n is smaller than `count` only if nearly all points are outside the domain.
    """
    rng, root, (low, high) = np.random.default_rng(_SEED), factor_information(covariance), bounds
    found: list[np.ndarray] = []
    for _ in range(_MAX_BATCHES):
        drawn = mean + rng.standard_normal((_BATCH, len(mean))) @ root.T
        inside = drawn[np.all((drawn >= low) & (drawn <= high), axis=1)]
        found += [point for point in inside[: count - len(found)] if is_valid(point)]
        if len(found) == count:
            return np.array(found)
    inverse = np.linalg.inv(root)
    information = inverse.T @ inverse
    sd = 1.0 / np.sqrt(np.diag(information))
    found, point = [], np.clip(mean, low, high)
    for sweep in range(1, _MAX_CHECKS * _SWEEPS * count):
        for k in range(len(mean)):
            middle = point[k] - sd[k] ** 2 * (information[k] @ (point - mean))
            below, above = ndtr((np.array([low[k], high[k]]) - middle) / sd[k])
            point[k] = np.clip(middle + sd[k] * ndtri(below + (above - below) * rng.uniform()), low[k], high[k])
        if sweep % _SWEEPS == 0 and is_valid(point):
            found.append(point.copy())
            if len(found) == count:
                break
    return np.array(found)


def _beyond_dents(evidence: Evidence, guess: Guess, alone: np.ndarray) -> np.ndarray:
    """Factors of standard deviations where a likelihood has dents, as that of teeth with a gap.

    A search ends in one dent of many, and the curvature there is that of the dent. Numbers are told
    no better than by moves that raise the loss by more than dents do; looked for where the runs are
    filtered anew, number by number.

    Args:
        evidence: with the guess as its base.
        guess: fitted.
        alone: (P,) standard deviations of each number with the others held, by the curvature.

    Returns:
        (P,) factors, at least 1: half the geometric mean of the last move that stays among the
        dents and the first that does not.
    """
    first, here, found = 0, guess.deviation, np.ones(len(alone))
    step = evidence.step_of(guess, MIDDLE)

    def losses(index: int, sizes: Sequence[float]) -> np.ndarray:
        """(K, 2) of the loss, for K sizes of a move of a number to either side."""
        guesses = []
        for move in np.outer(sizes, (1.0, -1.0)).ravel():
            moved = here.copy()
            moved[index] += move * alone[index]
            guesses.append(guess.at(moved))

        def one(pair: tuple[Guess, Track]) -> float:
            moved, track = pair
            machine = moved.machine(evidence.data.machine, track.run.name)
            return track_run(machine, evidence.data, track.run, None, step, track.levels,
                             rest=track.rest).loss  # fmt: skip

        pairs = [(moved, track) for moved in guesses for track in evidence.tracks]
        return np.reshape(evidence.map(one, pairs), (len(sizes), 2, -1)).sum(axis=2)

    for hypothesis, deviation in guess.parts:
        own = range(first, first + len(deviation))
        first += len(deviation)
        if hypothesis.name not in _DENTED:
            continue
        for index in own:
            near = losses(index, _NEAR) - np.array(_NEAR)[:, None] ** 2
            level = float(np.median(near))
            depth, reach = float(np.quantile(np.abs(near - level), _MOST)), _NEAR[-1]
            while reach < _FARTHEST:
                rise = float(losses(index, [2.0 * reach]).min()) - level
                if rise > depth:
                    break
                reach *= 2.0
            found[index] = np.sqrt(2.0) * reach / 2.0 if reach > _NEAR[-1] else 1.0
    return found


def sandwich_variances(
    tracks: Sequence[Track], errors: np.ndarray, slopes: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Return the variances (P,) that follow from how unlike stretches of the runs pull at the parameters.

    Args:
        tracks: of the fitted guess.
        errors: (E,) its whitened errors.
        slopes: (E, P) change of the errors per deviation.
        covariance: (P, P) inverse information.

    Source: White 1982, Econometrica 50(1), section 3.
    """
    pulls, at = [], 0
    whole = sum(len(track.whitened) * track.run.period for track in tracks)
    seconds = float(np.clip(whole / _STRETCHES, MEMORY, BLOCK))
    for track in tracks:
        rows, channels = track.whitened.shape
        count = max(1, int(rows * track.run.period / seconds))
        edges = at + channels * np.linspace(0, rows, count + 1).astype(int)
        pull = slopes[at : at + rows * channels] * errors[at : at + rows * channels, None]
        pulls.append(np.add.reduceat(pull, edges[:-1] - at, axis=0))
        at += rows * channels
    scores = np.concatenate(pulls)
    scores = scores - scores.mean(axis=0)
    spread = scores.T @ scores * len(scores) / max(len(scores) - 1, 1)
    return np.diag(covariance @ (spread + np.eye(len(covariance))) @ covariance)
