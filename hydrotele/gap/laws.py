"""Learned laws and profiles as groups of columns of the regression.

A group adds `sum_k c_k B_k(x) phi(state)` to a balance of one drive, with hat functions B_k of one variable x or
products of hat functions of two. A learned law has phi = 1. A profile has the form phi of a library effect, whose
coefficient then varies with x: friction that is larger at one position, leakage in the worn middle of a stroke. The
coefficients c have a smooth normal prior, so that the evidence decides how many of them count.

The columns follow from the linearised filter: the change of the states per row that a unit of the balance makes, times
the hat functions. The corrected machine states a group as a term (`hydrotele.terms`).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import chain, count
from typing import Any, NamedTuple

import numpy as np

from hydrotele.effects import EFFECTS
from hydrotele.effects.effect import Parameter
from hydrotele.estimate.evidence import Evidence, Judged
from hydrotele.estimate.filter import Input, _rows_later, input_sizes
from hydrotele.estimate.hypothesis import LEARNED, Hypothesis
from hydrotele.estimate.reduced_model import model_space, reduced_model
from hydrotele.estimate.track import STEP, Track, error_responses, steps_per_row
from hydrotele.gap.description import variable_unit
from hydrotele.gap.law_tables import OWN_VARIABLES, THROUGH, Learned, Table
from hydrotele.gap.regression import compare_groups
from hydrotele.gap.result import VARIES, Estimate, NamedEffect, Profile
from hydrotele.gap.run_variables import Seen, see_run
from hydrotele.logs.dataset import Dataset
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

_KNOTS = {1: 17, 2: 9}  # of a table over one variable, and of each of two
_LENGTHS = {1: (0.12, 0.4), 2: (0.2, 0.5)}
"""Number of variables -> correlation lengths of the prior of the coefficients, as fractions of the range of a variable.
The evidence selects one. Two lengths of the table's steps hold in the shorter one, so that a smooth law is well met."""
_SIZES = (0.1, 1.0, 10.0)  # prior standard deviations, in typical sizes; the evidence selects one
_TYPICAL = 0.01  # of the largest force, flow or command: the size at which residual inputs start, too
_WIDEST = 100.0  # prior standard deviations; no bound
_NORMAL95 = 1.96
_ROUNDING = {1: 1e-6, 2: 1e-3}  # of the largest eigenvalue of a prior: errors of a law of 0.1 %, and of 3 % over two


class Form(NamedTuple):
    """The law of a library effect: balance, parameter, sign and function.

    Attributes:
        balance: to which it adds.
        parameter: the effect's coefficient.
        sign: of the coefficient in the balance.
        product: for the law `scaled_table`, with the constants `v0` and `d`.
        along: (variables, constants) -> (n,) values.
    """

    balance: str
    parameter: str
    sign: float
    product: str
    along: Callable[[Mapping[str, np.ndarray], Mapping[str, float]], np.ndarray]


def _root(x: np.ndarray, d: float) -> np.ndarray:
    return x / np.sqrt(np.sqrt(x**2 + d**2))


FORMS: Mapping[str, Form] = {
    "coulomb_friction": Form(
        "force", "coulomb", -1.0, "sign(velocity, {v0!r})", lambda s, c: np.tanh(s["velocity"] / c["v0"])
    ),
    "viscous_friction": Form("force", "viscous", -1.0, "velocity", lambda s, c: s["velocity"]),
    "load_dependent_friction": Form(
        "force", "coefficient", -1.0, "abs(force) * sign(velocity, {v0!r})",
        lambda s, c: abs(s["force"]) * np.tanh(s["velocity"] / c["v0"]),
    ),
    "internal_leakage": Form(
        THROUGH, "leakage", 1.0, "pressure_head - pressure_rod", lambda s, c: s["pressure_head"] - s["pressure_rod"]
    ),
    "orifice_leakage": Form(
        THROUGH, "flow", 1.0, "root(pressure_head - pressure_rod, {d!r})",
        lambda s, c: _root(s["pressure_head"] - s["pressure_rod"], c["d"]),
    ),
    "valve_gain": Form("command", "ratio", 1.0, "command", lambda s, c: s["command"]),
}  # fmt: skip
"""Effects whose coefficient may vary, as terms of a balance."""
LAW_OVER_TWO = "law over two"
"""Kind of a law over two variables."""
_VARIED_BY = ("position", "velocity", "command", "force", "pressure_head", "pressure_rod", "time")


@cache
def smooth_basis(counts: tuple[int, ...]) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    """Return smooth functions on a grid of knots, and the roots of prior covariances of their coefficients.

    The covariance of the values at the knots is squared-exponential in the number of the knot, with unit variance. Its
    largest eigenvectors for the shortest length are the functions.

    Args:
        counts: knots of each variable, K in all.

    Returns:
        (K, q) functions, and a root (q, r) per length of `_LENGTHS`.
    """

    def covariance(length: float) -> np.ndarray:
        whole = np.ones((1, 1))
        for n in counts:
            apart = np.subtract.outer(np.arange(n), np.arange(n)) / (length * (n - 1))
            whole = np.kron(whole, np.exp(-0.5 * apart**2))
        return whole

    def root(matrix: np.ndarray) -> np.ndarray:
        sizes, ways = np.linalg.eigh(matrix)
        kept = sizes > _ROUNDING[len(counts)] * sizes[-1]
        return ways[:, kept] * np.sqrt(sizes[kept])

    lengths = _LENGTHS[len(counts)]
    basis = np.linalg.qr(root(covariance(lengths[0])))[0]
    return basis, tuple(root(basis.T @ covariance(length) @ basis) for length in lengths)


def states_after_rows(machine: Machine, track: Track) -> np.ndarray:
    """Simulate a machine over one row from each of a track's states; return the states (n, nz) at the ends."""
    model, later = reduced_model(machine, ()), np.empty(track.states.shape)
    steps = steps_per_row(machine, track.run.period, STEP)
    _rows_later(model, model_space(model), track.states, track.run.command, track.run.period, steps, later)
    return later


@dataclass(frozen=True)
class LawForm:
    """What a law adds to which balance, up to its K coefficients.

    Attributes:
        balance: force, flow_head, flow_rod, flow_through (from the head to the rod side) or command.
        axis: of the drive.
        table: knots of one or two variables.
        size: typical size of a coefficient [unit of the balance per unit of the form].
        smoothing: of the sign of the velocity [m/s] or [rad/s].
        effect: the library effect whose coefficient the table is; empty for a learned law.
        constants: of the effect's form.
    """

    balance: str
    axis: str
    table: Table
    size: float
    smoothing: float
    effect: str = ""
    constants: Mapping[str, float] = field(default_factory=dict)

    @property
    def key(self) -> tuple[str, str]:
        """Name and location of the hypothesis."""
        if self.effect:
            return f"{self.effect}{VARIES}{self.table.name}", self.axis
        return f"{LEARNED}_{self.balance}", f"{self.axis}.{self.table.name}"

    @property
    def kind(self) -> str:
        """Whether it is a profile, or a law over one or two variables; the best of each kind is refined."""
        return "profile" if self.effect else LAW_OVER_TWO if len(self.table.variables) > 1 else "law over one"

    @property
    def sides(self) -> tuple[tuple[str, float], ...]:
        """Balances of the filter's inputs, with the sign of the law in each."""
        return (("flow_head", -1.0), ("flow_rod", 1.0)) if self.balance == THROUGH else ((self.balance, 1.0),)

    def roots(self) -> list[np.ndarray]:
        """Return the roots (q, r) of the prior covariances that are compared, of the coefficients of `basis`."""
        _, roots = smooth_basis(tuple(map(len, self.table.points)))
        return [size * self.size * root for size in _SIZES for root in roots]

    @property
    def basis(self) -> np.ndarray:
        """(K, q) smooth functions at the K points of the table."""
        return smooth_basis(tuple(map(len, self.table.points)))[0]

    def shares(self, seen: Seen) -> np.ndarray:
        """Return what a unit at each point of the table adds along a run (n, K)."""
        values = seen.values[self.axis]
        found = self.table.columns(values)
        if self.effect:
            form = FORMS[self.effect]
            found = found * (form.sign * form.along(values, self.constants))[:, None]
        return np.nan_to_num(found)

    def unit_changes(self, machine: Machine, track: Track, unchanged: np.ndarray | None = None) -> np.ndarray:
        """Return what a unit of the balance, held over a row, changes in the states after it (n, nz).

        Args:
            machine: the model.
            track: of it, which states the rows.
            unchanged: `states_after_rows` of both, where they are known.
        """
        step = _TYPICAL * float(input_sizes(machine, [Input(self.sides[0][0], self.axis)])[0])
        added = [
            Term.model_validate({
                "name": "unit", "axis": self.axis, "balance": side, "law": "constant",
                "parameters": {"value": sign * step},
            })
            for side, sign in self.sides
        ]  # fmt: skip
        if unchanged is None:
            unchanged = states_after_rows(machine, track)
        changed = states_after_rows(machine.model_copy(update={"terms": (*machine.terms, *added)}), track)
        return np.nan_to_num(changed - unchanged) / step

    def columns(self, track: Track, seen: Seen, unit: np.ndarray) -> np.ndarray:
        """Return the change (n c, q) of a track's whitened errors per unit of each function of `basis`.

        Args:
            track: linearised.
            seen: its variables.
            unit: of `unit_changes`, (n, nz).
        """
        responses = error_responses(track, unit, self.shares(seen) @ self.basis)
        return responses.reshape(-1, responses.shape[2])

    def terms(self, entries: np.ndarray, taken: Collection[str]) -> list[Term]:
        """Return the terms of a machine with some coefficients (K,); none has a name that is taken."""
        name, facts = self.key[0].replace("@", "_"), self.table.law(entries)
        if self.effect:
            form = FORMS[self.effect]
            product = form.product.format(**self.constants)
            values = tuple((form.sign * entries).tolist())
            facts |= {"law": "scaled_table", "parameters": facts["parameters"] | {"values": values, "product": product}}
        own = next(n for n in chain([name], (f"{name}_{k}" for k in count(2))) if n not in taken)
        return [
            Term.model_validate({
                "name": own, "axis": self.axis, "balance": side,
                "description": f"learned from data: {self.balance} over {self.table.name}",
                **_times(facts, sign),
            })
            for side, sign in self.sides
        ]  # fmt: skip

    def hypothesis(self, root: np.ndarray) -> "LawHypothesis":
        """Return the law as a hypothesis with r unit-normal parameters; `root` (q, r) as of `roots`."""
        one = Parameter("1", 0.0, -_WIDEST, _WIDEST, 1.0, 0.0)
        parameters = {str(k + 1): one for k in range(root.shape[1])}

        def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
            taken = {term.name for term in nominal.terms if term.axis == self.axis}
            new = self.terms(self.basis @ root @ np.array([values[key] for key in parameters]), taken)
            return nominal.model_copy(update={"terms": (*nominal.terms, *new)})

        return LawHypothesis(*self.key, parameters, change, form=self, root=root)


def _times(facts: dict[str, Any], sign: float) -> dict[str, Any]:
    if sign == 1.0:
        return facts
    values = np.array(facts["parameters"]["values"]) * sign
    plain = tuple(map(tuple, values.tolist())) if values.ndim == 2 else tuple(values.tolist())
    return facts | {"parameters": facts["parameters"] | {"values": plain}}


@dataclass(frozen=True, eq=False)
class LawHypothesis(Hypothesis):
    """A law with its coefficients as unit-normal parameters.

    Attributes:
        form: the law.
        root: (q, r) coefficients of the basis per parameter.
    """

    form: LawForm = field(kw_only=True)
    root: np.ndarray = field(kw_only=True)

    def responses(self, machine: Machine, data: Dataset, track: Track) -> np.ndarray:
        """Return the change (n c, r) of a track's whitened errors per parameter, see `Hypothesis.responses`."""
        unit = self.form.unit_changes(machine, track)
        return self.form.columns(track, see_run(machine, data, track), unit) @ self.root


def list_forms(
    evidence: Evidence, judged: Judged, seen: Sequence[Seen], effects: Collection[str], has_laws: bool
) -> list[LawForm]:
    """Return the laws over one variable, and the profiles, that may explain the residual inputs of a model.

    Args:
        evidence: the runs.
        judged: the model.
        seen: its runs.
        effects: library effects whose coefficient may vary.
        has_laws: whether laws without a known form are among them.
    """
    machine, forms = evidence.data.machine, list[LawForm]()
    for balance, axis in _balances(judged):
        facts = machine.axes[axis]
        smoothing = facts.drive.friction.smoothing_velocity
        tables = {v: Table((v,), (points,)) for v, points in place_knots(seen, axis, _KNOTS[1], smoothing).items()}
        if has_laws:
            size = _TYPICAL * float(input_sizes(machine, [Input(_side_of(balance), axis)])[0])
            # a command that depends on the command alone is the curve of the valve: a gain by command
            known = "command" if balance == "command" and "valve_gain" in effects else ""
            forms += [LawForm(balance, axis, table, size, smoothing) for v, table in tables.items() if v != known]
        for effect in effects:
            if (
                effect not in FORMS
                or FORMS[effect].balance != balance
                or axis not in EFFECTS[effect].locations(machine)
            ):
                continue
            own = EFFECTS[effect].parameters(machine, axis)[FORMS[effect].parameter]
            constants, per = {"v0": smoothing}, 1.0
            if effect == "orifice_leakage":
                assert facts.valve and machine.supply
                per = machine.supply.relief_pressure**0.5  # its parameter is the flow at this pressure
                constants = {"d": facts.valve.smoothing, "per": per}
            forms += [
                LawForm(balance, axis, tables[v], own.prior_std / per, smoothing, effect, constants)
                for v in _VARIED_BY if v in tables
            ]  # fmt: skip
    return forms


def list_pairs(seen: Sequence[Seen], single: LawForm) -> list[LawForm]:
    """Return the laws over products of the variable of a law over one with another, at the same place."""
    points = place_knots(seen, single.axis, _KNOTS[2], single.smoothing)
    (first,) = single.table.variables
    return [
        replace(single, table=Table((first, other), (points[first], points[other])))
        for other in points if other != first
    ]  # fmt: skip


def place_knots(seen: Sequence[Seen], axis: str, count: int, smoothing: float) -> dict[str, tuple[float, ...]]:
    """Return the points of a table over each variable of a drive that moves.

    They lie half-way between even spacing and quantiles, from the smallest to the largest value. Friction changes its
    sign within the smoothing velocity [m/s] or [rad/s]; points of the velocity lie at its ends, and none within twice.
    """
    found = {}
    for name in OWN_VARIABLES:
        # what varies with the time of one run alone may be anything
        if name not in seen[0].values[axis] or (name == "time" and len(seen) < 2):
            continue
        x = np.concatenate([s.values[axis][name] for s in seen])
        x = x[np.isfinite(x)]
        if not len(x) or not np.ptp(x) > 0.0:
            continue
        points = set(0.5 * (np.quantile(x, np.linspace(0.0, 1.0, count)) + np.linspace(x.min(), x.max(), count)))
        if name == "velocity" and min(-x.min(), x.max()) > 2.0 * smoothing:
            points = {p for p in points if abs(p) > 2.0 * smoothing} | {-smoothing, smoothing}
        rounded = sorted({float(f"{p:.6g}") for p in points})
        if len(rounded) > 1:
            found[name] = tuple(rounded)
    return found


def _side_of(balance: str) -> str:
    return "flow_head" if balance == THROUGH else balance


def _balances(judged: Judged) -> list[tuple[str, str]]:
    """Balances and axes that have residual inputs, and flows through a piston with one on a side."""
    found = [(i.balance, i.axis) for i in judged.tracks[0].levels.inputs]
    through = dict.fromkeys(axis for balance, axis in found if balance in ("flow_head", "flow_rod"))
    return found + [(THROUGH, axis) for axis in through]


def learned_of(evidence: Evidence, judged: Judged, covariance: np.ndarray) -> tuple[Learned, ...]:
    """Return the laws and profiles of a model as they are described.

    Args:
        evidence: with the data.
        judged: the model.
        covariance: (P, P) of its deviations.
    """
    machine, first, found = judged.guess.machine(evidence.data.machine), 0, []
    for hypothesis, deviation in judged.guess.parts:
        own = slice(first, first + hypothesis.size)
        first += hypothesis.size
        if not isinstance(hypothesis, LawHypothesis):
            continue
        form, root = hypothesis.form, hypothesis.form.basis @ hypothesis.root
        runs = [see_run(machine, evidence.data, t).values[form.axis] for t in judged.tracks]
        everywhere = {v: np.concatenate([x[v] for x in runs]) for v in runs[0]}
        found.append(Learned(
            hypothesis, form.balance, form.axis, form.table, root @ deviation,
            root @ covariance[own, own] @ root.T, form.smoothing, everywhere, form.effect,
        ))  # fmt: skip
    return tuple(found)


def with_profile(machine: Machine, effect: NamedEffect, law: Learned | None) -> NamedEffect:
    """Return an effect with its coefficient along a variable, and the mean over the runs with a 95 % interval.

    Args:
        machine: the given machine.
        effect: a named effect.
        law: its coefficient; None if that does not vary.
    """
    if law is None:
        return effect
    assert isinstance(law.hypothesis, LawHypothesis)
    form = law.hypothesis.form
    key = FORMS[form.effect].parameter
    own = EFFECTS[form.effect].parameters(machine, form.axis)[key]
    per, variable = form.constants.get("per", 1.0), form.table.variables[0]
    spread = per * np.sqrt(np.diag(law.covariance))
    profile = Profile(
        variable, variable_unit(machine, form.axis, variable), form.table.points[0],
        tuple((own.nominal + per * law.entries).tolist()), tuple(spread.tolist()),
    )  # fmt: skip
    weights = form.table.columns(law.seen).mean(axis=0)
    mean = own.nominal + per * float(weights @ law.entries)
    reach = _NORMAL95 * per * float(np.sqrt(weights @ law.covariance @ weights))
    numbers = {key: Estimate(mean, own.unit, mean - reach, mean + reach, own.nominal)}
    return replace(effect, parameters=numbers, profile=profile)


def best_prior(form: LawForm, right: np.ndarray, block: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the prior of a law that has the most evidence.

    Args:
        form: the law, with q functions of its basis.
        right: (q,) X' W y of its columns.
        block: (q, q) X' W X.

    Returns:
        Twice its log Bayes factor, its root (q, r), and the posterior mean (r,) of its parameters.
    """
    found = []
    for root in form.roots():
        (factor,), (mean,) = compare_groups(np.array([0, root.shape[1]]), root.T @ right, [root.T @ block @ root])
        found.append((float(factor), root, mean))
    return max(found, key=lambda one: one[0])
