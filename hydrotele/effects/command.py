"""Effects of the command path: delay, and offset from a shifted null of a valve or amplifier."""

from hydrotele.effects.effect import Effect, Parameter, Values, changed, term_number, with_terms
from hydrotele.machine.machine import Machine
from hydrotele.terms.law import Term

ALL = "all"


def _locations(machine: Machine) -> tuple[str, ...]:
    return (ALL, *machine.axes)


def _nominal(machine: Machine, location: str) -> float:
    delays = {name: axis.command_delay for name, axis in machine.axes.items()}
    return min(delays.values()) if location == ALL else delays[location]


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """Specify the command delay.

    A bus delays by milliseconds, pilot hydraulics by a tenth of a second; 3 ms is one bus cycle.
    """
    present = _nominal(machine, location)
    high = max(0.5, present)
    return {"delay": Parameter("s", present, 0.0, high, 0.05, 0.003, starts=(0.03, 0.1, 0.2))}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Set the delay of one axis, or at `all` the shortest one and shift the others equally."""
    more = values["delay"] - _nominal(machine, location)
    for name in machine.axes if location == ALL else (location,):
        delay = max(0.0, machine.axes[name].command_delay + more)
        machine = changed(machine, f"axes.{name}.command_delay", delay)
    return machine


COMMAND_DELAY = Effect(
    "command_delay", "delayed commands to the valves or drives", "timing", _locations, _parameters,
    _apply,
)  # fmt: skip


NAME = "command_offset"


def _parameters_command_offset(machine: Machine, location: str) -> dict[str, Parameter]:
    """Specify the command offset.

    A valve's null shifts by a few per cent; its hysteresis is 0.2 % of the full command.
    """
    drive = machine.axes[location].force
    full, unit = (drive.command_limit, drive.command_unit) if drive else (1.0, "1")
    present = term_number(machine, NAME, location, "command", "value", 0.0)
    sizes = present - 0.2 * full, present + 0.2 * full, 0.02 * full, 0.002 * full
    return {"offset": Parameter(unit, present, *sizes)}


def _apply_command_offset(machine: Machine, location: str, values: Values) -> Machine:
    offset = values["offset"]
    term = Term(name=NAME, axis=location, balance="command", law="constant",
                parameters={"value": offset})  # fmt: skip
    return with_terms(machine, NAME, [term] if offset else [], [location])


def _graded(machine: Machine) -> tuple[str, ...]:
    """Return the axes whose null can shift.

    Axes with their own pump are excluded: at command 0 their switching valve is closed.
    """
    return tuple(name for name, axis in machine.axes.items() if not axis.pump)


COMMAND_OFFSET = Effect(
    NAME,
    "an offset of the received command",
    "valve",
    _graded,
    _parameters_command_offset,
    _apply_command_offset,
)

EFFECTS = (COMMAND_DELAY, COMMAND_OFFSET)
