"""Commands that arrive late."""

from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine

ALL = "all"


def _locations(machine: Machine) -> tuple[str, ...]:
    return (ALL, *machine.axes)


def _nominal(machine: Machine, location: str) -> float:
    delays = {name: axis.command_delay for name, axis in machine.axes.items()}
    return min(delays.values()) if location == ALL else delays[location]


def _parameters(machine: Machine, location: str) -> dict[str, Parameter]:
    """A bus takes milliseconds, pilot hydraulics a tenth of a second; 3 ms is one bus cycle."""
    present = _nominal(machine, location)
    high = max(0.5, present)
    return {"delay": Parameter("s", present, 0.0, high, 0.05, 0.003, starts=(0.03, 0.1, 0.2))}


def _apply(machine: Machine, location: str, values: Values) -> Machine:
    """Set the delay of one axis; at `all`, set the shortest and shift the others by as much."""
    more = values["delay"] - _nominal(machine, location)
    for name in machine.axes if location == ALL else (location,):
        delay = max(0.0, machine.axes[name].command_delay + more)
        machine = changed(machine, f"axes.{name}.command_delay", delay)
    return machine


EFFECT = Effect(
    "command_delay", "commands reach the valves or drives late", "timing", _locations, _parameters,
    _apply,
)  # fmt: skip
