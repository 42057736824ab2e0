"""Effects of the command path: delay, and offset from a shifted null of a valve or amplifier."""

from hydrotele.effects.effect import (
    Effect,
    Parameter,
    Values,
    term_parameter,
    with_terms,
    with_value,
)
from hydrotele.machine.machine import Machine
from hydrotele.terms.term import Term

ALL_AXES = "all"


def _delay_locations(machine: Machine) -> tuple[str, ...]:
    return (ALL_AXES, *machine.axes)


def _nominal_delay(machine: Machine, location: str) -> float:
    delays = {name: axis.command_delay for name, axis in machine.axes.items()}
    return min(delays.values()) if location == ALL_AXES else delays[location]


def _delay_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of the command delay of an axis, or of all axes (location `all`).

    A fieldbus delays by milliseconds, pilot hydraulics by a tenth of a second. The smallest
    relevant change is 3 ms, one bus cycle.
    """
    present = _nominal_delay(machine, location)
    high = max(0.5, present)
    return {"delay": Parameter("s", present, 0.0, high, 0.05, 0.003, start_values=(0.03, 0.1, 0.2))}


def _set_delay(machine: Machine, location: str, values: Values) -> Machine:
    """Return the machine with another command delay of an axis.

    At the location `all` the value becomes the shortest delay, and all other delays change by the same
    time, but not below 0.
    """
    more = values["delay"] - _nominal_delay(machine, location)
    for name in machine.axes if location == ALL_AXES else (location,):
        delay = max(0.0, machine.axes[name].command_delay + more)
        machine = with_value(machine, f"axes.{name}.command_delay", delay)
    return machine


COMMAND_DELAY = Effect(
    "command_delay", "delayed commands to the valves or drives", "timing", _delay_locations, _delay_parameters,
    _set_delay,
)  # fmt: skip


NAME = "command_offset"


def _offset_parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Return nominal value, bounds and prior of an offset that is added to the received command.

    The null position of a valve shifts by a few per cent of the full command. The smallest relevant
    change is 0.2 %, the hysteresis of a valve.
    """
    drive = machine.axes[location].force
    full, unit = (drive.command_limit, drive.command_unit) if drive else (1.0, "1")
    present = term_parameter(machine, NAME, location, "command", "value", 0.0)
    sizes = present - 0.2 * full, present + 0.2 * full, 0.02 * full, 0.002 * full
    return {"offset": Parameter(unit, present, *sizes)}


def _set_offset(machine: Machine, location: str, values: Values) -> Machine:
    offset = values["offset"]
    term = Term(name=NAME, axis=location, balance="command", law="constant",
                parameters={"value": offset})  # fmt: skip
    return with_terms(machine, NAME, [term] if offset else [], [location])


def _axes_without_own_pump(machine: Machine) -> tuple[str, ...]:
    """Return the names of the axes for which an offset of the command can be simulated.

    Axes that are driven by an own pump are excluded. There, command 0 closes a switching valve, which any
    offset would keep open.
    """
    return tuple(name for name, axis in machine.axes.items() if not axis.pump)


COMMAND_OFFSET = Effect(
    NAME,
    "an offset of the received command",
    "valve",
    _axes_without_own_pump,
    _offset_parameters,
    _set_offset,
)

EFFECTS = (COMMAND_DELAY, COMMAND_OFFSET)
