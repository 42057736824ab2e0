"""Dry friction that is a spring below breakaway: the bristles of a drive's seals and guides."""

from hydrotele.effects._sizes import drive_kind, drive_turns
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine

_WAY, _TURN = 5.0e-5, 2.0e-4  # m, rad: what seals and gears give before they slide, an estimate
_RIGID = 0.02  # of the least compliance worth naming: friction as without bristles


def _rubbing(machine: Machine) -> tuple[str, ...]:
    """Axes with dry friction to break away from; that of a drive with its own pump is rigid."""
    found = {name: axis.drive.friction for name, axis in machine.axes.items() if not axis.pump}
    return tuple(name for name, f in found.items() if f.coulomb + f.stribeck_extra > 0.0)


def _compliance(machine: Machine, location: str) -> dict[str, Parameter]:
    """Deflection of the bristles over their force; 0 is friction without bristles.

    Surfaces of metal give some micrometres before they slide, seals of rubber up to a tenth of a
    millimetre; least is 10 um, or 40 urad, at the breakaway force.
    """
    friction, turns = machine.axes[location].drive.friction, drive_turns(machine, location)
    usual = (_TURN if turns else _WAY) / (friction.coulomb + friction.stribeck_extra)
    stiffness = friction.presliding_stiffness
    present = 1.0 / stiffness if stiffness else 0.0
    return {
        "compliance": Parameter(
            "rad/(N m)" if turns else "m/N", present, 0.0, max(20.0 * usual, present), usual,
            0.2 * usual, starts=(0.4 * usual, usual, 4.0 * usual),
        )
    }  # fmt: skip


def _set(machine: Machine, location: str, values: Values) -> Machine:
    """Bristles as stiff as that; friction as without them where nobody could tell them apart."""
    compliance = values["compliance"]
    number = _compliance(machine, location)["compliance"]
    if compliance == number.nominal:
        return machine
    stiffness = 1.0 / compliance if compliance >= _RIGID * number.least else 0.0
    path = f"axes.{location}.{drive_kind(machine, location)}.friction"
    if not stiffness:
        machine = changed(machine, f"{path}.presliding_damping", 0.0)
    return changed(machine, f"{path}.presliding_stiffness", stiffness)


EFFECT = Effect(
    "presliding", "dry friction that gives like a spring before it slides", "force", _rubbing,
    _compliance, _set,
)  # fmt: skip
