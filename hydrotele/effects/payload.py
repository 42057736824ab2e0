"""A load at the arm's tip."""

from hydrotele.effects._sizes import outboard_links
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.machine import Link, Machine

PAYLOAD = "payload"
"""Name of the link that carries the load."""

_LEAST = 1.0e-3  # kg, below which a load is none: MuJoCo takes no body without mass
_POINT = 1.0e-3  # m, radius of gyration of a point mass: a body needs some inertia


def _place(machine: Machine) -> tuple[str, ...]:
    return ("tool",) if machine.arm else ()


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Relative to what the boom moves: 15 kg of 2.5 t is what seals let one feel."""
    assert machine.arm
    arm = outboard_links(machine, machine.link_of(machine.arm.boom))
    moved = sum(machine.links[name].mass for name in arm if name != PAYLOAD)
    return {"mass": Parameter("kg", 0.0, 0.0, 1.2 * moved, 0.1 * moved, 0.006 * moved)}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Point mass at the arm's tip: one more link, welded there; loads add up."""
    assert machine.arm
    tip, mass = machine.arm.tip, values["mass"]
    if mass < _LEAST:
        return machine
    if PAYLOAD in machine.links:
        mass += machine.links[PAYLOAD].mass
    size = mass * _POINT**2
    load = Link(parent=tip.link, position=tip.position, mass=mass, inertia=(size, size, size))
    return machine.model_copy(update={"links": {**machine.links, PAYLOAD: load}})


EFFECT = Effect("payload", "a point mass at the arm's tip", "force", _place, _parameters, _apply)
