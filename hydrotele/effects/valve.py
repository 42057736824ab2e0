"""Valves that open later, wider or slower than in the model."""

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.drives import Valve
from hydrotele.machine.machine import Machine


def _valve(machine: Machine, location: str) -> Valve:
    valve = machine.axes[location].valve
    assert valve
    return valve


def _common_deadband(machine: Machine) -> tuple[str, ...]:
    """Valves that have a dead band for both directions, or for one of them."""
    return tuple(
        name for name in valves(machine)
        if any(way.deadband is None
               for way in (_valve(machine, name).positive, _valve(machine, name).negative))
    )  # fmt: skip


def _deadband(machine: Machine, location: str) -> dict[str, Parameter]:
    """Overlaps are a few per cent of the stroke; 0.4 % is a spool's usual hysteresis."""
    present = _valve(machine, location).deadband
    return {"deadband": Parameter("1", present, 0.0, max(0.3, present), 0.03, 0.004)}


def _set_deadband(machine: Machine, location: str, values: Values) -> Machine:
    return changed(machine, f"axes.{location}.valve.deadband", values["deadband"])


def _gain(machine: Machine, location: str) -> dict[str, Parameter]:
    """A makers' flow rating is good to 5 or 10 %; 2 % is the linearity of a spool.

    The range is that of another spool in the same body.
    """
    return {"ratio": Parameter("1", 1.0, 0.05, 5.0, 0.15, 0.02)}


def _scale_gain(machine: Machine, location: str, values: Values) -> Machine:
    flow = _valve(machine, location).rated_flow * values["ratio"]
    return changed(machine, f"axes.{location}.valve.rated_flow", flow)


def _bandwidth(machine: Machine, location: str) -> dict[str, Parameter]:
    """Least is 8 %, which at 8 Hz is a lag of 3 ms, as the least delay worth naming."""
    w = _valve(machine, location).bandwidth
    return {"bandwidth": Parameter("rad/s", w, 0.1 * w, 4.0 * w, 0.4 * w, 0.08 * w)}


def _set_bandwidth(machine: Machine, location: str, values: Values) -> Machine:
    return changed(machine, f"axes.{location}.valve.bandwidth", values["bandwidth"])


EFFECTS = (
    Effect(
        "valve_deadband",
        "another overlap of a valve",
        "valve",
        _common_deadband,
        _deadband,
        _set_deadband,
        "overlap",
    ),
    Effect(
        "valve_gain",
        "another flow gain of a valve",
        "valve",
        valves,
        _gain,
        _scale_gain,
        "flow gain",
    ),
    Effect(
        "spool_lag", "another bandwidth of a spool", "valve", valves, _bandwidth, _set_bandwidth
    ),
)
