"""Laws of what no effect explains: located, estimated, fitted, and written into the machine.

The filter's unknown inputs (`estimate.inputs`) say which balance lacks something, where and when;
in their places tables over one or two physical variables of this drive or another are tried
(`law_tables`). What the pump lacks is read off the supply's balance (`balances.pump_lack`). What
predicts runs that it was not fitted to best (`law_regression`) is put into the machine, fitted
again there, where the filter sees clearer, and kept if it is worth its entries. It is a term of the
patched machine (`hydrotele.terms`), which every simulator calculates.

Regression of prediction errors on the entries of a law's table, judged by runs left out.

The errors are those of a track whose unknown inputs have taken up what they could; how they answer
to an addition is known to first order (`estimate.responses`). So a reading counts as it does in
the likelihood, and a law that is faster than the unknown inputs is seen as it is, not as a smoother
blurs it. Entries that follow each other are taken to be alike (P-splines, Eilers and Marx 1996).
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.calibration import CALIBRATION
from hydrotele.estimate.evidence import Evidence, Judged, flat
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import Guess, Hypothesis
from hydrotele.estimate.inputs import SUPPLY, Input, input_sizes
from hydrotele.estimate.levels import columns_of, smoothed, smoothed_inputs
from hydrotele.estimate.reduced_dynamics import place, supply_of
from hydrotele.estimate.reduced_model import X, model_space
from hydrotele.estimate.responses import error_responses
from hydrotele.estimate.track import Track, following_model
from hydrotele.gap.balances import pump_lack
from hydrotele.gap.law_tables import (
    THROUGH,
    Table,
    finer_memories,
    paired_tables,
    possible_tables,
    remembering_tables,
)
from hydrotele.gap.rivals import ENTER
from hydrotele.gap.screening import busy_window
from hydrotele.gap.search import lacking
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import OF_A_DRIVE, Term

_PARTS = 4  # of a single run, left out one by one
_MEMORY_ROWS = 15.0  # that a smoother's answer is alike
_SMOOTHNESS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)  # of the entries, in units of the lack


class Regression(NamedTuple):
    """A law's entries.

    Attributes:
        predicted: fall of -2 log likelihood in runs that were left out, all together.
        entries: (K,) [unit of the addition].
        covariance: (K, K) of the entries [unit of the addition, squared].
        charge: what the entries cost: log determinant of what the data add to their precision.
        left: RMS of what the law does not take of the unknown input [unit of the addition].
    """

    predicted: float
    entries: np.ndarray
    covariance: np.ndarray
    charge: float
    left: float


def regression(
    table: Table, parts: Sequence[tuple[Track, np.ndarray, np.ndarray]], size: float
) -> Regression:
    """Fit a table's entries to the errors of some tracks.

    Args:
        table: with K entries.
        parts: per run the track, what a unit of the addition does (n, nz), and the entries' shares
            (n, K).
        size: standard deviation of the unknown input in whose place the law is put.

    Returns:
        The regression, with the smoothness that predicts best what was left out.
    """
    answers = []
    for track, column, shares in parts:
        slope = error_responses(track, column, shares * size)
        answers.append((slope.reshape(-1, slope.shape[2]), flat(track.whitened)))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for _, _, shares in parts])
    left = size * float(np.sqrt(max(1.0 - np.mean(along**2), 0.0)))
    return Regression(falls, x * size, covariance * size**2, charge, left)


def lack_regression(
    table: Table, parts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[Regression, float]:
    """Fit a table's entries to a lack that readings tell row by row.

    Args:
        table: with K entries.
        parts: per run the lack (n,), its standard deviation (n,) and the entries' shares (n, K).

    Returns:
        (The regression, the share of the lack's square in its standard deviations that it predicts
        where it was left out); rows over which smoothed readings hang together count as one.
    """
    lack = np.concatenate([told for told, _, _ in parts])
    size = float(np.sqrt(np.mean(lack**2)))
    answers = []
    for told, deviation, shares in parts:
        each = np.sqrt(_MEMORY_ROWS) * deviation
        answers.append((-size * shares / each[:, None], told / each))
    falls, x, covariance, charge = _entries(table, answers)
    along = np.concatenate([shares @ x for _, _, shares in parts])
    left = float(np.sqrt(np.mean((lack - size * along) ** 2)))
    share = falls / sum(float(errors @ errors) for _, errors in answers)
    return Regression(falls, x * size, covariance * size**2, charge, left), share


def _entries(
    table: Table, answers: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Fall of what is left out, entries, their covariance and charge, with the best smoothness.

    Args:
        table: with K entries.
        answers: per run the slopes of its errors with the entries (n, K), and the errors (n,).
    """
    if len(answers) == 1:
        cuts = (np.array_split(part, _PARTS) for part in answers[0])
        answers = list(zip(*cuts, strict=True))
    curvature = np.array([s.T @ s for s, _ in answers])
    slope = np.array([s.T @ e for s, e in answers])
    falls = {
        smooth: sum(
            _left_out(curvature, slope, table.precision(smooth), k) for k in range(len(curvature))
        )
        for smooth in _SMOOTHNESS
    }
    smooth = max(falls, key=falls.__getitem__)
    prior = table.precision(smooth)
    whole = curvature.sum(axis=0) + prior
    x = -np.linalg.solve(whole, slope.sum(axis=0))
    charge = np.linalg.slogdet(whole)[1] - np.linalg.slogdet(prior)[1]
    return falls[smooth], x, np.linalg.inv(whole), float(charge)


def at_a_glance(table: Table, parts: Sequence[tuple[np.ndarray, np.ndarray]]) -> float:
    """Share of an unknown input's square, as a smoother tells it, that a table takes if left out.

    Args:
        table: with K entries.
        parts: per run the input (n,) and the entries' shares (n, K).

    Returns:
        The share; what the smoother blurs, it misses, so that this is for choosing what to try.
    """
    if len(parts) == 1:
        ((told, shares),) = parts
        cut = (np.array_split(told, _PARTS), np.array_split(shares, _PARTS))
        parts = list(zip(*cut, strict=True))
    whole = sum(float(told @ told) for told, _ in parts)
    size = whole / sum(len(told) for told, _ in parts)
    rows = _MEMORY_ROWS * size  # readings that hang together are as few as one
    curvature = np.array([s.T @ s for _, s in parts]) / rows
    slope = -np.array([s.T @ told for told, s in parts]) / rows
    prior = table.precision(1.0) / size
    falls = (_left_out(curvature, slope, prior, k) for k in range(len(parts)))
    return sum(falls) * rows / whole if whole > 0.0 else 0.0


def _left_out(curvature: np.ndarray, slope: np.ndarray, prior: np.ndarray, out: int) -> float:
    """Fall of the loss of a part that the fit of the entries has not seen."""
    others = curvature.sum(axis=0) - curvature[out] + prior
    x = -np.linalg.solve(others, slope.sum(axis=0) - slope[out])
    return -float(2.0 * slope[out] @ x + x @ curvature[out] @ x)


LEARNED = "learned"
"""First part of the name of a hypothesis that holds a learned law."""
_MOST = 3  # laws that are learned one after the other
_LARGEST = 4  # unknown inputs in whose places laws are looked for
_COUPLED = 2  # of these, for which variables of other drives are paired, too
_REMEMBERED = 3  # tables over one and over two variables that are tried with memories
_MEMORIES = 6  # tables with a memory that are looked at closely, for each lack
_FINER = (0.4, 0.2, 0.1)  # of a memory's width, by which it is changed
_PAIRS = 12  # tables over two variables that are looked at closely, for each lack
_TRIED = 2  # laws that are put into the machine, of all that the regression finds
_OTHERS = 3  # of other balances, one by one, where free runs get better by none of these
_MOSTLY = 0.5  # of the square of what a pump lacks that a law must predict to be tried
_SHORT_ROWS = 20  # of a run in which its pump is short that it takes to be read
_PLAINER = 0.9  # of the best law's fall that one of a single variable needs to go before it
_AGAIN = 5  # times that a law is fitted again inside the machine
_STEPS = 3  # of Gauss-Newton for the numbers beside a law
_DETAIL = 0.05  # of what all laws brought: one that brings less is the last
_AHEAD = 1.0  # s, of free runs that a law must make better; longer ones drift without readings
_FAR_AHEAD = 5.0  # s, of those that it must not make worse
_LOSS = 0.1  # of what free runs gain by effects and laws that laws alone may lose
_LOST = 1.0e3  # times the noise: errors of a free run that got lost
_STEP = 2.0e-3  # s, for the fits
_MOVES = (-0.25, -0.1, 0.0, 0.1, 0.25)  # s, by which a window's ends are moved
_LOUD = 0.2  # of the mean square in a window that its ends have
_AS_GOOD = 0.98  # of the most that is predicted: of such windows the shortest is taken


@dataclass(frozen=True)
class Learned:
    """A law in the guess.

    Attributes:
        hypothesis: the machine with it; it has no parameters.
        balance: force, flow_head, flow_rod, `THROUGH`, command or `SUPPLY`.
        axis: of the drive.
        table: its form.
        entries: (K,) of the table [unit of the balance].
        covariance: (K, K) of the entries.
        left: RMS of the lack that it does not take [unit of the balance].
        charge: what its entries cost, of -2 log likelihood.
        smoothing: of the sign of the velocity [m/s] or [rad/s].
        seen: variable -> values along the fit runs.
    """

    hypothesis: Hypothesis
    balance: str
    axis: str
    table: Table
    entries: np.ndarray
    covariance: np.ndarray
    left: float
    charge: float
    smoothing: float
    seen: Mapping[str, np.ndarray] = field(repr=False)

    @property
    def kind(self) -> tuple:
        """Balance, axis and variables; two laws of one kind would be one."""
        return self.balance, self.axis, *self.table.kind


class OpenLoop(NamedTuple):
    """Errors of free runs in units of the noise; NaN where all runs are shorter.

    Attributes:
        usual: geometric mean over the windows of `_AHEAD` of their RMS over rows and channels, none
            below the noise: one window that diverges says little of the others, and most of them
            nothing of a law that rarely acts.
        rms: over all rows of these windows.
        far: the same of windows of `_FAR_AHEAD`.
    """

    usual: float
    rms: float
    far: float


_NOT_RUN = OpenLoop(np.nan, np.nan, np.nan)


@dataclass(frozen=True)
class Discovery:
    """The guess with its learned laws, judged, and these laws.

    `refused` of them made free runs of the held-out run worse and were taken back.
    Errors of these free runs are `ahead`, and `before` without the laws.
    """

    judged: Judged
    laws: tuple[Learned, ...]
    refused: int = 0
    ahead: OpenLoop = _NOT_RUN
    before: OpenLoop = _NOT_RUN

    def stands_for(self, other: "Discovery", charges: float) -> bool:
        """Whether its laws tell the runs as well as another guess does that has effects, too.

        Free runs are told as well where a tenth of what the other one gains at most is lost, and
        less than the noise (of squares of RMS).

        Args:
            other: with effects, and laws beside them.
            charges: what the numbers of these effects cost, of -2 log likelihood.
        """
        costs = [d.judged.loss + sum(law.charge for law in d.laws) for d in (self, other)]
        bare, own, others = (np.square(a) for a in (self.before, self.ahead, other.ahead))
        lost = own - others > np.clip(_LOSS * (bare - others), 0.0, 1.0)
        return bool(self.laws and not lost.any() and costs[0] <= costs[1] + charges)


class _Seen(NamedTuple):
    """A run by what its smoother says: variables of every axis, and the rows that are known."""

    values: dict[str, dict[str, np.ndarray]]
    known: np.ndarray
    inputs: np.ndarray


def discover(evidence: Evidence, judged: Judged) -> Discovery:
    """Learn laws of what a guess lacks, one after the other.

    The numbers of named effects stay as they are: a law is what remains after them, and must not
    take their place. Calibrated numbers may give way.

    Args:
        evidence: the runs.
        judged: the guess, judged with unknown inputs.

    Returns:
        The guess with the laws that are worth their parameters, and that do not make free runs of
        the held-out run worse.
    """
    begun, heldout = judged, (evidence.data.heldout,)
    laws: list[Learned] = []
    named = [h.name != CALIBRATION for h in judged.guess.hypotheses]
    parts = judged.guess.parts
    held = [
        (h.held(d), np.zeros(0)) if n else (h, d) for n, (h, d) in zip(named, parts, strict=True)
    ]
    prior = sum(float(d @ d) for n, (_, d) in zip(named, parts, strict=True) if n)
    judged = replace(judged, guess=Guess(tuple(held)), loss=judged.loss - prior)
    noise = judged.tracks[0].levels.noise  # the same for all laws: each finds other levels
    bare = judged
    begin, ahead = judged.loss, _open_loop(evidence, evidence.runs, judged, noise)
    for _ in range(_MOST):
        evidence.set_base(judged)
        seen = [_see(evidence.data, judged, track) for track in judged.tracks]
        found = None
        for candidates in _candidates(evidence, judged, seen, laws):
            tried = _best_law(evidence, judged, seen, candidates)
            now = _open_loop(evidence, evidence.runs, tried[0], noise) if tried else ahead
            if tried and better_ahead(now, ahead):
                found, ahead = tried, now
                break
        if found is None:
            break
        fall = judged.loss - found[0].loss
        judged, law = found
        laws.append(law)
        if fall < _DETAIL * (begin - judged.loss) or lacking(judged, evidence) < ENTER:
            break
    last, first = (_open_loop(evidence, heldout, j, noise) for j in (judged, bare))
    if laws and not better_ahead(last, first):
        return Discovery(begun, (), len(laws), first, first)
    found = judged.guess.parts
    own = [old if n else new for n, old, new in zip(named, parts, found, strict=False)]
    guess = Guess((*own, *found[len(parts) :]))
    judged = replace(judged, guess=guess, loss=judged.loss + prior)
    return Discovery(judged, tuple(laws), 0, last, first)


def _best_law(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen], candidates: Sequence[Learned]
) -> tuple[Judged, Learned] | None:
    """The first candidate that is worth its entries, fitted again inside the machine, judged."""
    best: tuple[Judged, Learned] | None = None
    for law in candidates:
        now = _with_law(evidence, judged, law)
        if judged.loss - now.loss > ENTER and (best is None or now.loss < best[0].loss):
            best = now, law
    for _ in range(_AGAIN if best else 0):
        assert best
        now, law = best
        evidence.set_base(now)
        again = _refitted(evidence, now, seen, law)
        if again is None:
            break
        tried = _with_law(evidence, judged, again)
        if now.loss - tried.loss < ENTER:
            break
        best = tried, again
    evidence.set_base(judged)
    return best


def _with_law(evidence: Evidence, judged: Judged, law: Learned) -> Judged:
    """A guess with a law more, its other numbers fitted anew."""
    guess = judged.guess.plus(law.hypothesis, np.zeros(0))
    if len(guess.deviation):
        kept = evidence.base_slopes(_STEP)
        if kept.shape[1] == len(guess.deviation):
            guess = evidence.fit(guess, 0.0, step=_STEP, kept=kept, steps=_STEPS).guess
    return evidence.judged(guess)


def _refitted(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen], law: Learned
) -> Learned | None:
    """A law with what the machine that has it still lacks in its form; None for nothing.

    Where its input is no longer needed, readings tell the entries far better than beside it: what
    they have wrong adds up then. That matters in free runs.
    """
    levels, case = judged.tracks[0].levels, (_input(law.balance, law.axis), law.balance, law.table)
    known = dict(zip(levels.inputs, levels.sizes, strict=True))
    spread = float(np.sqrt(np.mean(np.diag(law.covariance))))
    more = _regressed(evidence, judged, seen, case, known.get(case[0], spread))
    if more.predicted < ENTER:
        return None
    found = more._replace(entries=law.entries + more.entries)
    return _law(evidence.data.machine, case, found, seen, law.hypothesis)


def _input(balance: str, axis: str) -> Input:
    """The unknown input in whose place a law of a balance is."""
    return Input("flow_head" if balance == THROUGH else balance, axis)


def better_ahead(now: OpenLoop, before: OpenLoop) -> bool:
    """Whether free runs are better, none got lost and long ones are no worse."""
    short = np.isnan(now.usual) or (now.usual < before.usual and now.rms <= before.rms)
    return bool(short and (np.isnan(now.far) or now.far <= before.far))


def _open_loop(
    evidence: Evidence, runs: Sequence[RunData], judged: Judged, noise: np.ndarray
) -> OpenLoop:
    """Errors of free runs through some runs over all channels, in units of a noise (c,).

    A law is to make simulations better, not only predictions from one reading to the next.
    """
    prepare = machine_runner(judged.guess.machine(evidence.data.machine), evidence.data, _STEP)

    def sizes(run: RunData) -> np.ndarray:
        found = free_run_errors(prepare(run), run, (_AHEAD, _FAR_AHEAD), to_end=False).horizons
        near, far = (found.get(f"{seconds:g}") for seconds in (_AHEAD, _FAR_AHEAD))
        if near is None:
            return np.full(3, np.nan)
        each = np.sqrt(np.nanmean((near.each / noise) ** 2, axis=1))
        squares = [np.nanmean((h.rms / noise) ** 2) if h else np.nan for h in (near, far)]
        return np.array([np.nanmean(np.log(np.clip(each, 1.0, _LOST))), *squares])

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # no window is long enough, nothing is read
        usual, rms, far = np.nanmean(evidence.map(sizes, runs), axis=0)
    return OpenLoop(float(np.exp(usual)), float(np.sqrt(rms)), float(np.sqrt(far)))


@compiled
def _drives_of(model, sp, states, position, velocity, act, supply):
    """Positions, velocities (n, nu), activations (n, 4 h) and supply (n,) along states (n, nz)."""
    n, t = len(model.mech.free), len(model.transmission)
    for row in range(len(states)):
        place(model, sp, states[row])
        for i in range(len(model.gear)):
            position[row, i] = sp.drive[X, i]
            total = 0.0
            for f in range(n):
                total += sp.row[i, f] * states[row, n + t + f]
            velocity[row, i] = total
        for k in range(act.shape[1]):
            act[row, k] = sp.act[k]
        if model.hydraulic > 0:
            supply[row] = supply_of(model, sp, states[row])


def _see(data: Dataset, judged: Judged, track: Track) -> _Seen:
    machine = judged.guess.machine(data.machine)
    size = track.states.shape[1]
    run, told = smoothed(track)
    states = track.states - run.correction[:, :size] + told.deviation[:, :size]
    model = following_model(machine, data)
    order = actuator_order(machine)
    position, velocity = np.empty((len(states), len(order))), np.empty((len(states), len(order)))
    supply, act = np.zeros(len(states)), np.empty((len(states), 4 * model.hydraulic))
    _drives_of(
        model, model_space(model), np.ascontiguousarray(states), position, velocity, act, supply
    )
    clock = track.run.start + track.run.period * np.arange(len(states))
    values: dict[str, dict[str, np.ndarray]] = {}
    for i, axis in enumerate(order):
        own = {"time": clock, "position": position[:, i], "velocity": velocity[:, i],
               "command": track.run.command[:, i]}  # fmt: skip
        facts = machine.axes[axis]
        if facts.hydraulic:
            head, rod = act[:, 4 * i + 2], act[:, 4 * i + 3]
            areas = facts.hydraulic_drive.areas
            own |= {"pressure_head": head, "pressure_rod": rod,
                    "force": areas[0] * head - areas[1] * rod}  # fmt: skip
            own["pump_speed" if facts.pump else "spool"] = act[:, 4 * i]
            if facts.valve:
                own["pressure_supply"] = supply
        elif facts.force:
            own["force"] = facts.force.gain * own["command"]
        values[axis] = own
    plain = {axis: dict(own) for axis, own in values.items()}
    for axis, own in values.items():
        own |= {f"{name}.{other}": column for other, columns in plain.items() if other != axis
                for name, column in columns.items() if name in OF_A_DRIVE}  # fmt: skip
    known = np.isfinite(states.sum(axis=1))
    known[: min(round(0.5 / track.run.period), len(states) // 4)] = False
    if track.run.valid is not None:
        known &= track.run.valid
    return _Seen(values, known, smoothed_inputs(track, (run, told)))


_Case = tuple[Input, str, Table]


def _candidates(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen], laws: Sequence[Learned]
) -> list[list[Learned]]:
    """Laws worth a trial for the largest lacks: those that predict best, then of other balances."""
    machine, levels = evidence.data.machine, judged.tracks[0].levels
    order = np.argsort(-levels.sizes / input_sizes(machine, levels.inputs))
    taken = {law.kind for law in laws}

    def tried(cases: Sequence[_Case]) -> list[tuple[_Case, Regression]]:
        cases = [c for c in cases if (c[1], c[0].axis, *c[2].kind) not in taken]
        sizes = dict(zip(levels.inputs, levels.sizes.tolist(), strict=True))

        def one(case: _Case) -> Regression:
            return _regressed(evidence, judged, seen, case, sizes[case[0]])

        return list(zip(cases, evidence.map(one, cases), strict=True))

    looked = []
    for rank, k in enumerate(order[:_LARGEST]):
        i = levels.inputs[int(k)]
        balances = [i.balance]
        if i.balance == "flow_head" and Input("flow_rod", i.axis) in levels.inputs:
            balances.append(THROUGH)
        told = [(_clock(s), s.known, s.inputs[:, int(k)]) for s in seen]
        window, whole = busy_window(told, _LOUD), busy_window(told)
        values, speed = [s.values[i.axis] for s in seen], _smoothing(machine, i.axis)
        for balance in balances:
            at = i, balance
            for span in ((), window) if window else ((),):
                tables = possible_tables(values, speed, span)
                pairs = paired_tables(values, speed, rank < _COUPLED, span)
                tables += _likely_pairs(evidence, seen, levels.inputs, at, pairs)
                inside = tried([(*at, table) for table in tables])
                if rank < _COUPLED and not span:
                    inside += _remembered(evidence, seen, levels.inputs, inside, tried)
                best = max(inside, key=lambda pair: pair[1].predicted, default=None)
                if span and best and best[1].predicted > ENTER:
                    ends = {*_moved_windows(window), *_moved_windows(whole)}
                    moved = tried([(*at, best[0][2]._replace(window=w)) for w in ends])
                    inside = [pair for pair in inside if pair is not best] + [_shortest(moved)]
                looked += inside
    ranked = _best_first(looked)
    best = ranked[:_TRIED] + _pump_laws(evidence, judged, seen)[:1]
    where = {(case[1], case[0].axis) for case, _ in best}
    groups = [best] if best else []
    for case, answer in ranked:
        if (case[1], case[0].axis) not in where and len(groups) <= _OTHERS:
            where.add((case[1], case[0].axis))
            groups.append([(case, answer)])
    return [[_law(machine, case, answer, seen) for case, answer in group] for group in groups]


def _remembered(
    evidence: Evidence, seen: Sequence[_Seen], inputs: Sequence[Input],
    looked: Sequence[tuple[_Case, Regression]], tried: Callable,
) -> list[tuple[_Case, Regression]]:  # fmt: skip
    """The likeliest laws with a memory: tables that may do, with what each could remember."""
    if not looked:
        return []
    (i, balance, _), _ = looked[0]
    values = [s.values[i.axis] for s in seen]
    best = sorted(looked, key=lambda pair: -pair[1].predicted)
    single = [case[2] for case, _ in best if len(case[2].variables) == 1]
    paired = [case[2] for case, _ in best if len(case[2].variables) == 2][:_REMEMBERED]
    others = [table.variables[0] for table in single]
    tables = [t for table in [*single, *paired]
              for t in remembering_tables(table, values, table.variables)]  # fmt: skip
    for table in single[:_REMEMBERED]:
        rest = [name for name in others if name not in table.variables]
        tables += remembering_tables(table, values, rest)

    def judged(some: Sequence[Table]) -> list[tuple[float, Table]]:
        return list(zip(_glances(evidence, seen, inputs, (i, balance), some), some, strict=True))

    first = sorted(judged(tables), key=lambda pair: -pair[0])
    likely: list[tuple[float, Table]] = []
    for share, table in first:  # the best of each kind
        if table.kind not in [other.kind for _, other in likely]:
            likely.append((share, table))
    found = []
    for share, table in likely[:_MEMORIES]:
        for step in _FINER:
            moved = max(judged(finer_memories(table, step)), key=lambda pair: pair[0])
            share, table = moved if moved[0] > share else (share, table)
        found.append((i, balance, table))
    closely = tried(found)
    if not closely:
        return []
    case, answer = max(closely, key=lambda pair: pair[1].predicted)
    return [*closely, *tried([(i, balance, t) for t in finer_memories(case[2], _FINER[-1])])]


def _best_first(looked: Sequence[tuple[_Case, Regression]]) -> list[tuple[_Case, Regression]]:
    """What is worth its entries, by what it predicts; what is plain goes first."""
    most = max((answer.predicted for _, answer in looked), default=0.0)

    def place(pair: tuple[_Case, Regression]) -> tuple[bool, float]:
        table = pair[0][2]
        plain = len(table.variables) == 1 and not table.memory
        plain = plain and pair[1].predicted >= _PLAINER * most
        return not plain, -pair[1].predicted

    return sorted((pair for pair in looked if pair[1].predicted > ENTER), key=place)


def _pump_laws(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen]
) -> list[tuple[_Case, Regression]]:
    """Laws of what the pump lacks that a machine's valves share, best first.

    None where a term already adds to its flow: what that lacks is an unknown input of the filter.
    """
    data = evidence.data
    machine = judged.guess.machine(data.machine)
    limited = machine.supply is not None and machine.supply.kind != "constant_pressure"
    if not (limited and machine.valve_axes) or any(t.balance == SUPPLY for t in machine.terms):
        return []
    noise = judged.tracks[0].levels.noise
    told = evidence.map(lambda track: pump_lack(machine, data, track.run, noise), judged.tracks)
    rows = [s.known & np.isfinite(flow) for s, (flow, _) in zip(seen, told, strict=True)]
    own = Input(SUPPLY, next(iter(machine.valve_axes)))
    used = [k for k, row in enumerate(rows) if np.count_nonzero(row) > _SHORT_ROWS]
    if not used:
        return []
    values = [seen[k].values[own.axis] for k in used]
    lacks = [(told[k][0][rows[k]], told[k][1][rows[k]]) for k in used]

    def tried(tables: Sequence[Table]) -> list[tuple[_Case, Regression]]:
        def fitted(table: Table) -> tuple[Regression, float]:
            shares = [table.columns(v)[rows[k]] for k, v in zip(used, values, strict=True)]
            parts = [(*lack, share) for lack, share in zip(lacks, shares, strict=True)]
            return lack_regression(table, parts)

        found = zip(tables, evidence.map(fitted, tables), strict=True)
        return [((own, SUPPLY, t), fit) for t, (fit, share) in found if share > _MOSTLY]

    speed = _smoothing(machine, own.axis)
    window = busy_window([(_clock(seen[k]), rows[k], told[k][0]) for k in used])
    windows = ((), window) if window else ((),)
    tables = [t for w in windows for t in possible_tables(values, speed, w)]
    tables += [t for w in windows for t in paired_tables(values, speed, True, w)]
    return _best_first(tried(tables))


def _likely_pairs(
    evidence: Evidence, seen: Sequence[_Seen], inputs: Sequence[Input], at: tuple[Input, str],
    tables: Sequence[Table],
) -> list[Table]:  # fmt: skip
    """Those that take most of an unknown input as the smoother tells it."""
    found = _glances(evidence, seen, inputs, at, tables)
    return [tables[k] for k in np.argsort(found)[::-1][:_PAIRS]]


def _glances(
    evidence: Evidence, seen: Sequence[_Seen], inputs: Sequence[Input], at: tuple[Input, str],
    tables: Sequence[Table],
) -> list[float]:  # fmt: skip
    """Share of an unknown input, as the smoother tells it, that each table takes."""
    i, balance = at
    told = [s.inputs[s.known, inputs.index(i)] for s in seen]
    if balance == THROUGH:
        rod = inputs.index(Input("flow_rod", i.axis))
        told = [0.5 * (s.inputs[s.known, rod] - t) for s, t in zip(seen, told, strict=True)]

    def glance(table: Table) -> float:
        shares = [table.columns(s.values[i.axis])[s.known] for s in seen]
        return at_a_glance(table, list(zip(told, shares, strict=True)))

    return evidence.map(glance, tables)


def _regressed(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen], case: _Case, size: float
) -> Regression:
    """Regression of a table in the place of an unknown input of some size, if it is there."""
    i, balance, table = case
    inputs = (i, Input("flow_rod", i.axis)) if balance == THROUGH else (i,)
    machine, there = judged.guess.machine(evidence.data.machine), judged.tracks[0].levels.inputs
    parts = []
    for track, s in zip(judged.tracks, seen, strict=True):
        if set(inputs) <= set(there):
            columns = track.columns[:, [there.index(n) for n in inputs]]
        else:
            columns = columns_of(machine, track, inputs)
        column = columns[:, 1] - columns[:, 0] if balance == THROUGH else columns[:, 0]
        shares = table.columns(s.values[i.axis])
        parts.append((track, column, np.where(s.known[:, None], shares, 0.0)))
    return regression(table, parts, size)


def _moved_windows(window: tuple[float, ...]) -> list[tuple[float, float]]:
    """A window, and some whose ends are somewhat earlier or later."""
    begin, end = window
    return [(begin + a, end + b) for a in _MOVES for b in _MOVES if begin + a < end + b]


def _shortest(looked: Sequence[tuple[_Case, Regression]]) -> tuple[_Case, Regression]:
    """Of windows that predict about as much, the shortest one."""
    most = _AS_GOOD * max(answer.predicted for _, answer in looked)
    good = (pair for pair in looked if pair[1].predicted >= most)
    return min(good, key=lambda pair: pair[0][2].window[1] - pair[0][2].window[0])


def _clock(seen: _Seen) -> np.ndarray:
    return next(iter(seen.values.values()))["time"]


def _smoothing(machine: Machine, axis: str) -> float:
    return machine.axes[axis].drive.friction.smoothing_velocity


def _law(
    machine: Machine, case: _Case, found: Regression, seen: Sequence[_Seen],
    known: Hypothesis | None = None,
) -> Learned:  # fmt: skip
    """A law of a regression; `known` is the hypothesis that it replaces."""
    i, balance, table = case
    values = [s.values[i.axis] for s in seen]
    everywhere = {v: np.concatenate([x[v] for x in values]) for v in values[0]}
    name = f"{LEARNED}_{balance}"
    sides = (("flow_head", -1.0), ("flow_rod", 1.0)) if balance == THROUGH else ((balance, 1.0),)

    def change(nominal: Machine, _: Mapping[str, float]) -> Machine:
        terms = list(nominal.terms)
        taken = {term.name for term in terms if term.axis == i.axis}
        own = next(n for n in chain([name], (f"{name}_{k}" for k in count(2))) if n not in taken)
        for side, sign in sides:
            terms.append(Term.model_validate({
                "name": own, "axis": i.axis, "balance": side, "uncertainty": found.left,
                "description": f"learned from data: {balance} over {table.name}",
                **table.law(sign * found.entries),
            }))  # fmt: skip
        return nominal.model_copy(update={"terms": tuple(terms)})

    hypothesis = Hypothesis(name, known.location if known else f"{i.axis}.{table.name}", {}, change)
    return Learned(
        hypothesis, balance, i.axis, table, found.entries, found.covariance, found.left,
        found.charge, _smoothing(machine, i.axis), everywhere,
    )  # fmt: skip
