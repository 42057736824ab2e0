"""Spools that a small pilot stage moves no faster than at a limited rate."""

from hydrotele.effects._sizes import valves
from hydrotele.effects.effect import Effect, Parameter, Values, changed
from hydrotele.machine.machine import Machine


def _travel_time(machine: Machine, location: str) -> dict[str, Parameter]:
    """Time from centre to full opening, in units of the spool's own 1 / w; 0 without a limit.

    A step to full opening moves a free spool of damping 0.9 at most at 0.38 w, so that a limit is
    felt from a travel time of 2.6 / w on; the sizes are estimates, 3 times that and more.
    """
    valve = machine.axes[location].valve
    assert valve
    own = 1.0 / valve.bandwidth
    present = 1.0 / valve.slew_limit if valve.slew_limit else 0.0
    return {
        "travel_time": Parameter(
            "s", present, 0.0, max(200.0 * own, present), 8.0 * own, 4.0 * own,
            starts=(8.0 * own, 40.0 * own),
        )
    }  # fmt: skip


def _set(machine: Machine, location: str, values: Values) -> Machine:
    limit = 1.0 / values["travel_time"] if values["travel_time"] > 0.0 else None
    valve = machine.axes[location].valve
    assert valve
    if valve.slew_limit and limit and abs(limit / valve.slew_limit - 1.0) < 1.0e-15:
        return machine  # the reciprocal of a reciprocal may be off by a rounding
    return changed(machine, f"axes.{location}.valve.slew_limit", limit)


EFFECT = Effect(
    "spool_slew", "a spool that moves no faster than its pilot stage lets it", "valve", valves,
    _travel_time, _set,
)  # fmt: skip
