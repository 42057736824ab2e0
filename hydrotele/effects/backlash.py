"""Teeth with a gap between a motor and what it turns."""

from hydrotele.effects._drive_side import rigid_drive, with_transmission
from hydrotele.effects._sizes import drive_turns
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine import Machine

_CLOSED = 1.0e-6  # rad, a gap that is none: a slewing ring's tooth moves 1 um in it


def _locations(machine: Machine) -> tuple[str, ...]:
    return tuple(n for n, a in machine.axes.items() if a.motor and drive_turns(machine, n))


def _gap(machine: Machine, location: str) -> float:
    transmission = machine.axes[location].transmission
    return transmission.backlash if transmission else 0.0


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Half a degree is a worn slewing ring; 1 mrad is a new one, or one reading of a resolver."""
    present = _gap(machine, location)
    high = max(0.05, present)
    return {"gap": Parameter("rad", present, 0.0, high, 0.01, 1e-3, starts=(0.003, 0.01, 0.03))}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Give the motor an inertia of its own, from the link's, and a stiff spring with a gap."""
    gap, before = values["gap"], machine.axes[location].transmission
    if gap < _CLOSED and before is None:
        return machine
    transmission = (before or rigid_drive(machine, location)).model_copy(update={"backlash": gap})
    return with_transmission(machine, location, transmission)


EFFECT = Effect(
    "backlash", "teeth with a gap between a motor and what it turns", "force", _locations,
    _parameters, _apply,
)  # fmt: skip
