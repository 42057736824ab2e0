"""Draw the hidden effects of a trial, with random locations and sizes."""

import dataclasses
import math
from typing import Any

import numpy as np

from hydrotele.effects import EFFECTS, apply_effect
from hydrotele.effects.effect import Parameter
from hydrotele.machine.machine import Machine
from tools.validation.blind.outside import OUTSIDE

SMALLEST, LARGEST = 2.0, 3.0  # drawn deviations: in units of `least` and of `scale`


@dataclasses.dataclass(frozen=True)
class Planted:
    """An effect at a place: of the library, or one of `OUTSIDE`."""

    name: str
    location: str
    parameters: dict[str, float]

    def facts(self, machine: Machine) -> dict[str, Any]:
        """The effect as the key holds it, with units and nominal values where there are some."""
        facts: dict[str, Any] = {"name": self.name, "location": self.location}
        if self.name in EFFECTS:
            known = EFFECTS[self.name].parameters(machine, self.location)
            facts["parameters"] = {
                k: {"value": v, "unit": known[k].unit, "nominal": known[k].nominal} for k, v in self.parameters.items()
            }
        else:
            facts["parameters"] = {k: {"value": v} for k, v in self.parameters.items()}
        return facts


def draw_value(parameter: Parameter, rng: np.random.Generator) -> float:
    """A value whose deviation is log-uniform from twice the least to thrice the typical one.

    The sign is random where both sides have room for the smallest deviation; the largest one ends
    where the plausible range does.
    """
    least, most = SMALLEST * parameter.min_relevant_change, LARGEST * parameter.prior_std
    room = {
        -1.0: parameter.nominal - parameter.lower_bound,
        1.0: parameter.upper_bound - parameter.nominal,
    }
    signs = [sign for sign, space in room.items() if space >= least]
    sign = float(rng.choice(signs))
    most = min(max(most, least), room[sign])
    return parameter.nominal + sign * math.exp(rng.uniform(math.log(least), math.log(most)))


def draw_effect(machine: Machine, rng: np.random.Generator) -> Planted:
    """An effect of the library: each name as likely as the next, then each of its places."""
    effect = EFFECTS[str(rng.choice(sorted(n for n in EFFECTS if EFFECTS[n].locations(machine))))]
    location = str(rng.choice(effect.locations(machine)))
    parameters = effect.parameters(machine, location)
    values = {name: draw_value(p, rng) for name, p in parameters.items() if not p.optional}
    return Planted(effect.name, location, values)


def draw_double(machine: Machine, rng: np.random.Generator) -> list[Planted]:
    """Two effects that do not touch the same numbers, so that both can be found."""
    while True:
        one, two = draw_effect(machine, rng), draw_effect(machine, rng)
        if (one.name, one.location) != (two.name, two.location) and _independent(machine, one, two):
            return [one, two]


def draw_outside(machine: Machine, turn: int, rng: np.random.Generator) -> Planted:
    """An effect outside the library; the kinds take turns, so that every one is tried."""
    effect = OUTSIDE[sorted(OUTSIDE)[turn % len(OUTSIDE)]]
    location, parameters = effect.draw(machine, rng)
    return Planted(effect.name, location, parameters)


def with_effects(machine: Machine, planted: list[Planted]) -> Machine:
    """The machine with effects of the library."""
    for effect in planted:
        machine = apply_effect(machine, effect.name, effect.location, effect.parameters)
    return machine


def _independent(machine: Machine, one: Planted, two: Planted) -> bool:
    return with_effects(machine, [one, two]) == with_effects(machine, [two, one])
