"""Effects of unmodelled forces on a drive: constant, transient, or quadratic in the speed."""

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    all_axes,
    force_unit,
    max_drive_force,
    speed_unit,
    term_parameter,
    typical_speed,
    with_terms,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

CONSTANT_FORCE, FORCE_PULSE, SPEED_DEPENDENT_FORCE = (
    "external_force",
    "force_pulse",
    "speed_dependent_force",
)
_PULSE_START_S, _PULSE_DURATION_S = (
    5.0,
    5.0,
)  # s, start values of a search: a pulse without amplitude has no time
_DRAG_UNITS = {"N": "N s^2/m^2", "N m": "N m s^2/rad^2"}


def _force_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of a constant force on a drive.

    Bounds and prior are fractions of the drive's largest force. The smallest relevant change is a
    thousandth of that force, as for friction.
    """
    present = term_parameter(machine, CONSTANT_FORCE, location, "force", "value", 0.0)
    whole = max_drive_force(machine, location)
    sizes = present - whole, present + whole, 0.02 * whole, 0.001 * whole
    return {"force": Parameter(force_unit(machine, location), present, *sizes)}


def _set_force(machine: Machine, location: str, values: Values) -> Machine:
    force = values["force"]
    term = Term(name=CONSTANT_FORCE, axis=location, balance="force", law="constant",
                parameters={"value": force})  # fmt: skip
    return with_terms(machine, CONSTANT_FORCE, [term] if force else [], [location])


def _pulse_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal values, bounds and priors of amplitude, start and duration of a force pulse.

    The smallest relevant amplitude is three times that of a constant force, so that a pulse of one
    second is detectable. A size of 0 means no pulse. The nominal start and duration of 5 s are then only
    the values with which a search begins.
    """

    def present_value(parameter: str, absent: float) -> float:
        return term_parameter(machine, FORCE_PULSE, location, "force", parameter, absent)

    size, whole = present_value("size", 0.0), max_drive_force(machine, location)
    start, duration = present_value("start", _PULSE_START_S), present_value("duration", _PULSE_DURATION_S)
    return {
        "size": Parameter(
            force_unit(machine, location), size, size - 2.0 * whole, size + 2.0 * whole,
            0.03 * whole, 0.003 * whole,
        ),
        "start": Parameter("s", start, 0.0, 36000.0, 20.0, 0.05),
        "duration": Parameter("s", duration, 0.02, 600.0, 5.0, 0.05),
    }  # fmt: skip


def _set_pulse(machine: Machine, location: str, values: Values) -> Machine:
    term = Term(name=FORCE_PULSE, axis=location, balance="force", law="pulse", parameters=dict(values))
    return with_terms(machine, FORCE_PULSE, [term] if values["size"] else [], [location])


def _drag_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the coefficient of drag, force over speed squared.

    Let c_0 be the drive's largest force over the square of its speed at the rated flow. The upper bound
    is the nominal value plus 0.2 c_0, the prior standard deviation 0.015 c_0, and the smallest relevant
    change 0.001 c_0.
    """
    present = term_parameter(machine, SPEED_DEPENDENT_FORCE, location, "force", "coefficient", 0.0)
    whole = max_drive_force(machine, location) / typical_speed(machine, location) ** 2
    unit = _DRAG_UNITS["N m" if speed_unit(machine, location) == "rad/s" else "N"]
    sizes = present + 0.2 * whole, 0.015 * whole, 0.001 * whole
    return {"coefficient": Parameter(unit, present, 0.0, *sizes)}


def _set_drag(machine: Machine, location: str, values: Values) -> Machine:
    term = Term(name=SPEED_DEPENDENT_FORCE, axis=location, balance="force", law="quadratic_drag",
                parameters=dict(values))  # fmt: skip
    return with_terms(machine, SPEED_DEPENDENT_FORCE, [term] if values["coefficient"] else [], [location])


EFFECTS = (
    Effect(
        CONSTANT_FORCE,
        "a constant force or torque on a drive",
        "force",
        all_axes,
        _force_parameters,
        _set_force,
    ),
    Effect(
        FORCE_PULSE,
        "a force or torque on a drive for a limited time",
        "force",
        all_axes,
        _pulse_parameters,
        _set_pulse,
    ),
    Effect(
        SPEED_DEPENDENT_FORCE,
        "a resisting force that grows with the square of the speed",
        "force",
        all_axes,
        _drag_parameters,
        _set_drag,
    ),
)
