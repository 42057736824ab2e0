"""Effects of unmodelled forces on a drive: constant, transient, or quadratic in the speed."""

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    axes,
    force_unit,
    largest_force,
    speed_unit,
    term_number,
    usual_speed,
    with_terms,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import Term

CONSTANT, PULSE, DRAG = "external_force", "force_pulse", "speed_dependent_force"
_BEGIN, _LENGTH = 5.0, 5.0  # s, start values of a search: a pulse without amplitude has no time
_DRAG_UNITS = {"N": "N s^2/m^2", "N m": "N m s^2/rad^2"}


def _force(machine: Machine, location: str) -> dict[str, Parameter]:
    """Specify the constant force, scaled by the drive's largest force.

    The smallest relevant force is a thousandth of the largest one, as for friction.
    """
    present = term_number(machine, CONSTANT, location, "force", "value", 0.0)
    whole = largest_force(machine, location)
    sizes = present - whole, present + whole, 0.02 * whole, 0.001 * whole
    return {"force": Parameter(force_unit(machine, location), present, *sizes)}


def _set_force(machine: Machine, location: str, values: Values) -> Machine:
    force = values["force"]
    term = Term(name=CONSTANT, axis=location, balance="force", law="constant",
                parameters={"value": force})  # fmt: skip
    return with_terms(machine, CONSTANT, [term] if force else [], [location])


def _pulse(machine: Machine, location: str) -> dict[str, Parameter]:
    """Specify amplitude, start and duration of a force pulse.

    The smallest relevant amplitude is three times that of a constant force, so that a pulse of one
    second is detectable. A pulse without amplitude has no time: see `_BEGIN`.
    """

    def present(parameter: str, absent: float) -> float:
        return term_number(machine, PULSE, location, "force", parameter, absent)

    size, whole = present("size", 0.0), largest_force(machine, location)
    start, duration = present("start", _BEGIN), present("duration", _LENGTH)
    return {
        "size": Parameter(
            force_unit(machine, location), size, size - 2.0 * whole, size + 2.0 * whole,
            0.03 * whole, 0.003 * whole,
        ),
        "start": Parameter("s", start, 0.0, 36000.0, 20.0, 0.05),
        "duration": Parameter("s", duration, 0.02, 600.0, 5.0, 0.05),
    }  # fmt: skip


def _set_pulse(machine: Machine, location: str, values: Values) -> Machine:
    term = Term(name=PULSE, axis=location, balance="force", law="pulse", parameters=dict(values))
    return with_terms(machine, PULSE, [term] if values["size"] else [], [location])


def _drag(machine: Machine, location: str) -> dict[str, Parameter]:
    """Specify the drag coefficient, scaled by the drive's largest force at its typical speed.

    The fractions are those of viscous friction.
    """
    present = term_number(machine, DRAG, location, "force", "coefficient", 0.0)
    whole = largest_force(machine, location) / usual_speed(machine, location) ** 2
    unit = _DRAG_UNITS["N m" if speed_unit(machine, location) == "rad/s" else "N"]
    sizes = present + 0.2 * whole, 0.015 * whole, 0.001 * whole
    return {"coefficient": Parameter(unit, present, 0.0, *sizes)}


def _set_drag(machine: Machine, location: str, values: Values) -> Machine:
    term = Term(name=DRAG, axis=location, balance="force", law="quadratic_drag",
                parameters=dict(values))  # fmt: skip
    return with_terms(machine, DRAG, [term] if values["coefficient"] else [], [location])


EFFECTS = (
    Effect(CONSTANT, "a constant force or torque on a drive", "force", axes, _force, _set_force),
    Effect(
        PULSE,
        "a force or torque on a drive for a limited time",
        "force",
        axes,
        _pulse,
        _set_pulse,
    ),
    Effect(
        DRAG,
        "a resisting force that grows with the square of the speed",
        "force",
        axes,
        _drag,
        _set_drag,
    ),
)
