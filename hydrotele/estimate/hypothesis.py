"""A hypothesis: an effect at a place, its numbers counted in typical deviations from nominal.

The uncertain numbers of a machine, fitted together before and beside any effect.

A real machine is off everywhere: masses, areas, frictions, valve gains are known to some per cent.
Each is a number with a prior, a normal distribution about the given value; `uncertainty` of the
machine file states its relative standard deviation by kind (`mass: 0.03`), by kind and place
(`mass.boom: 0.1`), by kind, place and parameter (`motor_drag.piston.breakaway: 0.5`) or for all
(`default: 0.05`). A number of any effect that it names is uncertain; one that is 0, as losses are
that a data sheet leaves out, counts relative to the effect's typical size. An effect is what
remains after that.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.effects import EFFECTS, Effect, Parameter
from hydrotele.effects.effect import lateral_directions, nonparallel_cylinder_axes, with_value
from hydrotele.machine.machine import Machine

if TYPE_CHECKING:
    from hydrotele.estimate.track import Track
    from hydrotele.logs.dataset import Dataset

_CURVE = 0.02  # of the typical deviation: small enough for a slope, large against rounding
_SMOOTH = ("timing", "sensor")  # laws whose effects have a slope at nominal, besides their starts
_OPEN = ("force", "flow", "valve", "supply")  # laws of which no drawing and no data sheet tells all
_FREEDOM = 4.0  # degrees of freedom of the t distribution of their effects' sizes


class DomainError(InputError):
    """A trial value is outside the domain of a model: the machine with this value is not valid.

    A search assigns it zero likelihood.
    """


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place of the given machine, with p parameters.

    Deviations are `(value - nominal) / scale`. `change` makes the machine that has it from
    parameter values; by default the library's effect of that name.

    The prior of deviations is a unit normal. That of a library effect in a force, a flow, a valve
    or the supply has the same width and the tails of a t distribution: there `scale` says what is
    common, and what is rare, as an inertia ten times the model's, is no reason to prefer three
    other effects of common size.

    `choice_cost` is -2 log of the prior probability of a choice made with the data, such as that of an interval.

    With `runs`, it acts in these runs only. A parameter `RUN` or `RUN: NAME` belongs to that run alone.
    """

    name: str
    location: str
    parameters: dict[str, Parameter]
    change: Callable[[Machine, Mapping[str, float]], Machine] | None = None
    runs: tuple[str, ...] = field(default=(), kw_only=True)
    choice_cost: float = field(default=0.0, kw_only=True)

    def machine(self, nominal: Machine, deviation: np.ndarray, run: str = "") -> Machine:
        """Return the machine that has it, at a deviation (p,), in a run; by default what all runs share.

        Raises:
            DomainError: the machine with these values is not valid.
        """
        if self.runs and run not in self.runs:
            return nominal
        values = self.values(deviation)
        if self.runs:
            values = {key: value for key, value in values.items() if self.run_of(key) in ("", run)}
        try:
            if self.change:
                return self.change(nominal, values)
            return EFFECTS[self.name].apply(nominal, self.location, values)
        except DomainError:
            raise
        except (ValueError, ArithmeticError) as error:  # of the machine file's validation, or of an effect's formula
            stated = ", ".join(f"{key} = {value:.6g}" for key, value in values.items())
            raise DomainError(f"{self.name} at {self.location}", f"{stated} is not possible: {error}") from error

    def run_of(self, key: str) -> str:
        """Return the run to which a parameter belongs; empty if to all of its runs."""
        return next((run for run in self.runs if key == run or key.startswith(f"{run}: ")), "")

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.parameters)

    @property
    def low(self) -> np.ndarray:
        """(p,) smallest deviation."""
        return np.array([(p.lower_bound - p.nominal) / p.prior_std for p in self.parameters.values()])

    @property
    def high(self) -> np.ndarray:
        """(p,) largest deviation."""
        return np.array([(p.upper_bound - p.nominal) / p.prior_std for p in self.parameters.values()])

    @property
    def least(self) -> np.ndarray:
        """(p,) deviation worth naming."""
        return np.array([p.min_relevant_change / p.prior_std for p in self.parameters.values()])

    @property
    def has_wide_prior(self) -> bool:
        """Whether sizes far from common ones are rare, not impossible."""
        known = EFFECTS.get(self.name)
        return known is not None and not self.change and known.model_part in _OPEN

    def prior(self, deviation: np.ndarray) -> float:
        """-2 log of the prior at a deviation (p,), at nominal that of its choice."""
        squares = deviation**2
        if self.has_wide_prior:
            squares = _FREEDOM * np.log1p(squares / _FREEDOM)
        return float(np.sum(squares)) + self.choice_cost

    def prior_weight(self, deviation: np.ndarray) -> np.ndarray:
        """(p,) precision of the normal prior that pulls a deviation (p,) as hard as the prior."""
        if self.has_wide_prior:
            return 1.0 / (1.0 + deviation**2 / _FREEDOM)
        return np.ones(len(deviation))

    @property
    def starts(self) -> list[np.ndarray]:
        """Deviations (p,) from which to search: nominal, and where the effect says so."""
        tables = [p.start_values for p in self.parameters.values()]
        if not any(tables):
            return [np.zeros(self.size)]
        known = EFFECTS.get(self.name)
        slope = [np.zeros(self.size)] if known and known.model_part in _SMOOTH else []
        return slope + [
            np.array([
                (p.start_values[k] - p.nominal) / p.prior_std if k < len(p.start_values) else 0.0
                for p in self.parameters.values()
            ])
            for k in range(max(map(len, tables)))
        ]  # fmt: skip

    @property
    def key(self) -> tuple[str, str]:
        """Name and location."""
        return self.name, self.location

    def values(self, deviation: np.ndarray) -> dict[str, float]:
        """Parameter values at a deviation (p,)."""
        return {
            key: float(np.clip(p.nominal + d * p.prior_std, p.lower_bound, p.upper_bound))
            for (key, p), d in zip(self.parameters.items(), deviation, strict=True)
        }

    def sides(self, index: int, size: float) -> list[float]:
        """Steps of a parameter from nominal to either side, as far as its bounds allow."""
        steps = (min(size, self.high[index]), max(-size, self.low[index]))
        return [float(step) for step in steps if step != 0.0]

    def held(self, deviation: np.ndarray) -> "Hypothesis":
        """The same with its numbers fixed at a deviation (p,): none is left to fit."""
        return _Held(self.name, self.location, {}, self.change, self, deviation, runs=self.runs)

    def responses(self, machine: Machine, data: "Dataset", track: "Track") -> np.ndarray | None:
        """Return the change (n c, p) of a track's whitened errors per deviation, or None if it must be simulated.

        What adds to a balance in proportion to its deviations has responses that follow from the linearised filter.

        Args:
            machine: of the track.
            data: the dataset.
            track: linearised.
        """
        return None

    def nudges(self, deviation: np.ndarray, size: float = _CURVE) -> np.ndarray:
        """(p,) signed steps for slopes at a deviation, away from the nearer bound."""
        step = np.minimum(size, 0.1 * (self.high - self.low))
        return np.where(deviation + step > self.high, -step, step)


@dataclass(frozen=True)
class _Held(Hypothesis):
    """A hypothesis whose parameters are fixed."""

    origin: Hypothesis | None = None
    fixed: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def machine(self, nominal: Machine, deviation: np.ndarray, run: str = "") -> Machine:
        """Return the machine at the fixed deviation."""
        assert self.origin
        return self.origin.machine(nominal, self.fixed, run)


def hypotheses(machine: Machine, names: Sequence[str] = ()) -> list[Hypothesis]:
    """All hypotheses about a machine.

    Args:
        machine: the given machine.
        names: effects to restrict them to; all if empty.

    Returns:
        One per effect and location that has parameters, without those that are optional.
    """
    found = []
    for effect in EFFECTS.values():
        if names and effect.name not in names:
            continue
        for location in effect.locations(machine):
            table = effect.parameters(machine, location)
            parameters = {key: p for key, p in table.items() if not p.optional}
            if parameters:
                found.append(Hypothesis(effect.name, location, parameters))
    return found


_BISECTIONS = 20  # of the way from nominal to a bound: its end is found to a millionth
_LOOKS = (0.3, 0.03, 0.003)  # typical deviations from nominal that a hypothesis must allow at least one of


def limit_to_domain(candidates: Sequence[Hypothesis], machine: Machine) -> tuple[list[Hypothesis], list[DomainError]]:
    """Restrict the bounds of hypotheses to values for which the machine is valid, and their start values.

    Each parameter is taken from nominal to its bound alone, the others nominal. Values that are invalid only
    in combination are left to the search, where they have zero likelihood.

    Args:
        candidates: the hypotheses.
        machine: the given machine.

    Returns:
        The hypotheses that some value allows, with their bounds, and the errors of those that none does.
    """
    kept, errors = [], []
    for hypothesis in candidates:
        fault = find_domain_error(hypothesis, machine)
        if fault is not None:
            errors.append(fault)
            continue
        parameters = {}
        for index, (key, p) in enumerate(hypothesis.parameters.items()):
            low, high = hypothesis.low[index], hypothesis.high[index]
            inside = [_reach(hypothesis, machine, index, end) for end in (low, high)]
            changed = {}
            for name, end, reach in (("lower_bound", low, inside[0]), ("upper_bound", high, inside[1])):
                if reach != end:
                    changed[name] = p.nominal + reach * p.prior_std
            if changed:
                p = replace(p, **changed)
                p = replace(p, start_values=tuple(_start_inside(p, start) for start in p.start_values))
            parameters[key] = p
        kept.append(replace(hypothesis, parameters=parameters))
    return kept, errors


def _start_inside(p: Parameter, start: float) -> float:
    """Return a start value, or half the way from nominal to the bound that it exceeds."""
    inside = float(np.clip(start, p.lower_bound, p.upper_bound))
    return start if inside == start else 0.5 * (p.nominal + inside)


def find_domain_error(hypothesis: Hypothesis, machine: Machine) -> DomainError | None:
    """Return why no value near nominal is possible; None if one of its starts or a small change is."""
    fault = None
    small = [sign * size * np.ones(hypothesis.size) for size in _LOOKS for sign in (1.0, -1.0)]
    for deviation in (*(s for s in hypothesis.starts if np.any(s)), *small):
        try:
            hypothesis.machine(machine, np.clip(deviation, hypothesis.low, hypothesis.high))
            return None
        except DomainError as error:
            fault = error
    return fault


def _reach(hypothesis: Hypothesis, machine: Machine, index: int, end: float) -> float:
    """Return the deviation of a parameter farthest from nominal towards an end that is possible."""

    def is_possible(size: float) -> bool:
        deviation = np.zeros(hypothesis.size)
        deviation[index] = size
        return Guess(((hypothesis, deviation),)).is_in_domain(machine)

    if is_possible(end) or not is_possible(0.0):
        return end
    inside, outside = 0.0, end
    for _ in range(_BISECTIONS):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if is_possible(middle) else (inside, middle)
    return inside


@dataclass(frozen=True)
class Guess:
    """Hypotheses taken together, each at a deviation (p,)."""

    parts: tuple[tuple[Hypothesis, np.ndarray], ...] = ()

    @property
    def deviation(self) -> np.ndarray:
        """(P,) all deviations, in order."""
        return np.concatenate([d for _, d in self.parts]) if self.parts else np.zeros(0)

    @property
    def prior(self) -> float:
        """-2 log of the prior of all deviations."""
        return sum(h.prior(d) for h, d in self.parts)

    @property
    def prior_weight(self) -> np.ndarray:
        """(P,) precisions of the normal prior that pulls as hard as the prior does here."""
        weights = [h.prior_weight(d) for h, d in self.parts]
        return np.concatenate(weights) if weights else np.zeros(0)

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """What is taken together."""
        return [hypothesis for hypothesis, _ in self.parts]

    @property
    def names(self) -> list[str]:
        """(P,) names of all numbers, in order."""
        return [f"{h.name}.{h.location}.{key}" for h in self.hypotheses for key in h.parameters]

    def at(self, deviation: np.ndarray) -> "Guess":
        """The same hypotheses at other deviations (P,), kept inside their bounds."""
        parts, first = [], 0
        for hypothesis, old in self.parts:
            part = deviation[first : first + len(old)]
            parts.append((hypothesis, np.clip(part, hypothesis.low, hypothesis.high)))
            first += len(old)
        return Guess(tuple(parts))

    def plus(self, hypothesis: Hypothesis, deviation: np.ndarray) -> "Guess":
        """With one more hypothesis."""
        return Guess((*self.parts, (hypothesis, deviation)))

    def without(self, index: int) -> "Guess":
        """Without the hypothesis at an index."""
        return Guess(self.parts[:index] + self.parts[index + 1 :])

    def nudges(self, size: float = _CURVE) -> np.ndarray:
        """(P,) signed steps for slopes, of a size in typical deviations."""
        steps = [h.nudges(d, size) for h, d in self.parts]
        return np.concatenate(steps) if steps else np.zeros(0)

    @property
    def runs(self) -> tuple[str, ...]:
        """Runs in which the machine differs from what all runs share."""
        return tuple(dict.fromkeys(run for h, _ in self.parts for run in h.runs))

    @property
    def parameter_runs(self) -> list[tuple[str, ...]]:
        """(P,) runs on which each parameter acts; empty for all runs."""
        return [(run,) if (run := h.run_of(key)) else h.runs for h in self.hypotheses for key in h.parameters]

    def is_in_domain(self, nominal: Machine) -> bool:
        """Return whether the machine with all these effects is valid, in every run."""
        try:
            for run in ("", *self.runs):
                self.machine(nominal, run)
        except DomainError:
            return False
        return True

    def machine(self, nominal: Machine, run: str = "") -> Machine:
        """Return the machine that has all these effects in a run; by default what all runs share.

        Raises:
            DomainError: it is not valid.
        """
        for hypothesis, deviation in sorted(self.parts, key=lambda part: bool(part[0].runs)):
            nominal = hypothesis.machine(nominal, deviation, run)
        return nominal

    def machines(self, nominal: Machine) -> tuple[Machine, dict[str, Machine]]:
        """Return the machine that all runs share, and run -> machine where it differs.

        Raises:
            DomainError: one of them is not valid.
        """
        return self.machine(nominal), {run: self.machine(nominal, run) for run in self.runs}


CALIBRATION = "calibration"
"""Name of the hypothesis that holds all uncertain numbers."""
LEARNED = "learned"
"""First part of the name of a hypothesis that holds a learned law."""
BETWEEN_RUNS = "between_runs"
"""Name of hypotheses that let one parameter differ from run to run; the location is the parameter."""

# Relative standard deviation of what a data sheet, a drawing or a workshop says.
UNCERTAINTY: dict[str, float] = {
    "mass": 0.05, "inertia_error": 0.05, "com_offset": 0.02, "link_length": 0.002,
    "pin_offset": 0.002, "area": 0.02, "displacement": 0.02, "dead_volume": 0.1,
    "coulomb_friction": 0.1, "viscous_friction": 0.1, "stribeck_friction": 0.1,
    "internal_leakage": 0.2, "tank_leakage": 0.3, "valve_gain": 0.05, "valve_deadband": 0.1,
    "spool_lag": 0.1, "bulk_modulus": 0.1, "pump_flow_limit": 0.05, "relief_pressure": 0.03,
    "drive_gain": 0.02, "valve_damping": 0.1, "pump_displacement": 0.02, "pump_leakage": 0.3,
    "pump_torque_loss": 0.1, "tank_pressure": 0.2, "motor_constant": 0.05, "motor_inertia": 0.1,
    "motor_drag": 0.1, "motor_viscous_drag": 0.1, "line_compliance": 0.2,
    "accumulator_pressure": 0.05, "load_relief": 0.03, "load_friction": 0.1,
}  # fmt: skip
_LENGTHS = ("com_offset", "link_length", "pin_offset")  # relative to the size that they refer to
_WIDEST = 6.0  # standard deviations to which a number may go; beyond, it is an effect
_PLAIN = 3.0  # the same of a number that is none of an effect: what it takes at six is another's


@dataclass(frozen=True)
class Number:
    """An uncertain number of a machine.

    Attributes:
        key: kind, place and parameter, such as `valve_gain.boom.ratio`.
        share: its relative standard deviation.
        parameter: its nominal value, range, and prior as `scale`.
        effect: the library's effect (name, location, parameter) that changes the same number, or
            None.
        change: machine with another value.
    """

    key: str
    share: float
    parameter: Parameter
    effect: tuple[str, str, str] | None
    change: Callable[[Machine, float], Machine]


def numbers(machine: Machine) -> dict[str, Number]:
    """All uncertain numbers of a machine, by key."""
    found = [*_of_effects(machine), *_of_facts(machine)]
    return {number.key: number for number in found}


def calibration(machine: Machine, without: frozenset[str] = frozenset()) -> Hypothesis:
    """The hypothesis that all numbers are uncertain, but for some keys."""
    table = {k: n for k, n in numbers(machine).items() if k not in without}

    def change(nominal: Machine, values: Mapping[str, float]) -> Machine:
        for key, value in values.items():
            number = table[key]
            if value != number.parameter.nominal:
                nominal = number.change(nominal, value)
        return nominal

    parameters = {key: number.parameter for key, number in table.items()}
    return Hypothesis(CALIBRATION, "all", parameters, change)


def _share(machine: Machine, kind: str, place: str, own: str = "") -> float:
    """Relative standard deviation stated for a number itself, its place, its kind, or all."""
    stated = machine.uncertainty
    for key in (own, f"{kind}.{place}", kind, "default"):
        if key in stated:
            return stated[key]
    return UNCERTAINTY.get(kind, 0.0)


def _states(machine: Machine, kind: str) -> bool:
    """Whether a machine file names the uncertainty of a kind of number."""
    return any(key.partition(".")[0] == kind for key in machine.uncertainty)


def _narrow(p: Parameter, scale: float, widest: float = _WIDEST) -> Parameter:
    low, high = p.nominal - widest * scale, p.nominal + widest * scale
    return replace(
        p, lower_bound=max(p.lower_bound, low), upper_bound=min(p.upper_bound, high), prior_std=scale, start_values=()
    )


def _of_effects(machine: Machine) -> list[Number]:
    found = []
    for name, effect in EFFECTS.items():
        stated = _states(machine, name)
        if name not in UNCERTAINTY and not stated:
            continue
        for location in effect.locations(machine):
            for key, p in effect.parameters(machine, location).items():
                share = _share(machine, name, location, f"{name}.{location}.{key}")
                if p.optional:
                    continue
                size = abs(p.nominal)
                if stated and size == 0.0:
                    size = p.prior_std
                if name in _LENGTHS:
                    size = (p.upper_bound - p.lower_bound) / (0.6 if name == "com_offset" else 0.1)
                    size = size if name != "link_length" else 0.5 * size
                if size > 0.0 and share > 0.0:
                    found.append(Number(
                        f"{name}.{location}.{key}", share, _narrow(p, share * size),
                        (name, location, key), partial(_apply, effect, location, key),
                    ))  # fmt: skip
    return found


def _apply(effect: Effect, location: str, key: str, machine: Machine, value: float) -> Machine:
    """One parameter of an effect; the others stay as they are."""
    others = {k: p.nominal for k, p in effect.parameters(machine, location).items()}
    return effect.apply(machine, location, {**others, key: value})


def _of_facts(machine: Machine) -> list[Number]:
    places: list[tuple[str, str, str, str, float]] = []
    for name, link in machine.links.items():
        if _moves(machine, name):
            places.append(("mass", name, f"links.{name}.mass", "kg", link.mass))
    for name, axis in machine.axes.items():
        if axis.cylinder:
            path = f"axes.{name}.cylinder"
            for side in ("area_head", "area_rod"):
                size = getattr(axis.cylinder, side)
                places.append(("area", f"{name}.{side}", f"{path}.{side}", "m^2", size))
            for part, bar in (("tube", axis.cylinder.tube), ("rod", axis.cylinder.rod)):
                places.append(("mass", f"{name}.{part}", f"{path}.{part}.mass", "kg", bar.mass))
        if axis.motor:
            path = f"axes.{name}.motor.displacement"
            size = axis.motor.displacement
            places.append(("displacement", name, path, "m^3/rad", size))
        if axis.is_hydraulic:
            kind = "cylinder" if axis.cylinder else "motor"
            path = f"axes.{name}.{kind}.dead_volume"
            size = axis.hydraulic_drive.dead_volume
            places.append(("dead_volume", name, path, "m^3", size))
        if axis.valve:
            path = f"axes.{name}.valve.damping"
            places.append(("valve_damping", name, path, "1", axis.valve.damping))
        if axis.force:
            path = f"axes.{name}.force.gain"
            places.append(("drive_gain", name, path, "N", axis.force.gain))
    if machine.supply:
        value = machine.supply.tank_pressure
        places.append(("tank_pressure", "supply", "supply.tank_pressure", "Pa", value))
    found = _of_rods(machine)
    for kind, place, path, unit, value in places:
        share = _share(machine, kind, place)
        if share <= 0.0 or value == 0.0:
            continue
        p = Parameter(unit, value, 0.2 * value, 5.0 * value, share * abs(value), 0.0)
        if value < 0.0:
            p = replace(p, lower_bound=5.0 * value, upper_bound=0.2 * value)
        p = _narrow(p, p.prior_std, _PLAIN)
        found.append(Number(f"{kind}.{place}", share, p, None, partial(_set, path)))
    return found


def _of_rods(machine: Machine) -> list[Number]:
    """Where rods end: their pins, and the closed lengths that their extensions count from."""
    found = []
    for name in nonparallel_cylinder_axes(machine):
        cylinder = machine.axes[name].cylinder
        assert cylinder
        size, pin = cylinder.closed_length, cylinder.rod_pin.position
        places: list[tuple[str, float, float, Callable]] = [(
            f"closed_length.{name}", size, 0.2,
            partial(_set, f"axes.{name}.cylinder.closed_length"),
        )]  # fmt: skip
        for way in lateral_directions(machine, name):
            index = "xyz".index(way)
            change = partial(_set_rod_pin, name, index)
            places.append((f"rod_pin.{name}.{way}", pin[index], 0.1, change))
        for key, at, reach, change in places:
            share = _share(machine, "pin_offset", name, key)
            if share > 0.0:
                p = Parameter("m", at, at - reach * size, at + reach * size, share * size, 0.0)
                p = _narrow(p, p.prior_std, _PLAIN)
                found.append(Number(key, share, p, None, change))
    return found


def _set_rod_pin(axis: str, index: int, machine: Machine, value: float) -> Machine:
    """One coordinate of a rod's pin; the others stay."""
    cylinder = machine.axes[axis].cylinder
    assert cylinder
    place = list(cylinder.rod_pin.position)
    place[index] = value
    return with_value(machine, f"axes.{axis}.cylinder.rod_pin.position", tuple(place))


def _set(path: str, machine: Machine, value: float) -> Machine:
    return with_value(machine, path, value)


def _moves(machine: Machine, name: str) -> bool:
    """Whether gravity or inertia of a link acts on any axis."""
    while name != "world":
        link = machine.links[name]
        if link.joint:
            return True
        name = link.parent
    return False
