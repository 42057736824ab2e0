"""Laws of what no effect explains: located, estimated, fitted, and written into the machine.

The filter's unknown inputs (`prediction.inputs`) say which balance lacks something, where and when;
a smoother reads them back. Each is regressed on physical variables of its drive: piecewise linear
in one of them, alone or with the sign of the motion or in proportion to the speed. What predicts
runs that it was not fitted to is fitted once more, inside the machine, to the readings themselves,
and kept if it is worth its parameters. It is a term of the patched machine (`hydrotele.terms`),
which every simulator calculates.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.dynamics.integrate import place
from hydrotele.dynamics.model import X, model_space, reduced_model
from hydrotele.effects import Parameter
from hydrotele.gap.search import ENTER, lacking
from hydrotele.hydraulics.parameters import actuator_order
from hydrotele.machine import Machine
from hydrotele.prediction.evidence import Evidence, Judged, charge
from hydrotele.prediction.hypothesis import Hypothesis
from hydrotele.prediction.inputs import Input, input_sizes, input_units
from hydrotele.prediction.levels import smoothed, smoothed_inputs
from hydrotele.prediction.track import Track
from hydrotele.terms.facts import Term

LEARNED = "learned"
"""First part of the name of a hypothesis that holds a learned law."""
THROUGH = "flow_through"
"""Balance of a flow from the head side to the rod side."""
_MOST = 3  # laws that are learned one after the other
_KNOTS = 5  # inner kinks of a law
_TRIED = 3  # laws that are fitted inside the machine for a balance
_LEAST_R2 = 0.1  # of an input, predicted for runs that were not fitted, for a law to be tried
_KEEP = 6.0  # fall of BIC that a kink must bring
_STEP = 2.0e-3  # s, for the fits
_VARIABLES: Mapping[str, tuple[str, ...]] = {
    "force": ("velocity", "position", "command", "force", "time"),
    "flow_head": ("pressure_head - pressure_rod", "pressure_head", "spool", "velocity", "position"),
    "flow_rod": ("pressure_head - pressure_rod", "pressure_rod", "spool", "velocity", "position"),
    THROUGH: ("pressure_head - pressure_rod", "position", "spool", "velocity", "time"),
    "command": ("command", "spool", "velocity", "position", "force", "time"),
}


class Shape(NamedTuple):
    """A form that a law can have: a piecewise linear function of a variable times a factor.

    Attributes:
        variable: a variable of `DriveState`, or a difference of two.
        factor: what it is multiplied by: empty, `sign(velocity, v0)` or `velocity`.
        knots: where it kinks.
    """

    variable: str
    factor: str
    knots: tuple[float, ...]

    @property
    def products(self) -> list[str]:
        """The products of basic functions, one per coefficient, as `terms.formula` reads them."""
        line = f"({self.variable})" if " - " in self.variable else self.variable
        found = ["1", line]
        found += [f"above({self.variable}, {_number(k)})" for k in self.knots]
        if not self.factor:
            return found
        return [self.factor if p == "1" else f"{p} * {self.factor}" for p in found]

    def columns(self, values: Mapping[str, np.ndarray], smoothing: float) -> np.ndarray:
        """(n, K) the products along data."""
        a, _, b = self.variable.partition(" - ")
        x = values[a] - values[b] if b else values[a]
        found = [np.ones_like(x), x, *(np.maximum(0.0, x - k) for k in self.knots)]
        factor = np.ones_like(x)
        if self.factor.startswith("sign"):
            factor = np.tanh(values["velocity"] / smoothing)
        elif self.factor:
            factor = values[self.factor]
        return np.column_stack(found) * factor[:, None]


def _number(value: float) -> str:
    return f"{value:.6g}"


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
    """The guess with its learned laws, judged, and these laws."""

    judged: Judged
    laws: tuple[Learned, ...]


def discover(evidence: Evidence, judged: Judged) -> Discovery:
    """Learn laws of what a guess lacks, one after the other.

    Args:
        evidence: the runs.
        judged: the guess, judged with unknown inputs.

    Returns:
        The guess with the laws that are worth their parameters.
    """
    laws: list[Learned] = []
    best: tuple[Judged, Learned] | None
    for _ in range(_MOST):
        evidence.set_base(judged)
        seen = [_see(evidence.data.machine, judged, track) for track in judged.tracks]
        best = None
        for law, start in _candidates(evidence.data.machine, judged, seen, laws):
            guess = judged.guess.plus(law.hypothesis, start)
            kept = evidence.base_slopes(_STEP)
            fit = evidence.fit(guess, 0.0, step=_STEP, kept=kept, steps=3)
            now = evidence.judged(fit.guess)
            score = judged.loss - now.loss - charge(fit.information, law.hypothesis.size)
            if score > ENTER and (best is None or now.loss < best[0].loss):
                best = now, law
        if best is None:
            break
        judged, law = best
        laws.append(law)
        if lacking(judged, evidence) < ENTER:
            break
    return Discovery(judged, tuple(laws))


class _Seen(NamedTuple):
    """A run by what its smoother says: variables of every axis, and inputs with what is known."""

    values: dict[str, dict[str, np.ndarray]]
    inputs: dict[Input, np.ndarray]
    known: dict[Input, np.ndarray]


@compiled
def _drives_of(model, sp, states, position, velocity):
    """Positions and velocities (n, nu) of the drives along states (n, nz)."""
    n, t = len(model.mech.free), len(model.transmission)
    for row in range(len(states)):
        place(model, sp, states[row])
        for i in range(len(model.gear)):
            position[row, i] = sp.drive[X, i]
            total = 0.0
            for f in range(n):
                total += sp.row[i, f] * states[row, n + t + f]
            velocity[row, i] = total


def _see(nominal: Machine, judged: Judged, track: Track) -> _Seen:
    machine = judged.guess.machine(nominal)
    size = track.states.shape[1]
    run, told = smoothed(track)
    states = track.states - run.correction[:, :size] + told.deviation[:, :size]
    inputs = smoothed_inputs(track, (run, told))
    model = reduced_model(machine, ())
    order = actuator_order(machine)
    position, velocity = np.empty((len(states), len(order))), np.empty((len(states), len(order)))
    _drives_of(model, model_space(model), np.ascontiguousarray(states), position, velocity)
    first = 2 * (len(model.mech.free) + len(model.transmission))
    clock = track.run.start + track.run.period * np.arange(len(states))
    values = {}
    for i, axis in enumerate(order):
        own = {"time": clock, "position": position[:, i], "velocity": velocity[:, i],
               "command": track.run.command[:, i]}  # fmt: skip
        facts = machine.axes[axis]
        if facts.hydraulic:
            head, rod = states[:, first + 4 * i + 2], states[:, first + 4 * i + 3]
            areas = facts.hydraulic_drive.areas
            own |= {"spool": states[:, first + 4 * i], "pressure_head": head, "pressure_rod": rod,
                    "force": areas[0] * head - areas[1] * rod}  # fmt: skip
        elif facts.force:
            own["force"] = facts.force.gain * own["command"]
        values[axis] = own
    known = {}
    settle = min(round(0.5 / track.run.period), len(states) // 4)
    for k, i in enumerate(track.levels.inputs):
        flag = np.ones(len(states), bool)
        flag[:settle] = False
        if track.run.valid is not None:
            flag &= track.run.valid
        known[i] = flag & np.isfinite(states).all(axis=1)
        inputs[~known[i], k] = 0.0
    return _Seen(values, {i: inputs[:, k] for k, i in enumerate(track.levels.inputs)}, known)


def _candidates(
    machine: Machine, judged: Judged, seen: Sequence[_Seen], laws: Sequence[Learned]
) -> list[tuple[Learned, np.ndarray]]:
    """Laws worth a fit, with the deviations from which to fit them, for the largest lacks."""
    levels = judged.tracks[0].levels
    largest = input_sizes(machine, levels.inputs)
    order = np.argsort(-levels.sizes / largest)
    taken = {(law.balance, law.axis, law.shape.variable, law.shape.factor) for law in laws}
    rated = []
    for k in order[:4]:
        i = levels.inputs[int(k)]
        targets: dict[str, list[np.ndarray]] = {i.balance: [s.inputs[i][s.known[i]] for s in seen]}
        other = Input("flow_rod", i.axis)
        if i.balance == "flow_head" and other in levels.inputs:
            targets[THROUGH] = [0.5 * (s.inputs[other] - s.inputs[i])[s.known[i]] for s in seen]
        for balance, target in targets.items():
            power = sum(float(t @ t) for t in target)
            if power == 0.0:
                continue
            part = float((levels.sizes / largest)[k])
            for shape in _shapes(machine, i, balance, seen):
                if (balance, i.axis, shape.variable, shape.factor) in taken:
                    continue
                columns = [
                    shape.columns({n: v[s.known[i]] for n, v in s.values[i.axis].items()},
                                  _smoothing(machine, i.axis))
                    for s in seen
                ]  # fmt: skip
                share = _predicted_share(columns, target)
                if share > _LEAST_R2:
                    rated.append((share * part, balance, i, shape, columns, target))
    rated.sort(key=lambda entry: -entry[0])
    return [_law(machine, balance, i, shape, columns, target, seen)
            for _, balance, i, shape, columns, target in rated[:_TRIED]]  # fmt: skip


def _smoothing(machine: Machine, axis: str) -> float:
    return machine.axes[axis].drive.friction.smoothing_velocity


def _shapes(machine: Machine, i: Input, balance: str, seen: Sequence[_Seen]) -> list[Shape]:
    found = []
    values = [s.values[i.axis] for s in seen]
    sign = f"sign(velocity, {_number(_smoothing(machine, i.axis))})"
    for variable in _VARIABLES[balance]:
        a, _, b = variable.partition(" - ")
        if a not in values[0] or (b and b not in values[0]):
            continue
        x = np.concatenate([v[a] - v[b] if b else v[a] for v in values])
        x = x[np.isfinite(x)]
        if len(x) < 10 * _KNOTS or np.ptp(x) == 0.0:
            continue
        span = np.quantile(x, [0.02, 0.98])
        edges = np.quantile(x, np.linspace(0.02, 0.98, _KNOTS + 2)[1:-1])
        even = np.linspace(*span, _KNOTS + 2)[1:-1]
        knots = tuple(sorted({float(_number(k)) for k in 0.5 * (edges + even)}))
        factors = ["", sign, "velocity"]
        if variable == "velocity":
            factors = [""]
            knots = tuple(sorted({*knots, 0.0}))
        if balance == "command":
            factors = [""]
        found += [Shape(variable, factor, knots) for factor in factors]
    return found


def _predicted_share(columns: Sequence[np.ndarray], target: Sequence[np.ndarray]) -> float:
    """Share of the target's square that a fit to the other runs predicts, over all runs.

    A single run is taken in four parts.
    """
    if len(columns) == 1:
        cuts = np.array_split(np.arange(len(target[0])), 4)
        columns, target = [columns[0][c] for c in cuts], [target[0][c] for c in cuts]
    whole = left = 0.0
    for out in range(len(columns)):
        a = np.concatenate([c for k, c in enumerate(columns) if k != out])
        b = np.concatenate([t for k, t in enumerate(target) if k != out])
        coefficients = _ridge(a, b)
        miss = target[out] - columns[out] @ coefficients
        whole += float(target[out] @ target[out])
        left += float(miss @ miss)
    return 1.0 - left / whole if whole > 0 else 0.0


def _ridge(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    size = np.sqrt((a**2).mean(axis=0)) + 1e-300
    scaled = a / size
    normal = scaled.T @ scaled + 1e-4 * len(b) * np.eye(a.shape[1])
    return np.linalg.solve(normal, scaled.T @ b) / size


def _law(
    machine: Machine, balance: str, i: Input, shape: Shape, columns: Sequence[np.ndarray],
    target: Sequence[np.ndarray], seen: Sequence[_Seen],
) -> tuple[Learned, np.ndarray]:  # fmt: skip
    """A sparse law with the coefficients of the regression as start."""
    a, b = np.concatenate(columns), np.concatenate(target)
    keep = _sparse(a, b, shape)
    shape = shape._replace(
        knots=tuple(k for k, kept in zip(shape.knots, keep, strict=True) if kept)
    )
    a = a[:, [True, True, *keep]]
    coefficients = _ridge(a, b)
    rms = np.sqrt((a**2).mean(axis=0)) + 1e-300
    scales = np.maximum(3.0 * np.abs(coefficients), float(np.std(b)) / rms)
    (unit,) = input_units(machine, [i])
    parameters = {
        product: Parameter(f"{unit} / [{product}]" if product != "1" else unit, 0.0, -50.0 * s,
                           50.0 * s, float(s), 0.0)
        for product, s in zip(shape.products, scales, strict=True)
    }  # fmt: skip
    values = [s.values[i.axis] for s in seen]
    variables = [v for v in shape.variable.split(" - ")]
    everywhere = {v: np.concatenate([x[v] for x in values]) for v in values[0]}
    domain = {v: (float(everywhere[v].min()), float(everywhere[v].max())) for v in variables
              if np.ptp(everywhere[v]) > 0.0}  # fmt: skip
    uncertainty = float(np.std(b - a @ coefficients))
    name = f"{LEARNED}_{balance}"

    def change(nominal: Machine, found: Mapping[str, float]) -> Machine:
        terms = list(nominal.terms)
        sides = (
            (("flow_head", -1.0), ("flow_rod", 1.0)) if balance == THROUGH else ((balance, 1.0),)
        )
        for side, sign in sides:
            terms.append(Term(
                name=name, axis=i.axis, balance=side, law="formula",
                parameters={p: sign * value for p, value in found.items()}, domain=domain,
                uncertainty=uncertainty,
                description=f"learned from data: {balance} over {shape.variable}",
            ))  # fmt: skip
        return nominal.model_copy(update={"terms": tuple(terms)})

    location = f"{i.axis}.{shape.variable.replace(' ', '')}"
    hypothesis = Hypothesis(name, location, parameters, change)
    law = Learned(hypothesis, balance, i.axis, shape, _smoothing(machine, i.axis), everywhere)
    return law, coefficients / scales


def _sparse(a: np.ndarray, b: np.ndarray, shape: Shape) -> list[bool]:
    """Which kinks are worth a coefficient, by BIC with one witness per twenty rows."""
    keep = [True] * len(shape.knots)
    witnesses = max(len(b) / 20.0, 10.0)

    def loss(chosen: Sequence[bool]) -> float:
        part = a[:, [True, True, *chosen]]
        miss = b - part @ _ridge(part, b)
        return witnesses * math.log(float(miss @ miss) + 1e-300)

    now = loss(keep)
    while sum(keep) > 1:
        tried = {}
        for k in np.flatnonzero(keep):
            fewer = [x and j != k for j, x in enumerate(keep)]
            tried[int(k)] = loss(fewer)
        worst = min(tried, key=tried.__getitem__)
        if tried[worst] > now + _KEEP:
            break
        keep[worst], now = False, tried[worst]
    return keep
