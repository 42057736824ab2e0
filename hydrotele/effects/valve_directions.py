"""Valves whose two directions differ: notches, springs and centring are not made alike."""

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.drives import Valve
from hydrotele.machine.machine import Machine

DIRECTIONS = ("positive", "negative")


def _valve(machine: Machine, location: str) -> Valve:
    valve = machine.axes[location].valve
    assert valve
    return valve


def _gains(machine: Machine, location: str) -> dict[str, Parameter]:
    """As the flow gain of a whole valve: rated to 5 or 10 %, linear to 2 %."""
    return dict.fromkeys(DIRECTIONS, Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02))


def _scale_gains(machine: Machine, location: str, values: Values) -> Machine:
    for direction in DIRECTIONS:
        present = getattr(_valve(machine, location), direction)
        for edge in ("inlet", "outlet"):
            path = f"axes.{location}.valve.{direction}.{edge}"
            machine = changed(machine, path, getattr(present, edge) * values[direction])
    return machine


def _deadbands(machine: Machine, location: str) -> dict[str, Parameter]:
    """As the overlap of a whole valve, with room for a spool off its centre."""
    present = _valve(machine, location).deadbands
    return {
        direction: Parameter("1", band, 0.0, max(0.6, band), 0.03, 0.004)
        for direction, band in zip(DIRECTIONS, present, strict=True)
    }


def _set_deadbands(machine: Machine, location: str, values: Values) -> Machine:
    present = _valve(machine, location).deadbands
    for direction, band in zip(DIRECTIONS, present, strict=True):
        if values[direction] != band:
            path = f"axes.{location}.valve.{direction}.deadband"
            machine = changed(machine, path, values[direction])
    return machine


EFFECTS = (
    Effect(
        "valve_gain_direction", "flow gains of a valve that differ between its directions", "valve",
        valves, _gains, _scale_gains, "flow gain",
    ),
    Effect(
        "valve_deadband_direction", "overlaps of a valve that differ between its directions",
        "valve", valves, _deadbands, _set_deadbands, "overlap",
    ),
)  # fmt: skip
