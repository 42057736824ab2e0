"""A command that arrives with an offset: a valve's or an amplifier's zero is off."""

from hydrotele.effects._terms import term_number, with_terms
from hydrotele.effects.effect import Effect, Parameter, Values
from hydrotele.machine.machine import Machine
from hydrotele.terms.facts import Term

NAME = "command_offset"


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """A valve's null shifts by a few per cent; 0.2 % of the full command is its hysteresis."""
    drive = machine.axes[location].force
    full, unit = (drive.command_limit, drive.command_unit) if drive else (1.0, "1")
    present = term_number(machine, NAME, location, "command", "value", 0.0)
    sizes = present - 0.2 * full, present + 0.2 * full, 0.02 * full, 0.002 * full
    return {"offset": Parameter(unit, present, *sizes)}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    offset = values["offset"]
    term = Term(name=NAME, axis=location, balance="command", law="constant",
                parameters={"value": offset})  # fmt: skip
    return with_terms(machine, NAME, [term] if offset else [], [location])


def _graded(machine: Machine) -> tuple[str, ...]:
    """Axes whose zero can be off: at a pump drive's command 0 a switched valve is shut."""
    return tuple(name for name, axis in machine.axes.items() if not axis.pump)


EFFECT = Effect(NAME, "commands that arrive with an offset", "valve", _graded, _parameters, _apply)
