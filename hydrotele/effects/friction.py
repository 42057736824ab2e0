"""Effects of drive friction.

The module covers Coulomb, viscous and Stribeck friction, their asymmetry between the two
directions, and dry friction that depends on load or position. Presliding is dry friction that acts
as a spring below breakaway, as the bristles of seals and guides do.
"""

import math

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    all_axes,
    drive_kind,
    force_unit,
    is_rotary_drive,
    max_drive_force,
    speed_unit,
    term_parameter,
    typical_speed,
    with_terms,
    with_value,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term


def _make_friction_parameters(field: str, scale: float, high: float):
    """Return a function (machine, location) -> nominal value, bounds and prior of a friction parameter.

    The smallest relevant change is the larger of two values: a thousandth of the drive's largest
    force (error of a good pressure transducer), and a tenth of the given friction (change by warm
    oil).

    Args:
        field: field of the machine's friction: `coulomb`, `viscous`, or `stribeck_extra`, the
            additional friction at low speed.
        scale: smallest standard deviation of the prior as a fraction of the drive's largest force
            [1]; for viscous friction that force is divided by the typical speed. The standard
            deviation is at least 30 % of the given friction.
        high: upper bound minus nominal value, as a fraction of the same force [1].
    """

    def friction_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
        present = getattr(machine.axes[location].drive.friction, field)
        whole, unit = max_drive_force(machine, location), force_unit(machine, location)
        if field == "viscous":
            whole /= typical_speed(machine, location)
            unit = f"{unit}/({speed_unit(machine, location)})"
        least = max(0.001 * whole, 0.1 * present)
        size = max(scale * whole, 0.3 * present)
        return {field: Parameter(_UNITS.get(unit, unit), present, 0.0, present + high * whole,
                                 size, least)}  # fmt: skip

    return friction_parameters


_UNITS = {"N/(m/s)": "N s/m", "N m/(rad/s)": "N m s/rad"}


def _set_friction(machine: Machine, location: str, values: Values) -> Machine:
    for field, value in values.items():
        path = f"axes.{location}.{drive_kind(machine, location)}.friction.{field}"
        machine = with_value(machine, path, value)
    return machine


def _friction_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drive has Coulomb, Stribeck or viscous friction, which may be asymmetric."""
    present = {name: machine.axes[name].drive.friction for name in machine.axes}
    return tuple(n for n, f in present.items() if f.coulomb + f.stribeck_extra + f.viscous > 0)


def _asymmetry_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of the direction dependence of a drive's friction.

    The parameters are one relative asymmetry for dry and one for viscous friction, each only if the
    drive has such friction. The friction of lip seals differs by tens of per cent between the
    directions. The smallest relevant change is 0.02.
    """
    friction = machine.axes[location].drive.friction
    sizes = {}
    if friction.coulomb + friction.stribeck_extra > 0:
        sizes["coulomb_asymmetry"] = friction.coulomb_asymmetry
    if friction.viscous > 0:
        sizes["viscous_asymmetry"] = friction.viscous_asymmetry
    return {name: Parameter("1", present, -0.9, 0.9, 0.2, 0.02) for name, present in sizes.items()}


BASIC_FRICTION_EFFECTS = (
    Effect(
        "coulomb_friction", "Coulomb friction of a drive that differs from the model", "force",
        all_axes, _make_friction_parameters("coulomb", 0.02, 0.08), _set_friction,
    ),
    Effect(
        "viscous_friction", "viscous friction of a drive that differs from the model", "force",
        all_axes, _make_friction_parameters("viscous", 0.015, 0.1), _set_friction,
    ),
    Effect(
        "stribeck_friction", "Stribeck friction of a drive that differs from the model", "force",
        all_axes, _make_friction_parameters("stribeck_extra", 0.01, 0.05), _set_friction,
    ),
    Effect(
        "friction_asymmetry", "larger friction in one direction of a drive", "force",
        _friction_axes, _asymmetry_parameters, _set_friction,
    ),
)  # fmt: skip


LOAD_FRICTION, POSITION_FRICTION = "load_dependent_friction", "position_dependent_friction"


def _load_friction_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the ratio of dry friction to the load of a drive.

    The friction of seals and guides is some per cent of the load. The smallest relevant change is
    0.005.
    """
    present = term_parameter(machine, LOAD_FRICTION, location, "force", "coefficient", 0.0)
    return {"coefficient": Parameter("1", present, 0.0, max(0.4, present), 0.03, 0.005)}


def _smoothing_velocity(machine: Machine, location: str) -> float:
    return machine.axes[location].drive.friction.smoothing_velocity


def _set_load_friction(machine: Machine, location: str, values: Values) -> Machine:
    numbers = {**values, "smoothing_velocity": _smoothing_velocity(machine, location)}
    term = Term(name=LOAD_FRICTION, axis=location, balance="force", law="load_friction", parameters=numbers)
    return with_terms(machine, LOAD_FRICTION, [term] if values["coefficient"] else [], [location])


def _position_range(machine: Machine, location: str) -> tuple[float, float]:
    """Return lowest and highest position of a drive [m] or [rad].

    For a cylinder they are 0 and the stroke, otherwise the joint's range. For a joint without a
    range they are +-pi rad or +-0.5 m.
    """
    axis = machine.axes[location]
    if axis.cylinder:
        return 0.0, axis.cylinder.stroke
    turns = machine.position_kind(location) == "angle"
    widest = (-math.pi, math.pi) if turns else (-0.5, 0.5)
    return machine.joints[axis.joint].range or widest


def _bump_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of additional dry friction at one position of a drive.

    The parameters are its height `coulomb` (a friction force), `centre` and `width`. A height of 0 means
    no additional friction. Centre and width are then without effect; their nominal values, the middle
    and a tenth of the travel (as of a bent rod or a worn tooth), are the means of their priors.
    """

    def present_value(parameter: str, absent: float) -> float:
        return term_parameter(machine, POSITION_FRICTION, location, "force", parameter, absent)

    low, high = _position_range(machine, location)
    span, whole = high - low, max_drive_force(machine, location)
    coulomb, centre = present_value("coulomb", 0.0), present_value("centre", low + 0.5 * span)
    width = present_value("width", 0.1 * span)
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
    numbers = {**values, "smoothing_velocity": _smoothing_velocity(machine, location)}
    term = Term(
        name=POSITION_FRICTION,
        axis=location,
        balance="force",
        law="friction_bump",
        parameters=numbers,
    )
    return with_terms(machine, POSITION_FRICTION, [term] if values["coulomb"] else [], [location])


NONUNIFORM_FRICTION_EFFECTS = (
    Effect(
        LOAD_FRICTION, "dry friction that grows with the drive's load", "force", all_axes, _load_friction_parameters,
        _set_load_friction,
    ),
    Effect(
        POSITION_FRICTION, "additional dry friction at one position of the travel", "force", all_axes, _bump_parameters,
        _set_bump,
    ),
)  # fmt: skip


_LINEAR_DEFLECTION_M, _ANGULAR_DEFLECTION_RAD = (
    5.0e-5,
    2.0e-4,
)  # m, rad: deflection of seals and gears before sliding, an estimate
_MIN_COMPLIANCE_RATIO = 0.02  # of the smallest relevant compliance: below it, friction without bristles


def _presliding_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drive has dry friction (Coulomb or Stribeck), except axes with an own pump.

    The model of axes with an own pump has no presliding.
    """
    found = {name: axis.drive.friction for name, axis in machine.axes.items() if not axis.pump}
    return tuple(name for name, f in found.items() if f.coulomb + f.stribeck_extra > 0.0)


def _presliding_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the compliance of dry friction before sliding.

    The friction acts as a spring (bristles of seals and guides) up to breakaway; 0 means no spring.
    Metal surfaces deflect by some micrometres before they slide, rubber seals by up to a tenth of a
    millimetre. The smallest relevant deflection at the breakaway force is 10 um or 40 urad.
    """
    friction, turns = machine.axes[location].drive.friction, is_rotary_drive(machine, location)
    usual = (_ANGULAR_DEFLECTION_RAD if turns else _LINEAR_DEFLECTION_M) / (friction.coulomb + friction.stribeck_extra)
    stiffness = friction.presliding_stiffness
    present = 1.0 / stiffness if stiffness else 0.0
    return {
        "compliance": Parameter(
            "rad/(N m)" if turns else "m/N", present, 0.0, max(20.0 * usual, present), usual,
            0.2 * usual, start_values=(0.4 * usual, usual, 4.0 * usual),
        )
    }  # fmt: skip


def _set_presliding(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with a friction stiffness of 1 / compliance before sliding, at one drive.

    Below 2 % of the smallest relevant compliance the stiffness is set to 0, which means dry
    friction without a spring. With the present compliance, the machine is returned unchanged.
    """
    compliance = values["compliance"]
    number = _presliding_parameters(machine, location)["compliance"]
    if compliance == number.nominal:
        return machine
    stiffness = 1.0 / compliance if compliance >= _MIN_COMPLIANCE_RATIO * number.min_relevant_change else 0.0
    path = f"axes.{location}.{drive_kind(machine, location)}.friction"
    if not stiffness:
        machine = with_value(machine, f"{path}.presliding_damping", 0.0)
    return with_value(machine, f"{path}.presliding_stiffness", stiffness)


PRESLIDING = Effect(
    "presliding", "dry friction that acts as a spring before sliding", "force",
    _presliding_axes,
    _presliding_parameters, _set_presliding,
)  # fmt: skip

EFFECTS = (*BASIC_FRICTION_EFFECTS, *NONUNIFORM_FRICTION_EFFECTS, PRESLIDING)
