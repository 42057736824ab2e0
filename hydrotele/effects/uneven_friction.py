"""Dry friction that depends on the load or on the place in the travel."""

import math

from hydrotele.effects._sizes import axes, force_unit, largest_force
from hydrotele.effects._terms import term_number, with_terms
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import Term

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


EFFECTS = (
    Effect(
        LOAD, "dry friction that grows with the drive's load", "force", axes, _coefficient,
        _set_coefficient,
    ),
    Effect(
        PLACE, "more dry friction at one place of the travel", "force", axes, _bump, _set_bump
    ),
)  # fmt: skip
