"""Laws of what no effect explains: located, estimated, fitted, and written into the machine.

The filter's unknown inputs (`prediction.inputs`) say which balance lacks something, where and when;
in their places laws of physical variables of the drive are tried (`law_shapes`): piecewise linear
in one of them, alone or with the sign of the motion or in proportion to the speed, or in two of
them. What predicts runs that it was not fitted to best (`law_regression`) is fitted once more,
inside the machine, and kept if it is worth its parameters. It is a term of the patched machine
(`hydrotele.terms`), which every simulator calculates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dataset.load import Dataset, RunData
from hydrotele.dynamics.integrate import place
from hydrotele.dynamics.model import X, model_space
from hydrotele.dynamics.supply import supply_of
from hydrotele.effects import Parameter
from hydrotele.gap.law_regression import Regression, regression
from hydrotele.gap.law_shapes import THROUGH, Shape, possible_shapes
from hydrotele.gap.pruning import ENTER
from hydrotele.gap.search import lacking
from hydrotele.gap.settling import loss_of
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine import Machine
from hydrotele.prediction.calibration import CALIBRATION
from hydrotele.prediction.evidence import Evidence, Judged
from hydrotele.prediction.free_run import free_run_errors, machine_runner
from hydrotele.prediction.hypothesis import Guess, Hypothesis
from hydrotele.prediction.inputs import Input, input_sizes, input_units
from hydrotele.prediction.levels import smoothed
from hydrotele.prediction.track import Track, following_model
from hydrotele.terms.facts import Term

LEARNED = "learned"
"""First part of the name of a hypothesis that holds a learned law."""
_MOST = 3  # laws that are learned one after the other
_LARGEST = 4  # unknown inputs in whose places laws are looked for
_TRIED = 2  # laws that are fitted inside the machine, of all that the regression finds
_STEPS = 3  # of Gauss-Newton for each
_DETAIL = 0.05  # of what all laws brought: one that brings less is the last
_AHEAD = 1.0  # s, of free runs that a law must make better; longer ones drift without readings
_STEP = 2.0e-3  # s, for the fits


@dataclass(frozen=True)
class Learned:
    """A law in the guess.

    Attributes:
        hypothesis: its coefficients as parameters.
        balance: force, flow_head, flow_rod, `THROUGH` or command.
        axis: of the drive.
        shape: its form.
        smoothing: of the sign of the velocity [m/s] or [rad/s].
        seen: variable -> values along the fit runs.
    """

    hypothesis: Hypothesis
    balance: str
    axis: str
    shape: Shape
    smoothing: float
    seen: Mapping[str, np.ndarray] = field(repr=False)


@dataclass(frozen=True)
class Discovery:
    """The guess with its learned laws, judged, and these laws.

    `refused` of them made free runs of the held-out run worse and were taken back.
    """

    judged: Judged
    laws: tuple[Learned, ...]
    refused: int = 0


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
        found = _best_law(evidence, judged, _candidates(evidence, judged, seen, laws))
        if found is None:
            break
        now = _open_loop(evidence, evidence.runs, found[0], noise)
        if not _better(now, ahead):
            break
        ahead, fall = now, judged.loss - found[0].loss
        judged, law = found
        laws.append(law)
        if fall < _DETAIL * (begin - judged.loss) or lacking(judged, evidence) < ENTER:
            break
    if laws and not _better(*(_open_loop(evidence, heldout, j, noise) for j in (judged, bare))):
        return Discovery(begun, (), len(laws))
    found = judged.guess.parts
    own = [old if n else new for n, old, new in zip(named, parts, found, strict=False)]
    guess = Guess((*own, *found[len(parts) :]))
    return Discovery(replace(judged, guess=guess, loss=judged.loss + prior), tuple(laws))


def _best_law(
    evidence: Evidence, judged: Judged, candidates: Sequence[tuple[Learned, np.ndarray]]
) -> tuple[Judged, Learned] | None:
    """The candidate that fits the readings best and is worth its parameters, judged."""
    kept = evidence.base_slopes(_STEP)
    before = loss_of(evidence, judged.guess, _STEP)
    fits = []
    for law, start in candidates:
        guess = judged.guess.plus(law.hypothesis, start)
        fits.append((evidence.fit(guess, before, step=_STEP, kept=kept, steps=_STEPS), law))
    for fit, law in sorted(fits, key=lambda pair: -pair[0].score):
        if fit.score <= 0.0:
            break
        now = evidence.judged(fit.guess)
        if judged.loss - now.loss - fit.charge > ENTER:
            return now, law
    return None


def _better(now: tuple[float, float], before: tuple[float, float]) -> bool:
    """Whether free runs are better and none got lost; true where there are none."""
    return bool(np.isnan(now[0]) or (now[0] < before[0] and now[1] <= before[1]))


def _open_loop(
    evidence: Evidence, runs: Sequence[RunData], judged: Judged, noise: np.ndarray
) -> tuple[float, float]:
    """RMS errors of free runs through some runs over all channels, in units of a noise (c,).

    A law is to make simulations better, not only predictions from one reading to the next. First by
    the median window of each channel, as one that diverges says nothing of the others; then by the
    mean square of all, as a law must not make any diverge. NaN where all runs are shorter than a
    window.
    """
    prepare = machine_runner(judged.guess.machine(evidence.data.machine), evidence.data, _STEP)

    def sizes(run: RunData) -> np.ndarray:
        errors = free_run_errors(prepare(run), run, (_AHEAD,), to_end=False)
        table = [(h.median / noise, h.rms / noise) for h in errors.horizons.values()]
        return np.reshape(table, (-1, 2, len(noise)))

    found = np.concatenate(evidence.map(sizes, runs))
    if not len(found) or np.isnan(found).all():
        return np.nan, np.nan
    median, whole = np.sqrt(np.nanmean(found**2, axis=(0, 2)))
    return float(median), float(whole)


class _Seen(NamedTuple):
    """A run by what its smoother says: variables of every axis, and the rows that are known."""

    values: dict[str, dict[str, np.ndarray]]
    known: np.ndarray


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
    values = {}
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
    known = np.isfinite(states.sum(axis=1))
    known[: min(round(0.5 / track.run.period), len(states) // 4)] = False
    if track.run.valid is not None:
        known &= track.run.valid
    return _Seen(values, known)


def _candidates(
    evidence: Evidence, judged: Judged, seen: Sequence[_Seen], laws: Sequence[Learned]
) -> list[tuple[Learned, np.ndarray]]:
    """Laws worth a fit, with the deviations from which to fit them, for the largest lacks."""
    machine, levels = evidence.data.machine, judged.tracks[0].levels
    order = np.argsort(-levels.sizes / input_sizes(machine, levels.inputs))
    taken = {(law.balance, law.axis, law.shape.kind) for law in laws}
    cases = []
    for k in order[:_LARGEST]:
        i = levels.inputs[int(k)]
        balances = [i.balance]
        if i.balance == "flow_head" and Input("flow_rod", i.axis) in levels.inputs:
            balances.append(THROUGH)
        speed = _smoothing(machine, i.axis)
        for balance in balances:
            values = [s.values[i.axis] for s in seen]
            cases += [
                (i, balance, shape) for shape in possible_shapes(balance, values, speed)
                if (balance, i.axis, shape.kind) not in taken
            ]  # fmt: skip

    def look(case: tuple[Input, str, Shape]) -> Regression:
        i, balance, shape = case
        size = float(levels.sizes[levels.inputs.index(i)])
        parts = []
        for track, s in zip(judged.tracks, seen, strict=True):
            column = track.columns[:, levels.inputs.index(i)]
            if balance == THROUGH:
                column = track.columns[:, levels.inputs.index(Input("flow_rod", i.axis))] - column
            products = shape.columns(s.values[i.axis], _smoothing(machine, i.axis))
            parts.append((track, column, np.where(s.known[:, None], products, 0.0)))
        return regression(parts, size)

    looked = list(zip(cases, evidence.map(look, cases), strict=True))
    looked = [pair for pair in looked if pair[1].predicted > ENTER]
    looked.sort(key=lambda pair: -pair[1].predicted)
    known, found = {law.hypothesis.key for law in laws}, []
    for case, answer in looked:  # what the chosen products leave may be known already
        law, start = _law(machine, case, answer, seen)
        if law.hypothesis.key not in known:
            known.add(law.hypothesis.key)
            found.append((law, start))
        if len(found) == _TRIED:
            break
    return found


def _smoothing(machine: Machine, axis: str) -> float:
    return machine.axes[axis].drive.friction.smoothing_velocity


def _law(
    machine: Machine, case: tuple[Input, str, Shape], found: Regression, seen: Sequence[_Seen]
) -> tuple[Learned, np.ndarray]:
    """A law of the products that are worth it, with the regression's coefficients as start."""
    i, balance, shape = case
    shape = shape.with_products(found.chosen)
    (unit,) = input_units(machine, [i])
    parameters = {
        product: Parameter(f"{unit} / [{product}]" if product != "1" else unit, 0.0, -50.0 * s,
                           50.0 * s, float(s), 0.0)
        for product, s in zip(shape.products, found.scale, strict=True)
    }  # fmt: skip
    values = [s.values[i.axis] for s in seen]
    everywhere = {v: np.concatenate([x[v] for x in values]) for v in values[0]}
    domain = {v: (float(everywhere[v].min()), float(everywhere[v].max()))
              for v in shape.variables if np.ptp(everywhere[v]) > 0.0}  # fmt: skip
    name = f"{LEARNED}_{balance}"

    def change(nominal: Machine, coefficients: Mapping[str, float]) -> Machine:
        terms = list(nominal.terms)
        sides = (
            (("flow_head", -1.0), ("flow_rod", 1.0)) if balance == THROUGH else ((balance, 1.0),)
        )
        taken = {term.name for term in terms if term.axis == i.axis}
        own = next(n for n in chain([name], (f"{name}_{k}" for k in count(2))) if n not in taken)
        for side, sign in sides:
            terms.append(Term.model_validate({
                "name": own, "axis": i.axis, "balance": side, "law": "formula",
                "parameters": {p: sign * value for p, value in coefficients.items()},
                "domain": domain, "uncertainty": found.left,
                "description": f"learned from data: {balance} over {shape.name}",
            }))  # fmt: skip
        return nominal.model_copy(update={"terms": tuple(terms)})

    hypothesis = Hypothesis(name, f"{i.axis}.{shape.name}", parameters, change)
    law = Learned(hypothesis, balance, i.axis, shape, _smoothing(machine, i.axis), everywhere)
    return law, found.deviation
