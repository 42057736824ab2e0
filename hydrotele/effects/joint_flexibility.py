"""A spring between a drive and what it moves."""

from hydrotele.effects._drive_side import (
    damper,
    resolved_inertia,
    rigid_drive,
    with_transmission,
)
from hydrotele.effects._sizes import drive_turns, largest_force, valves
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.machine import Machine

_RIGID = 0.02  # of the least compliance worth naming: stiffer than the parts taken as rigid
_TURN = 0.015  # rad, deflection of a slewing drive's gears and shafts at full torque


def _travel(machine: Machine, location: str) -> float:
    """Deflection at full force that is usual for a flexible joint [m] or [rad]: 1 % of a stroke."""
    cylinder = machine.axes[location].cylinder
    return 0.01 * cylinder.stroke if cylinder else _TURN


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Deflection over force; least is 2 mm of a 1 m stroke, or 2 mrad, at full pressure."""
    usual = _travel(machine, location) / largest_force(machine, location)
    transmission = machine.axes[location].transmission
    present = 1.0 / transmission.stiffness if transmission else 0.0
    unit = "rad/(N m)" if drive_turns(machine, location) else "m/N"
    high = max(4.0 * usual, present)
    starts = (0.3 * usual, 1.0 * usual, 3.0 * usual)
    least = 0.15 * usual
    return {"compliance": Parameter(unit, present, 0.0, high, usual, least, starts)}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Put a spring of 1 / compliance in the transmission; a gap that is there stays.

    A cylinder's spring lies in line with it, between piston and rod pin: the length sensor and the
    oil see the piston. The drive side is as heavy as the rod, or 3 % of a motor's load, and heavier
    where a stiff spring could not be stepped otherwise.
    """
    compliance, before = values["compliance"], machine.axes[location].transmission
    number = _parameters(machine, location)["compliance"]
    if compliance == number.nominal or (before is None and compliance < _RIGID * number.least):
        return machine
    transmission = before or rigid_drive(machine, location)
    stiffness = 1.0 / max(compliance, _RIGID * number.least)
    inertia = resolved_inertia(machine, location, transmission.inertia, stiffness)
    soft = {"stiffness": stiffness, "inertia": inertia, "damping": damper(inertia, stiffness)}
    return with_transmission(machine, location, transmission.model_copy(update=soft))


EFFECT = Effect(
    "joint_flexibility", "a spring between a drive and what it moves", "force", valves,
    _parameters, _apply,
)  # fmt: skip
