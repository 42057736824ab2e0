"""Physical effects that a machine can have and its model can lack.

One type for three uses: planted in a scenario, tried as a hypothesis, written into a patched
machine. Each effect names itself, its locations and parameters, and returns the changed Machine.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from hydrotele.datafile import suggest
from hydrotele.errors import InputError
from hydrotele.machine import Link, Machine

PAYLOAD = "payload"
"""Name of the link that the effect `payload` adds."""

_LEAST = 1.0e-3  # kg, below which a load is none: MuJoCo takes no body without mass
_POINT = 1.0e-3  # m, radius of gyration of a point mass: a body needs some inertia


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number of an effect: its unit and the range in which it is physically plausible."""

    unit: str
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical effect.

    Attributes:
        name: fixed name, as in reports.
        sentence: what it is.
        parameters: parameter name -> unit and range.
        locations: machine -> names of the places where it can sit.
        apply: (machine, location, parameters) -> machine that has it.
    """

    name: str
    sentence: str
    parameters: Mapping[str, Parameter]
    locations: Callable[[Machine], tuple[str, ...]]
    apply: Callable[[Machine, str, Mapping[str, float]], Machine]


def _changed(machine: Machine, path: str, value: Any) -> Machine:
    """Copy of a machine with one number replaced, at a dotted path."""
    return _replace(machine, path.split("."), value)


def _replace(node: Any, path: list[str], value: Any) -> Any:
    if not path:
        return value
    if isinstance(node, dict):
        return {**node, path[0]: _replace(node[path[0]], path[1:], value)}
    return node.model_copy(update={path[0]: _replace(getattr(node, path[0]), path[1:], value)})


def _axes(machine: Machine) -> tuple[str, ...]:
    return tuple(machine.axes)


def _valves(machine: Machine) -> tuple[str, ...]:
    return tuple(machine.hydraulic_axes)


def _drive(machine: Machine, axis: str) -> str:
    facts = machine.axes[axis]
    return "cylinder" if facts.cylinder else "motor" if facts.motor else "force"


def _on_friction(field: str):
    def apply(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
        path = f"axes.{location}.{_drive(machine, location)}.friction.{field}"
        return _changed(machine, path, p[field])

    return apply


def _on_valve(field: str, parameter: str):
    def apply(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
        return _changed(machine, f"axes.{location}.valve.{field}", p[parameter])

    return apply


def _on_supply(field: str, parameter: str):
    def apply(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
        return _changed(machine, f"supply.{field}", p[parameter])

    return apply


def _valve_gain(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
    valve = machine.axes[location].valve
    assert valve
    return _changed(machine, f"axes.{location}.valve.rated_flow", valve.rated_flow * p["ratio"])


def _leakage(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
    path = f"axes.{location}.{_drive(machine, location)}.leakage"
    return _changed(machine, path, p["leakage"])


def _payload(machine: Machine, location: str, p: Mapping[str, float]) -> Machine:
    """Point mass at the arm's tip: one more link, welded there."""
    assert machine.arm
    tip, mass = machine.arm.tip, p["mass"]
    if mass < _LEAST:
        return machine
    if PAYLOAD in machine.links:
        mass += machine.links[PAYLOAD].mass
    size = mass * _POINT**2
    load = Link(parent=tip.link, position=tip.position, mass=mass, inertia=(size, size, size))
    return machine.model_copy(update={"links": {**machine.links, PAYLOAD: load}})


def _supply_place(machine: Machine) -> tuple[str, ...]:
    return ("supply",) if machine.supply else ()


def _tool_place(machine: Machine) -> tuple[str, ...]:
    return ("tool",) if machine.arm else ()


EFFECTS: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        Effect(
            "payload", "a point mass at the arm's tip", {"mass": Parameter("kg", 0, 3000)},
            _tool_place, _payload,
        ),
        Effect(
            "coulomb_friction", "another Coulomb friction of a drive",
            {"coulomb": Parameter("N", 0, 50000)}, _axes, _on_friction("coulomb"),
        ),
        Effect(
            "viscous_friction", "another viscous friction of a drive",
            {"viscous": Parameter("N s/m", 0, 200000)}, _axes, _on_friction("viscous"),
        ),
        Effect(
            "stribeck_friction", "another extra friction at rest",
            {"stribeck_extra": Parameter("N", 0, 30000)}, _axes, _on_friction("stribeck_extra"),
        ),
        Effect(
            "valve_deadband", "another overlap of a valve",
            {"deadband": Parameter("1", 0, 0.3)}, _valves, _on_valve("deadband", "deadband"),
        ),
        Effect(
            "valve_gain", "another flow gain of a valve", {"ratio": Parameter("1", 0.3, 2)},
            _valves, _valve_gain,
        ),
        Effect(
            "spool_lag", "another bandwidth of a spool",
            {"bandwidth": Parameter("rad/s", 3, 300)}, _valves, _on_valve("bandwidth", "bandwidth"),
        ),
        Effect(
            "internal_leakage", "another leakage between the chambers of a drive",
            {"leakage": Parameter("m^3/(s Pa)", 0, 1e-10)}, _valves, _leakage,
        ),
        Effect(
            "bulk_modulus", "another stiffness of the oil",
            {"bulk_modulus": Parameter("Pa", 1e8, 2e9)}, _supply_place,
            _on_supply("bulk_modulus", "bulk_modulus"),
        ),
        Effect(
            "pump_flow_limit", "another flow of the pump",
            {"pump_flow": Parameter("m^3/s", 1e-5, 2e-2)}, _supply_place,
            _on_supply("pump_flow", "pump_flow"),
        ),
        Effect(
            "relief_pressure", "another setting of the main relief valve",
            {"relief_pressure": Parameter("Pa", 1e6, 4e7)}, _supply_place,
            _on_supply("relief_pressure", "relief_pressure"),
        ),
    )
}  # fmt: skip
"""Effects by name."""


def apply_effect(
    machine: Machine, name: str, location: str, parameters: Mapping[str, float]
) -> Machine:
    """A machine that has an effect.

    Args:
        machine: the machine without it.
        name: name of the effect.
        location: where; may be left empty where there is only one place.
        parameters: parameter name -> value in the effect's unit.

    Returns:
        The changed machine.

    Raises:
        InputError: unknown effect, location or parameter, or a value out of range; lists what is
            valid.
    """
    if name not in EFFECTS:
        raise InputError(f"effect {name!r}", f"is not known; {suggest(name, EFFECTS)}")
    effect = EFFECTS[name]
    places = effect.locations(machine)
    if not location and len(places) == 1:
        location = places[0]
    if location not in places:
        message = f"cannot sit at {location!r}; {suggest(location, places)}"
        raise InputError(f"effect {name}", message)
    for key in parameters.keys() ^ effect.parameters.keys():
        names = ", ".join(effect.parameters)
        raise InputError(f"effect {name}", f"needs exactly the parameters {names}: {key!r}")
    for key, value in parameters.items():
        limits = effect.parameters[key]
        if not limits.low <= value <= limits.high:
            raise InputError(
                f"effect {name}: {key}",
                f"{value:g} is outside {limits.low:g} .. {limits.high:g} {limits.unit}",
            )
    return effect.apply(machine, location, parameters)
