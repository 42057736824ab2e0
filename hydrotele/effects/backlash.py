"""Teeth with a gap between a motor and what it turns."""

import math

from hydrotele.effects._drive_side import rigid_drive, with_transmission
from hydrotele.effects._sizes import drive_turns
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.drives import Transmission
from hydrotele.machine.machine import Machine

_CLOSED = 1.0e-6  # rad, a gap that is none: a slewing ring's tooth moves 1 um in it


def _locations(machine: Machine) -> tuple[str, ...]:
    return tuple(n for n, a in machine.axes.items() if a.motor and drive_turns(machine, n))


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Half a degree is a worn slewing ring; 1 mrad is a new one, or one reading of a resolver.

    How heavy rotor and gears are, seen at the ring, and how the teeth ring when they meet is known
    to a factor; both matter only to who follows the rattling from reading to reading.
    """
    drive = _drive(machine, location)
    present, inertia, ratio = drive.backlash, drive.inertia, _ratio(drive)
    return {
        "gap": Parameter(
            "rad", present, 0.0, max(0.05, present), 0.01, 1e-3, starts=(0.003, 0.01, 0.03)
        ),
        "drive_inertia": Parameter(
            "kg m^2", inertia, 0.1 * inertia, 5.0 * inertia, inertia, inertia, optional=True
        ),
        "damping_ratio": Parameter(
            "1", ratio, min(1e-3, ratio), max(2.0, ratio), 0.3, 0.3, optional=True
        ),
    }


def _drive(machine: Machine, location: str) -> Transmission:
    return machine.axes[location].transmission or rigid_drive(machine, location)


def _ratio(drive: Transmission) -> float:
    return drive.damping / (2.0 * math.sqrt(drive.stiffness * drive.inertia))


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Give the motor an inertia of its own, from the link's, and a stiff spring with a gap."""
    gap, before = values["gap"], machine.axes[location].transmission
    if gap < _CLOSED and before is None:
        return machine
    drive = _drive(machine, location)
    inertia = values.get("drive_inertia", drive.inertia)
    ratio = values.get("damping_ratio", _ratio(drive))
    stiffness = drive.stiffness * inertia / drive.inertia  # teeth in contact ring as fast as before
    damping = drive.damping
    if (inertia, ratio) != (drive.inertia, _ratio(drive)):
        damping = 2.0 * ratio * math.sqrt(stiffness * inertia)
    transmission = Transmission(inertia=inertia, stiffness=stiffness, damping=damping, backlash=gap)
    return with_transmission(machine, location, transmission)


EFFECT = Effect(
    "backlash", "teeth with a gap between a motor and what it turns", "force", _locations,
    _parameters, _apply,
)  # fmt: skip
