"""Effect of end stops whose stiffness differs from the model."""

from hydrotele.effects.effect import Effect, Parameter, Values, is_rotary_drive, with_value
from hydrotele.machine.drives import EndStop
from hydrotele.machine.machine import Machine


def _end_stop_axes(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes whose drives have end stops."""
    return tuple(name for name in machine.axes if machine.end_stop(name))


def _stiffness_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the stiffness of a drive's end stops.

    The bounds are wide, 1 % and 20 times the given stiffness: a cushion, for example, is fifty times
    more compliant than steel. The smallest relevant change is 10 %.
    """
    stop = machine.end_stop(location)
    assert stop
    k = stop.stiffness
    unit = "N m/rad" if is_rotary_drive(machine, location) else "N/m"
    return {"stiffness": Parameter(unit, k, 0.01 * k, 20.0 * k, 0.5 * k, 0.1 * k)}


def _set_stiffness(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with another end stop stiffness.

    The damping changes in proportion, so that the time constant damping / stiffness remains.
    """
    stop = machine.end_stop(location)
    assert stop
    if values["stiffness"] == stop.stiffness:
        return machine
    damping = stop.damping * values["stiffness"] / stop.stiffness
    other = EndStop(stiffness=values["stiffness"], damping=damping)
    return with_value(machine, f"axes.{location}.end_stop", other)


EFFECT = Effect(
    "end_stop_stiffness", "end stop stiffness of a drive that differs from the model", "force",
    _end_stop_axes, _stiffness_parameters, _set_stiffness,
)  # fmt: skip
