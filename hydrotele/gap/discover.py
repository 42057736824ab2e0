"""Laws of what no effect explains: located, estimated, fitted, and written into the machine.

The filter's unknown inputs (`estimate.filter`) say which balance lacks something, where and when;
in the place of each of the largest inputs every form of a law (`law_tables`) over one or two
physical variables of this drive or another is glanced at; the likeliest are regressed on the
prediction errors and ranked by what they predict in parts of runs that are left out. The best is
put into the machine, looked for again there, where the filter sees clearer, and kept if it is worth
its entries and makes free runs better. It is a term of the patched machine (`hydrotele.terms`),
which every simulator calculates.

What the pump lacks is read off the supply's balance (`balances.pump_lack`).
"""

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.estimate.evidence import Evidence, Judged, flat
from hydrotele.estimate.filter import SUPPLY, Input, input_sizes
from hydrotele.estimate.free_run import free_run_errors, machine_runner
from hydrotele.estimate.hypothesis import CALIBRATION, LEARNED, Guess, Hypothesis
from hydrotele.estimate.levels import columns_of, smoothed, smoothed_inputs
from hydrotele.estimate.reduced_model import X, model_space, place, supply_of
from hydrotele.estimate.track import Track, error_responses, following_model
from hydrotele.gap.balances import pump_lack
from hydrotele.gap.law_tables import (
    THROUGH,
    Ground,
    Regression,
    Table,
    at_a_glance,
    finer_memories,
    ground,
    lack_regression,
    paired_tables,
    parts_left_out,
    possible_tables,
    predicted_by_choice,
    regression,
    remembering_tables,
)
from hydrotele.gap.rivals import ENTER
from hydrotele.gap.screening import busy_window
from hydrotele.gap.search import lacking
from hydrotele.hydraulics.actuator_layout import actuator_order
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import DRIVE_VARIABLES, Term

_LARGEST = 4  # unknown inputs in whose places laws are looked for
_COUPLED = 2  # of these, for which variables of other drives are paired, too
_SINGLES = 6  # tables over one variable that are looked at closely, for each lack
_REMEMBERED = 3  # tables over two variables that are tried with memories of their own, and over
# one with those of others, too
_MEMORIES = 6  # tables with a memory that are looked at closely, for each lack
_MOVED = 2  # times by each of these
_FINER = (0.8, 0.4, 0.2, 0.1)  # of a memory's width, by which it is changed
_PAIRS = 4  # tables over two variables that are looked at closely, for each lack
_TRIED = 2  # laws that are put into the machine, of all that the regression finds
_PUMP_LAWS = 3  # of the pump's, whose lack is read off readings without knowing what it does
_OTHERS = 3  # of other balances, one by one, where free runs get better by none of these
_PARTLY = 0.2  # of the square of what a pump lacks that a law must predict to be tried
_SHORT_ROWS = 20  # of a run in which its pump is short that it takes to be read
_PLAINER = 0.9  # of the best law's fall that one of a single variable needs to go before it
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
        form_of: library effect whose coefficient it is; empty of a law without a known cause.
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

    form_of: str = ""

    @property
    def kind(self) -> tuple:
        """Balance, axis and variables; two laws of one kind would be one."""
        return self.balance, self.axis, *self.table.kind


class Seen(NamedTuple):
    """A run by what its smoother says: variables of every axis, and the rows that are known."""

    values: dict[str, dict[str, np.ndarray]]
    known: np.ndarray
    inputs: dict[Input, np.ndarray]


def input_of(balance: str, axis: str) -> Input:
    """The unknown input in whose place a law of a balance is."""
    return Input("flow_head" if balance == THROUGH else balance, axis)


@compiled
def _drives_of(model, sp, states, position, velocity, act, supply):
    """Positions, velocities (n, nu), activations (n, 4 h) and supplies (n, h) along states (n, nz)."""
    n, t = len(model.mech.independent), len(model.transmission)
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
        for i in range(model.hydraulic):
            supply[row, i] = supply_of(model, sp, states[row], i)


def see(data: Dataset, judged: Judged, track: Track) -> Seen:
    """A run of a guess by what the smoother of its track says."""
    return see_run(judged.guess.machine(data.machine, track.run.name), data, track, is_smoothed=True)


def see_run(machine: Machine, data: Dataset, track: Track, is_smoothed: bool = False) -> Seen:
    """A run of a machine by the states of its filter, which its laws see, or by states and inputs of its smoother."""
    size, states, inputs = track.states.shape[1], track.states, dict[Input, np.ndarray]()
    if is_smoothed:
        run, told = smoothed(track)
        states = states - run.correction[:, :size] + told.deviation[:, :size]
        inputs = dict(zip(track.levels.inputs, smoothed_inputs(track, (run, told)).T, strict=True))
    model = following_model(machine, data)
    order = actuator_order(machine)
    position, velocity = np.empty((len(states), len(order))), np.empty((len(states), len(order)))
    supply, act = np.zeros((len(states), model.hydraulic)), np.empty((len(states), 4 * model.hydraulic))
    _drives_of(model, model_space(model), np.ascontiguousarray(states), position, velocity, act, supply)
    clock = track.run.start + track.run.period * np.arange(len(states))
    values: dict[str, dict[str, np.ndarray]] = {}
    for i, axis in enumerate(order):
        own = {"time": clock, "position": position[:, i], "velocity": velocity[:, i],
               "command": track.run.command[:, i]}  # fmt: skip
        facts = machine.axes[axis]
        if facts.is_hydraulic:
            head, rod = act[:, 4 * i + 2], act[:, 4 * i + 3]
            areas = facts.hydraulic_drive.effective_areas
            own |= {"pressure_head": head, "pressure_rod": rod,
                    "force": areas[0] * head - areas[1] * rod}  # fmt: skip
            own["pump_speed" if facts.pump else "spool"] = act[:, 4 * i]
            if facts.valve:
                own["pressure_supply"] = supply[:, i]
        elif facts.force:
            own["force"] = facts.force.gain * own["command"]
        values[axis] = own
    plain = {axis: dict(own) for axis, own in values.items()}
    for axis, own in values.items():
        own |= {
            f"{name}.{other}": column for other, columns in plain.items() if other != axis
            for name, column in columns.items()
            if name in DRIVE_VARIABLES and (name != "force" or machine.axes[other].is_hydraulic)
        }  # fmt: skip
    known = np.isfinite(states.sum(axis=1))
    known[: min(round(0.5 / track.run.period), len(states) // 4)] = False
    if track.run.valid is not None:
        known &= track.run.valid
    return Seen(values, known, inputs)


Case = tuple[Input, str, Table]


@dataclass(frozen=True)
class Lacks:
    """What a guess lacks, as its errors and its smoother tell it.

    Attributes:
        evidence: the runs.
        judged: the guess.
        seen: its runs.
        errors: of each (n c,), whitened.
        sizes: of the unknown inputs.
    """

    evidence: Evidence
    judged: Judged
    seen: tuple[Seen, ...]
    errors: tuple[np.ndarray, ...]
    sizes: Mapping[Input, float]

    @classmethod
    def of(cls, evidence: Evidence, judged: Judged) -> "Lacks":
        """What a guess lacks that is judged with unknown inputs."""
        levels = judged.tracks[0].levels
        return cls(
            evidence, judged, tuple(see(evidence.data, judged, t) for t in judged.tracks),
            tuple(flat(track.whitened) for track in judged.tracks),
            dict(zip(levels.inputs, levels.sizes.tolist(), strict=True)),
        )  # fmt: skip

    def without(self, law: Learned) -> "Lacks":
        """What would be lacking without a law that is there, to first order about its motion."""
        i = input_of(law.balance, law.axis)
        seen, errors, squares = [], [], []
        for k, (track, s) in enumerate(zip(self.judged.tracks, self.seen, strict=True)):
            flow = np.where(s.known, law.table.columns(s.values[law.axis]) @ law.entries, 0.0)
            done = error_responses(track, self._column(k, i, law.balance), flow[:, None])
            errors.append(self.errors[k] - done.ravel())
            inputs = dict(s.inputs)
            for name, sign in _sides(i, law.balance):
                inputs[name] = sign * flow + inputs.get(name, 0.0)
            seen.append(s._replace(inputs=inputs))
            squares.append(np.mean(flow**2))
        size = float(np.hypot(np.sqrt(np.mean(squares)), self.sizes.get(i, 0.0)))
        sizes = {**self.sizes, **{name: size for name, _ in _sides(i, law.balance)}}
        return replace(self, seen=tuple(seen), errors=tuple(errors), sizes=sizes)

    def values(self, axis: str) -> list[dict[str, np.ndarray]]:
        """Variable -> values of an axis along each run."""
        return [s.values[axis] for s in self.seen]

    def told(self, i: Input, balance: str) -> list[np.ndarray]:
        """(n,) what is lacking along each run."""
        if balance != THROUGH:
            return [s.inputs[i] for s in self.seen]
        rod = Input("flow_rod", i.axis)
        return [0.5 * (s.inputs[rod] - s.inputs[i]) for s in self.seen]

    def regressed(self, case: Case) -> Regression:
        """Regression of a table in the place of an unknown input."""
        i, balance, table = case
        parts = []
        for k, (track, s) in enumerate(zip(self.judged.tracks, self.seen, strict=True)):
            shares = np.where(s.known[:, None], table.columns(s.values[i.axis]), 0.0)
            parts.append((track, self.errors[k], self._column(k, i, balance), shares))
        return regression(table, parts, self.sizes[i])

    def tried(self, cases: Sequence[Case]) -> list[tuple[Case, Regression]]:
        """Cases with their regressions."""
        return list(zip(cases, self.evidence.map(self.regressed, cases), strict=True))

    def grounds(self, at: tuple[Input, str]) -> list[Ground]:
        """What glances at laws in a place need of each run."""
        told, parts = self.told(*at), parts_left_out(len(self.seen))

        def one(k: int) -> Ground:
            column = self.sizes[at[0]] * self._column(k, *at)
            track, known = self.judged.tracks[k], self.seen[k].known
            return ground(track, self.errors[k], column, told[k], known, parts)

        return self.evidence.map(one, range(len(self.seen)))

    def law(self, case: Case, found: Regression, known: Hypothesis | None = None) -> Learned:
        """A law of a regression; `known` is the hypothesis that it replaces."""
        return learned_law(self.evidence.data.machine, case, found, self.seen, known)

    def _column(self, run: int, i: Input, balance: str) -> np.ndarray:
        """(n, nz) what a unit of an addition does to the states of a run."""
        track, names = self.judged.tracks[run], [name for name, _ in _sides(i, balance)]
        there = list(track.levels.inputs)
        if set(names) <= set(there):
            columns = track.columns[:, [there.index(n) for n in names]]
        else:
            machine = self.judged.guess.machine(self.evidence.data.machine, track.run.name)
            columns = columns_of(machine, track, names)
        return columns[:, 1] - columns[:, 0] if balance == THROUGH else columns[:, 0]


def _sides(i: Input, balance: str) -> list[tuple[Input, float]]:
    """The unknown inputs in whose places a law is, and with which sign."""
    return [(i, -1.0), (Input("flow_rod", i.axis), 1.0)] if balance == THROUGH else [(i, 1.0)]


def candidate_laws(lacks: Lacks, laws: Sequence[Learned], hopeless: set[tuple[str, str]]) -> list[list[Learned]]:
    """Laws worth a trial for the largest lacks: those that predict best, then of other balances."""
    machine, levels = lacks.evidence.data.machine, lacks.judged.tracks[0].levels
    order = np.argsort(-levels.sizes / input_sizes(machine, levels.inputs))
    taken = {law.kind for law in laws}
    looked = []
    for rank, k in enumerate(order[:_LARGEST]):
        i = levels.inputs[int(k)]
        looked += possible_laws(lacks, (i, i.balance), rank < _COUPLED, taken)
        if i.balance == "flow_head" and Input("flow_rod", i.axis) in levels.inputs:
            looked += possible_laws(lacks, (i, THROUGH), rank < _COUPLED, taken)
    ranked, pump = _best_first(looked), []
    if not any(balance == SUPPLY for balance, _ in hopeless):
        found = (_pump_laws(lacks, name) for name in _limited_pumps(lacks))
        pump = [law for laws in found for law in laws[:_PUMP_LAWS]]
    best = ranked[:_TRIED] + pump
    for size in (1, 2):  # what one remembers may be chance
        plain = [p for p in ranked if not p[0][2].memory and len(p[0][2].variables) == size][:1]
        best += [pair for pair in plain if pair not in best]
    where = {(case[1], case[0].axis) for case, _ in best}
    groups = [best] if best else []
    for case, answer in ranked:
        if (case[1], case[0].axis) not in where and len(groups) <= _OTHERS:
            where.add((case[1], case[0].axis))
            groups.append([(case, answer)])
    return [[lacks.law(case, answer) for case, answer in group] for group in groups]


def possible_laws(
    lacks: Lacks, at: tuple[Input, str], coupled: bool = True, taken: Collection[tuple] = ()
) -> list[tuple[Case, Regression]]:
    """Every form that a law can have in the place of an unknown input, if it may do.

    Args:
        lacks: what is lacking.
        at: the input and the balance.
        coupled: whether variables of other drives are paired, and memories are tried.
        taken: kinds of laws that are there already.
    """
    (i, balance), looked = at, []
    told = [(_clock(s), s.known, t) for s, t in zip(lacks.seen, lacks.told(i, i.balance), strict=True)]
    window, whole = busy_window(told, _LOUD), busy_window(told)
    values, speed = lacks.values(i.axis), _smoothing(lacks.evidence.data.machine, i.axis)

    def tried(tables: Sequence[Table]) -> list[tuple[Case, Regression]]:
        open_ones = [t for t in tables if (balance, i.axis, *t.kind) not in taken]
        return lacks.tried([(*at, table) for table in open_ones])

    grounds = lacks.grounds(at)

    def glances(tables: Sequence[Table]) -> list[np.ndarray]:
        def one(table: Table) -> np.ndarray:
            return at_a_glance(table, list(zip(grounds, values, strict=True)))

        return lacks.evidence.map(one, tables)

    def likely(tables: Sequence[Table], most: int) -> list[tuple[float, Table]]:
        found = zip([float(falls.sum()) for falls in glances(tables)], tables, strict=True)
        return sorted(found, key=lambda pair: -pair[0])[:most]

    for span in ((), window) if window else ((),):
        every = possible_tables(values, speed, span)
        names = [table.variables[0] for table in every]
        single = likely(every, _SINGLES)
        pairs = likely(paired_tables(values, speed, coupled, span), _PAIRS)
        plain = [table for _, table in (*single, *pairs)]
        inside = tried(plain)
        if coupled and not span and plain:
            few = plain[: len(single)], plain[len(single) :][:_REMEMBERED]
            least = max(fall for fall, _ in (*single, *pairs)) + ENTER
            inside += tried(_remembered(values, names, *few, glances, least))
        best = max(inside, key=lambda pair: pair[1].predicted, default=None)
        if best and best[0][2].memory:
            inside += tried(finer_memories(best[0][2], _FINER[-1]))
        if span and best and best[1].predicted > ENTER:
            ends = {*_moved_windows(window), *_moved_windows(whole)}
            moved = tried([best[0][2]._replace(window=w) for w in ends])
            inside = [pair for pair in inside if pair is not best] + [_shortest(moved)]
        looked += inside
    return looked


def _remembered(
    values: Sequence[Mapping[str, np.ndarray]], names: Sequence[str], single: Sequence[Table],
    pairs: Sequence[Table], glances: Callable[[Sequence[Table]], list[np.ndarray]], least: float,
) -> list[Table]:  # fmt: skip
    """The likeliest laws with a memory: tables that may do, with what each could remember.

    Those of a kind that predicts less than `least`, where runs that are left out choose nothing of
    what is remembered, are none.
    """
    tables = [t for table in [*single, *pairs]
              for t in remembering_tables(table, values, table.variables)]  # fmt: skip
    for table in single[:_REMEMBERED]:
        rest = [name for name in names if name not in table.variables]
        tables += remembering_tables(table, values, rest)

    looked: dict[tuple, list[tuple[np.ndarray, Table]]] = {}

    def best(some: Sequence[Table]) -> tuple[float, Table]:
        found = list(zip(glances(some), some, strict=True))
        for falls, table in found:
            looked.setdefault(table.kind, []).append((falls, table))
        falls, table = max(found, key=lambda pair: pair[0].sum())
        return float(falls.sum()), table

    if not tables:
        return []
    best(tables)
    first = [max(kind, key=lambda pair: pair[0].sum()) for kind in looked.values()]
    whole = (len(values), -1) if len(values) > 1 else (-1, 1)  # runs, or parts of a single one
    found = []
    for falls, table in sorted(first, key=lambda pair: -pair[0].sum())[:_MEMORIES]:
        share = float(falls.sum())
        for step in chain.from_iterable([step] * _MOVED for step in _FINER):
            moved = best(finer_memories(table, step))
            share, table = moved if moved[0] > share else (share, table)
        own = [falls.reshape(whole).sum(axis=1) for falls, _ in looked[table.kind]]
        if predicted_by_choice(own) > least:
            found.append(table)
    return found


def _best_first(looked: Sequence[tuple[Case, Regression]]) -> list[tuple[Case, Regression]]:
    """The best of each kind that is worth its entries, by what it predicts; what is plain first."""
    most = max((answer.predicted for _, answer in looked), default=0.0)
    best: dict[tuple, tuple[Case, Regression]] = {}
    for case, answer in looked:
        kind = case[1], case[0].axis, *case[2].kind
        if answer.predicted > max(ENTER, best[kind][1].predicted if kind in best else 0.0):
            best[kind] = case, answer

    def place(pair: tuple[Case, Regression]) -> tuple[bool, float]:
        table = pair[0][2]
        plain = len(table.variables) == 1 and not table.memory
        plain = plain and pair[1].predicted >= _PLAINER * most
        return not plain, -pair[1].predicted

    return sorted(best.values(), key=place)


def _limited_pumps(lacks: Lacks) -> list[str]:
    """Return the pumps of valves whose flow is limited and to which no term adds.

    What a term of the flow lacks is an unknown input of the filter.
    """
    machine = lacks.judged.guess.machine(lacks.evidence.data.machine)
    known = {machine.pump_of(t.axis) for t in machine.terms if t.balance == SUPPLY}
    return [
        name for name, pump in machine.pumps.items()
        if pump.kind != "constant_pressure" and machine.axes_of_pump(name) and name not in known
    ]  # fmt: skip


def _pump_laws(lacks: Lacks, name: str) -> list[tuple[Case, Regression]]:
    """Return laws of what a pump lacks that valves share, best first."""
    evidence, judged, seen = lacks.evidence, lacks.judged, lacks.seen
    data = evidence.data
    machine = judged.guess.machine(data.machine)
    noise = judged.tracks[0].levels.noise
    told = evidence.map(lambda track: pump_lack(machine, data, track.run, noise, name), judged.tracks)
    rows = [s.known & np.isfinite(flow) for s, (flow, _) in zip(seen, told, strict=True)]
    own = Input(SUPPLY, machine.axes_of_pump(name)[0])
    used = [k for k, row in enumerate(rows) if np.count_nonzero(row) > _SHORT_ROWS]
    if not used:
        return []
    values = [seen[k].values[own.axis] for k in used]
    short = [(told[k][0][rows[k]], told[k][1][rows[k]]) for k in used]

    def tried(tables: Sequence[Table]) -> list[tuple[Case, Regression]]:
        def fitted(table: Table) -> tuple[Regression, float]:
            shares = [table.columns(v)[rows[k]] for k, v in zip(used, values, strict=True)]
            parts = [(*lack, share) for lack, share in zip(short, shares, strict=True)]
            return lack_regression(table, parts)

        found = zip(tables, evidence.map(fitted, tables), strict=True)
        return [((own, SUPPLY, t), fit) for t, (fit, share) in found if share > _PARTLY]

    speed = _smoothing(machine, own.axis)
    window = busy_window([(_clock(seen[k]), rows[k], told[k][0]) for k in used])
    windows = ((), window) if window else ((),)
    tables = [t for w in windows for t in possible_tables(values, speed, w)]
    tables += [t for w in windows for t in paired_tables(values, speed, True, w)]
    return _best_first(tried(tables))


def _moved_windows(window: tuple[float, ...]) -> list[tuple[float, float]]:
    """A window, and some whose ends are somewhat earlier or later."""
    begin, end = window
    return [(begin + a, end + b) for a in _MOVES for b in _MOVES if begin + a < end + b]


def _shortest(looked: Sequence[tuple[Case, Regression]]) -> tuple[Case, Regression]:
    """Of windows that predict about as much, the shortest one."""
    most = _AS_GOOD * max(answer.predicted for _, answer in looked)
    good = (pair for pair in looked if pair[1].predicted >= most)
    return min(good, key=lambda pair: pair[0][2].window[1] - pair[0][2].window[0])


def _clock(seen: Seen) -> np.ndarray:
    return next(iter(seen.values.values()))["time"]


def _smoothing(machine: Machine, axis: str) -> float:
    return machine.axes[axis].drive.friction.smoothing_velocity


def learned_law(
    machine: Machine, case: Case, found: Regression, seen: Sequence[Seen],
    known: Hypothesis | None = None,
) -> Learned:  # fmt: skip
    """A law of a regression; `known` is the hypothesis that it replaces."""
    i, balance, table = case
    values = [s.values[i.axis] for s in seen]
    everywhere = {v: np.concatenate([x[v] for x in values]) for v in values[0]}
    name = f"{LEARNED}_{balance}"
    sides = [(n.balance, sign) for n, sign in _sides(i, balance)]

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


_MOST = 3  # laws that are learned one after the other
_OTHER_FORMS = 4  # times that another form is looked for in a law's place
_AGAIN = 5  # times that a law is fitted again inside the machine
_STEPS = 3  # of Gauss-Newton for the numbers beside a law
_DETAIL = 0.05  # of what all laws brought: one that brings less is the last
_TRACE = 0.02  # of what all laws brought: where no more is lacking no further one is looked for
_AHEAD = 1.0  # s, of free runs that a law must make better; longer ones drift without readings
_FAR_AHEAD = 5.0  # s, of those that it must not make worse
_AT_NOISE = 1.1  # times the noise: errors of free runs that no further law is looked for
_LOSS = 0.1  # of what free runs gain by effects and laws that laws alone may lose
_LOST = 1.0e3  # times the noise: errors of a free run that got lost
_STEP = 2.0e-3  # s, for the fits


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

    `refused` more made free runs of the held-out run worse, and were taken back.
    Errors of these free runs are `ahead`, and `before` without the laws.
    """

    judged: Judged
    laws: tuple[Learned, ...]
    refused: int = 0
    ahead: OpenLoop = _NOT_RUN
    before: OpenLoop = _NOT_RUN

    def stands_for(self, other: "Discovery", allowed: float) -> bool:
        """Whether its laws tell the runs as well as another guess does that has effects, too.

        Free runs are told as well where a tenth of what the other one gains at most is lost (of the
        squares of RMS), and less than the noise or a hundredth.

        Args:
            other: with effects, and laws beside them.
            allowed: by how much it may be worse with all its laws cost, of -2 log likelihood.
        """
        costs = [d.judged.loss + sum(law.charge for law in d.laws) for d in (self, other)]
        bare, own, others = (np.square(a) for a in (self.before, self.ahead, other.ahead))
        gain = np.maximum(bare - others, 0.0)
        lost = own - others > np.minimum(_LOSS * gain, np.maximum(1.0, _LOSS**2 * gain))
        return bool(self.laws and not lost.any() and costs[0] <= costs[1] + allowed)


def discover(evidence: Evidence, judged: Judged, noise: np.ndarray) -> Discovery:
    """Learn laws of what a guess lacks, one after the other.

    The numbers of named effects stay as they are: a law is what remains after them, and must not
    take their place. Calibrated numbers may give way.

    Args:
        evidence: the runs.
        judged: the guess, judged with unknown inputs.
        noise: (c,) of the channels, the same for all guesses whose free runs are compared.

    Returns:
        The guess with the laws that are worth their parameters, as many of them as make free runs
        of the held-out run better.
    """
    begun = judged
    laws: list[Learned] = []
    named = [h.name != CALIBRATION for h in judged.guess.hypotheses]
    parts = judged.guess.parts
    held = [(h.held(d), np.zeros(0)) if n else (h, d) for n, (h, d) in zip(named, parts, strict=True)]
    prior = sum(h.prior(d) for n, (h, d) in zip(named, parts, strict=True) if n)
    judged = replace(judged, guess=Guess(tuple(held)), loss=judged.loss - prior)
    stages, begin = [judged], judged.loss
    ahead = open_loop(evidence, evidence.runs, judged, noise)
    hopeless: set[tuple[str, str]] = set()
    for _ in range(_MOST):
        evidence.set_base(judged)
        found = None
        for candidates in candidate_laws(Lacks.of(evidence, judged), laws, hopeless):
            tried = _best_law(evidence, judged, candidates, hopeless)
            now = open_loop(evidence, evidence.runs, tried[0], noise) if tried else ahead
            if tried and better_ahead(now, ahead):
                found, ahead = tried, now
                break
        if found is None:
            break
        fall = judged.loss - found[0].loss
        judged, law = found
        laws.append(law)
        stages.append(judged)
        left, brought = lacking(judged, evidence), begin - judged.loss
        done = max(ahead.rms, ahead.far) < _AT_NOISE or left < max(ENTER, _TRACE * brought)
        if done or fall < _DETAIL * brought:
            break
    good, last, first = _held_out(evidence, stages, noise)
    refused, laws = len(laws) - good, laws[:good]
    if not laws:
        return Discovery(begun, (), refused, first, first)
    judged = stages[good]
    found = judged.guess.parts
    own = [old if n else new for n, old, new in zip(named, parts, found, strict=False)]
    guess = Guess((*own, *found[len(parts) :]))
    judged = replace(judged, guess=guess, loss=judged.loss + prior)
    return Discovery(judged, tuple(laws), refused, last, first)


def relearned(evidence: Evidence, judged: Judged, noise: np.ndarray, laws: Sequence[Learned]) -> Discovery:
    """Laws that were learned beside other effects than a guess has, fitted again without these.

    Args:
        evidence: the runs.
        judged: the guess, without effects.
        noise: as of `discover`.
        laws: in the order in which they were learned.
    """
    stages, found = [judged], []
    for law in laws:
        evidence.set_base(stages[-1])
        now, fitted = _settled(evidence, stages[-1], _with_law(evidence, stages[-1], law), law)
        stages.append(now)
        found.append(fitted)
    good, last, first = _held_out(evidence, stages, noise)
    return Discovery(stages[good], tuple(found[:good]), len(found) - good, last, first)


def _held_out(evidence: Evidence, stages: Sequence[Judged], noise: np.ndarray) -> tuple[int, OpenLoop, OpenLoop]:
    """How many laws make free runs of the held-out run better, these with them, and without any."""
    runs = (evidence.data.heldout,)
    first = open_loop(evidence, runs, stages[0], noise)
    for good in range(len(stages) - 1, 0, -1):
        last = open_loop(evidence, runs, stages[good], noise)
        if better_ahead(last, first):
            return good, last, first
    return 0, first, first


def _best_law(
    evidence: Evidence, judged: Judged, candidates: Sequence[Learned],
    hopeless: set[tuple[str, str]],
) -> tuple[Judged, Learned] | None:  # fmt: skip
    """The best candidate that is worth its entries, looked for again inside the machine, judged.

    Balances and axes of those that make the guess worse become `hopeless`.
    """
    best: tuple[Judged, Learned] | None = None
    for law in candidates:
        now = _with_law(evidence, judged, law)
        if now.loss > judged.loss:
            hopeless.add((law.balance, law.axis))
        if judged.loss - now.loss > ENTER and (best is None or _cost(now, law) < _cost(*best)):
            best = now, law
    for _ in range(_OTHER_FORMS if best else 0):
        assert best
        best = _settled(evidence, judged, *best)
        other = _another_form(evidence, judged, *best)
        if other is None:
            break
        best = other
    evidence.set_base(judged)
    return best


def _cost(judged: Judged, law: Learned) -> float:
    return judged.loss + law.charge


def _settled(evidence: Evidence, judged: Judged, now: Judged, law: Learned) -> tuple[Judged, Learned]:
    """A law whose entries are fitted inside the machine, again and again, judged."""
    for _ in range(_AGAIN):
        again = _refitted(evidence, now, law)
        if again is None:
            break
        tried = _with_law(evidence, judged, again)
        if now.loss - tried.loss < ENTER:
            break
        now, law = tried, again
    return now, law


def _another_form(evidence: Evidence, judged: Judged, now: Judged, law: Learned) -> tuple[Judged, Learned] | None:
    """The form that predicts clearly more in a law's place, if it is better in the machine, too.

    As long as no law is there, an unknown input does much of what it should tell, and hides which
    form it has: most of all what a law remembers, and from where on.
    """
    evidence.set_base(now)
    lacks = Lacks.of(evidence, now).without(law)
    at = input_of(law.balance, law.axis), law.balance
    own = lacks.regressed((*at, law.table))
    case, answer = max(possible_laws(lacks, at), key=lambda pair: pair[1].predicted)
    if answer.predicted < own.predicted + ENTER:
        return None
    other = lacks.law(case, answer, law.hypothesis)
    tried = _with_law(evidence, judged, other)
    return (tried, other) if _cost(tried, other) < _cost(now, law) - ENTER else None


def _with_law(evidence: Evidence, judged: Judged, law: Learned) -> Judged:
    """A guess with a law more, its other numbers fitted anew."""
    guess = judged.guess.plus(law.hypothesis, np.zeros(0))
    if len(guess.deviation):
        kept = evidence.base_slopes(_STEP)
        if kept.shape[1] == len(guess.deviation):
            guess = evidence.fit(guess, 0.0, step=_STEP, kept=kept, steps=_STEPS).guess
    return evidence.judged(guess)


def _refitted(evidence: Evidence, judged: Judged, law: Learned) -> Learned | None:
    """A law with what the machine that has it still lacks in its form; None for nothing.

    Where its input is no longer needed, readings tell the entries far better than beside it: what
    they have wrong adds up then. That matters in free runs.
    """
    evidence.set_base(judged)
    lacks, case = Lacks.of(evidence, judged), (input_of(law.balance, law.axis), law.balance)
    if case[0] not in lacks.sizes:
        spread = float(np.sqrt(np.mean(np.diag(law.covariance))))
        lacks = replace(lacks, sizes={**lacks.sizes, case[0]: spread})
    more = lacks.regressed((*case, law.table))
    if more.predicted < ENTER:
        return None
    found = more._replace(entries=law.entries + more.entries)
    return lacks.law((*case, law.table), found, law.hypothesis)


def better_ahead(now: OpenLoop, before: OpenLoop) -> bool:
    """Whether free runs are better, none got lost and long ones are no worse."""
    short = np.isnan(now.usual) or (now.usual < before.usual and now.rms <= before.rms)
    return bool(short and (np.isnan(now.far) or now.far <= before.far))


def open_loop(evidence: Evidence, runs: Sequence[RunData], judged: Judged, noise: np.ndarray) -> OpenLoop:
    """Errors of free runs through some runs over all channels, in units of a noise (c,).

    A law is to make simulations better, not only predictions from one reading to the next.
    """

    def sizes(run: RunData) -> np.ndarray:
        machine = judged.guess.machine(evidence.data.machine, run.name)
        prepare = machine_runner(machine, evidence.data, _STEP)
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
