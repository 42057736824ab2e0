"""Leakage through a gap so short that its flow is turbulent: a torn seal, a cracked piston."""

import math

from hydrotele.effects._sizes import valves
from hydrotele.effects._terms import term_number, with_terms
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import Term

NAME = "orifice_leakage"


def _root(machine: Machine) -> float:
    """Square root of the relief pressure [sqrt(Pa)], at which the flow is stated."""
    assert machine.supply
    return math.sqrt(machine.supply.relief_pressure)


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Flow at the relief pressure, as fractions of the rated flow; sizes as of laminar leakage."""
    valve = machine.axes[location].valve
    assert valve
    gain = term_number(machine, NAME, location, "flow_rod", "flow_gain", 0.0)
    present, rated = gain * _root(machine), valve.rated_flow
    high = present + 0.5 * rated
    return {"flow": Parameter("m^3/s", present, 0.0, high, 0.05 * rated, 0.005 * rated)}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """The same flow out of the head side into the rod side."""
    valve, gain = machine.axes[location].valve, values["flow"] / _root(machine)
    assert valve
    numbers = {"smoothing": valve.smoothing}
    terms = [
        Term(name=NAME, axis=location, balance="flow_rod", law="orifice_leakage",
             parameters={"flow_gain": gain, **numbers}),
        Term(name=NAME, axis=location, balance="flow_head", law="orifice_leakage",
             parameters={"flow_gain": -gain, **numbers}),
    ]  # fmt: skip
    return with_terms(machine, NAME, terms if gain else [], [location])


EFFECT = Effect(
    NAME, "turbulent leakage between the chambers of a drive", "flow", valves, _parameters, _apply,
    "leakage",
)  # fmt: skip
