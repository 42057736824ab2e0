"""A hypothesis: an effect at a place, its numbers counted in typical deviations from nominal."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hydrotele.effects import EFFECTS, Parameter
from hydrotele.machine.machine import Machine

_CURVE = 0.02  # of the typical deviation: small enough for a slope, large against rounding
WIDE = 0.3  # of it: for a first look, where friction that sticks or slips makes slopes steep
_SMOOTH = ("timing", "sensor")  # laws whose effects have a slope at nominal, besides their starts
_OPEN = ("force", "flow", "valve", "supply")  # laws of which no drawing and no data sheet tells all
_FREEDOM = 4.0  # degrees of freedom of the t distribution of their effects' sizes


@dataclass(frozen=True)
class Hypothesis:
    """An effect at a place of the given machine, with p parameters.

    Deviations are `(value - nominal) / scale`. `change` makes the machine that has it from
    parameter values; by default the library's effect of that name.

    The prior of deviations is a unit normal. That of a library effect in a force, a flow, a valve
    or the supply has the same width and the tails of a t distribution: there `scale` says what is
    common, and what is rare, as an inertia ten times the model's, is no reason to prefer three
    other effects of common size.
    """

    name: str
    location: str
    parameters: dict[str, Parameter]
    change: Callable[[Machine, Mapping[str, float]], Machine] | None = None

    def machine(self, nominal: Machine, deviation: np.ndarray) -> Machine:
        """The machine that has it, at a deviation (p,)."""
        values = self.values(deviation)
        if self.change:
            return self.change(nominal, values)
        return EFFECTS[self.name].apply(nominal, self.location, values)

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.parameters)

    @property
    def low(self) -> np.ndarray:
        """(p,) smallest deviation."""
        return np.array([(p.low - p.nominal) / p.scale for p in self.parameters.values()])

    @property
    def high(self) -> np.ndarray:
        """(p,) largest deviation."""
        return np.array([(p.high - p.nominal) / p.scale for p in self.parameters.values()])

    @property
    def least(self) -> np.ndarray:
        """(p,) deviation worth naming."""
        return np.array([p.least / p.scale for p in self.parameters.values()])

    @property
    def has_wide_prior(self) -> bool:
        """Whether sizes far from common ones are rare, not impossible."""
        known = EFFECTS.get(self.name)
        return known is not None and not self.change and known.law in _OPEN

    def prior(self, deviation: np.ndarray) -> float:
        """-2 log of the prior at a deviation (p,), 0 at nominal."""
        squares = deviation**2
        if self.has_wide_prior:
            squares = _FREEDOM * np.log1p(squares / _FREEDOM)
        return float(np.sum(squares))

    def prior_weight(self, deviation: np.ndarray) -> np.ndarray:
        """(p,) precision of the normal prior that pulls a deviation (p,) as hard as the prior."""
        if self.has_wide_prior:
            return 1.0 / (1.0 + deviation**2 / _FREEDOM)
        return np.ones(len(deviation))

    @property
    def starts(self) -> list[np.ndarray]:
        """Deviations (p,) from which to search: nominal, and where the effect says so."""
        tables = [p.starts for p in self.parameters.values()]
        if not any(tables):
            return [np.zeros(self.size)]
        known = EFFECTS.get(self.name)
        slope = [np.zeros(self.size)] if known and known.law in _SMOOTH else []
        return slope + [
            np.array([
                (p.starts[k] - p.nominal) / p.scale if k < len(p.starts) else 0.0
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
            key: float(np.clip(p.nominal + d * p.scale, p.low, p.high))
            for (key, p), d in zip(self.parameters.items(), deviation, strict=True)
        }

    def sides(self, index: int, size: float) -> list[float]:
        """Steps of a parameter from nominal to either side, as far as its bounds allow."""
        steps = (min(size, self.high[index]), max(-size, self.low[index]))
        return [float(step) for step in steps if step != 0.0]

    def held(self, deviation: np.ndarray) -> "Hypothesis":
        """The same with its numbers fixed at a deviation (p,): none is left to fit."""
        return replace(
            self, parameters={}, change=lambda nominal, _: self.machine(nominal, deviation)
        )

    def nudges(self, deviation: np.ndarray, size: float = _CURVE) -> np.ndarray:
        """(p,) signed steps for slopes at a deviation, away from the nearer bound."""
        step = np.minimum(size, 0.1 * (self.high - self.low))
        return np.where(deviation + step > self.high, -step, step)


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


def with_shape(hypothesis: Hypothesis, machine: Machine) -> Hypothesis | None:
    """A library effect with its optional numbers, too, which come last; None if it has no more."""
    known = EFFECTS.get(hypothesis.name)
    if known is None or hypothesis.change:
        return None
    table = known.parameters(machine, hypothesis.location)
    more = {key: p for key, p in table.items() if key not in hypothesis.parameters}
    return replace(hypothesis, parameters={**hypothesis.parameters, **more}) if more else None


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

    def machine(self, nominal: Machine) -> Machine:
        """The machine that has all these effects."""
        for hypothesis, deviation in self.parts:
            nominal = hypothesis.machine(nominal, deviation)
        return nominal
