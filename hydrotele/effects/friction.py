"""Friction of a drive: dry, viscous, extra at rest, and unequal in the two directions.

Dry friction that depends on the load or on the place in the travel.

Dry friction that is a spring below breakaway: the bristles of a drive's seals and guides.
"""

import math

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    axes,
    changed,
    drive_kind,
    drive_turns,
    force_unit,
    largest_force,
    speed_unit,
    term_number,
    usual_speed,
    with_terms,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import Term


def _numbers(field: str, scale: float, high: float):
    """Sizes as fractions of the drive's largest force.

    Least is a thousandth of it (20 to 30 kPa over the piston, what a good transducer is off by) or
    a tenth of the present friction (what warm oil does within a shift).
    """

    def parameters(machine: Machine, location: str) -> dict[str, Parameter]:
        present = getattr(machine.axes[location].drive.friction, field)
        whole, unit = largest_force(machine, location), force_unit(machine, location)
        if field == "viscous":
            whole /= usual_speed(machine, location)
            unit = f"{unit}/({speed_unit(machine, location)})"
        least = max(0.001 * whole, 0.1 * present)
        size = max(scale * whole, 0.3 * present)
        return {field: Parameter(_UNITS.get(unit, unit), present, 0.0, present + high * whole,
                                 size, least)}  # fmt: skip

    return parameters


_UNITS = {"N/(m/s)": "N s/m", "N m/(rad/s)": "N m s/rad"}


def _set(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        path = f"axes.{location}.{drive_kind(machine, location)}.friction.{field}"
        machine = changed(machine, path, value)
    return machine


def _friction_places(machine: Machine) -> tuple[str, ...]:
    """Axes that have friction to be unequal."""
    present = {name: machine.axes[name].drive.friction for name in machine.axes}
    return tuple(n for n, f in present.items() if f.coulomb + f.stribeck_extra + f.viscous > 0)


def _asymmetry(machine: Machine, location: str) -> dict[str, Parameter]:
    """Fractions: seals with a lip differ by tens of per cent; least is 2 %."""
    friction = machine.axes[location].drive.friction
    sizes = {}
    if friction.coulomb + friction.stribeck_extra > 0:
        sizes["coulomb_asymmetry"] = friction.coulomb_asymmetry
    if friction.viscous > 0:
        sizes["viscous_asymmetry"] = friction.viscous_asymmetry
    return {name: Parameter("1", present, -0.9, 0.9, 0.2, 0.02) for name, present in sizes.items()}


FRICTION = (
    Effect(
        "coulomb_friction", "another Coulomb friction of a drive", "force", axes,
        _numbers("coulomb", 0.02, 0.08), _set,
    ),
    Effect(
        "viscous_friction", "another viscous friction of a drive", "force", axes,
        _numbers("viscous", 0.015, 0.1), _set,
    ),
    Effect(
        "stribeck_friction", "another extra friction at rest", "force", axes,
        _numbers("stribeck_extra", 0.01, 0.05), _set,
    ),
    Effect(
        "friction_asymmetry", "friction that is larger in one direction of a drive", "force",
        _friction_places, _asymmetry, _set,
    ),
)  # fmt: skip


LOAD, PLACE = "load_dependent_friction", "position_dependent_friction"


def _coefficient(machine: Machine, location: str) -> dict[str, Parameter]:
    """Seals and guides rub with some per cent of the load; least is half a per cent."""
    present = term_number(machine, LOAD, location, "force", "coefficient", 0.0)
    return {"coefficient": Parameter("1", present, 0.0, max(0.4, present), 0.03, 0.005)}


def _smoothing(machine: Machine, location: str) -> float:
    return machine.axes[location].drive.friction.smoothing_velocity


def _set_coefficient(machine: Machine, location: str, values: Values) -> Machine:
    numbers = {**values, "smoothing_velocity": _smoothing(machine, location)}
    term = Term(name=LOAD, axis=location, balance="force", law="load_friction", parameters=numbers)
    return with_terms(machine, LOAD, [term] if values["coefficient"] else [], [location])


def _travel(machine: Machine, location: str) -> tuple[float, float]:
    """Range of a drive's position [m] or [rad]; of one that turns without end, once around."""
    axis = machine.axes[location]
    if axis.cylinder:
        return 0.0, axis.cylinder.stroke
    turns = machine.position_kind(location) == "angle"
    widest = (-math.pi, math.pi) if turns else (-0.5, 0.5)
    return machine.joints[axis.joint].range or widest


def _bump(machine: Machine, location: str) -> dict[str, Parameter]:
    """Force as of Coulomb friction; a bent rod or a worn tooth spans a tenth of the travel."""

    def present(parameter: str, absent: float) -> float:
        return term_number(machine, PLACE, location, "force", parameter, absent)

    low, high = _travel(machine, location)
    span, whole = high - low, largest_force(machine, location)
    coulomb, centre = present("coulomb", 0.0), present("centre", low + 0.5 * span)
    width = present("width", 0.1 * span)
    unit = "m" if force_unit(machine, location) == "N" else "rad"
    return {
        "coulomb": Parameter(
            force_unit(machine, location), coulomb, 0.0, coulomb + 0.2 * whole, 0.02 * whole,
            0.001 * whole,
        ),
        "centre": Parameter(
            unit, centre, min(low, centre), max(high, centre), 0.25 * span, 0.01 * span
        ),
        "width": Parameter(unit, width, 0.005 * span, 0.5 * span, 0.05 * span, 0.01 * span),
    }  # fmt: skip


def _set_bump(machine: Machine, location: str, values: Values) -> Machine:
    numbers = {**values, "smoothing_velocity": _smoothing(machine, location)}
    term = Term(name=PLACE, axis=location, balance="force", law="friction_bump", parameters=numbers)
    return with_terms(machine, PLACE, [term] if values["coulomb"] else [], [location])


UNEVEN_FRICTION = (
    Effect(
        LOAD, "dry friction that grows with the drive's load", "force", axes, _coefficient,
        _set_coefficient,
    ),
    Effect(
        PLACE, "more dry friction at one place of the travel", "force", axes, _bump, _set_bump
    ),
)  # fmt: skip


_WAY, _TURN = 5.0e-5, 2.0e-4  # m, rad: what seals and gears give before they slide, an estimate
_RIGID = 0.02  # of the least compliance worth naming: friction as without bristles


def _presliding_places(machine: Machine) -> tuple[str, ...]:
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


def _set_presliding(machine: Machine, location: str, values: Values) -> Machine:
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


PRESLIDING = Effect(
    "presliding", "dry friction that gives like a spring before it slides", "force",
    _presliding_places,
    _compliance, _set_presliding,
)  # fmt: skip

EFFECTS = (*FRICTION, *UNEVEN_FRICTION, PRESLIDING)
