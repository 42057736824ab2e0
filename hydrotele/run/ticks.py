"""Control ticks of a run in native code, one after the other while nothing else is to be done.

Between two ticks Python would push machine and joystick out of the processor's caches: a tick in
contact takes a fifth longer then, one of a bare plan an eighth.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numba import boolean, int64, typeof

from hydrotele.control.tick import PLANNED, planned_tick
from hydrotele.core.compiled import compile_elsewhere, compiled
from hydrotele.core.memory import address_record, floats, integers, rows_of
from hydrotele.simulate.closure import pin_sites, widest_pin
from hydrotele.simulate.joystick import FLOTOR
from hydrotele.simulate.record import CONTACTS, STATE_ROW, take_row
from hydrotele.simulate.stepping import SIMULATION
from hydrotele.teleop.round_trip import CHECKED, STATION, round_trip

TICKS = np.dtype(
    [(name, np.int64) for name in ("steps", "every", "rows", "sites", "pins")]
    + [("period", np.float64)]
    + [(name, np.int64) for name in ("places", "one", "two", "widest")],  # addresses
    align=True,
)
"""Record of Ticks."""


class Ticks(NamedTuple):
    """What native ticks need beside machine, plan and station.

    Attributes:
        record: (1,) for native code.
        widest: (1,) largest opening of a pin so far [m].
        kept: arrays whose addresses the record has.
    """

    record: np.ndarray
    widest: np.ndarray
    kept: dict[str, np.ndarray]


def ticks_of(
    model: mujoco.MjModel, data: mujoco.MjData, steps: int, every: int, rows: int, period: float
) -> Ticks:  # fmt: skip
    """Prepare the ticks of a run.

    Args:
        model: the plant's.
        data: its state.
        steps: physics steps per tick.
        every: ticks per row of the logs.
        rows: number of rows.
        period: of a tick [s].
    """
    one, two = pin_sites(model)
    widest = np.zeros(1)
    kept = {"places": data.site_xpos, "one": one.astype(np.int64), "two": two.astype(np.int64),
            "widest": widest}  # fmt: skip
    record = address_record(TICKS, kept)
    for name, value in {"steps": steps, "every": every, "rows": rows, "period": period,
                        "sites": model.nsite, "pins": len(one)}.items():  # fmt: skip
        record[name] = value
    return Ticks(record, widest, kept)


@compiled
def planned_ticks(ticks, simulated, planned, row, contacts, first, last, stopped):
    """Go on along a plan.

    Args:
        ticks: `Ticks.record`, written.
        simulated: record of `simulate.stepping.simulation_record`.
        planned: record of `control.tick.planned_record`.
        row: record of a `Recorder`.
        contacts: record of `simulate.record.contact_record`.
        first: control tick, scalar.
        last: the one before which to stop, scalar.
        stopped: whether all commands are 0, scalar.

    Returns:
        The tick to go on with, scalar: `last`; or -1 less the one whose row is not finite.

    Source: `control.tick`.
    """
    for tick in range(first, last):
        if not _write_down(ticks[0], row, contacts, tick):
            return -1 - tick
        planned_tick(simulated, planned, tick, ticks[0].steps, stopped)
        look_at_pins(ticks)
    return last


@compiled
def teleoperated_ticks(
    ticks, simulated, planned, row, contacts, station, flotor, first, last, stopped
):  # fmt: skip
    """Go on with a station; stop before the physics of a tick at which it is to be looked at.

    Args:
        ticks: see `planned_ticks`, written.
        simulated: see `planned_ticks`.
        planned: see `planned_ticks`.
        row: see `planned_ticks`.
        contacts: see `planned_ticks`.
        station: see `teleop.round_trip`.
        flotor: see `teleop.round_trip`.
        first: control tick, prepared, scalar.
        last: the one before which to stop, scalar.
        stopped: whether the machine has been stopped for good, scalar.

    Returns:
        The tick to go on with, scalar: `last`, or the one whose physics is left to do; or -1 less
        the one whose row is not finite.

    Source: `control.tick`, `teleop.round_trip`.
    """
    for tick in range(first, last):
        if not _write_down(ticks[0], row, contacts, tick):
            return -1 - tick
        if round_trip(station, flotor, tick, stopped) or tick % CHECKED == 0:
            return tick
        planned_tick(simulated, planned, tick, ticks[0].steps, stopped)
        look_at_pins(ticks)
    return last


@compiled
def _write_down(r, row, contacts, tick):
    """Write the row that is due at a tick, if one is; whether all is well."""
    if tick % r.every != 0 or tick // r.every >= r.rows:
        return True
    return take_row(row, contacts, tick // r.every, tick * r.period)


@compiled
def look_at_pins(ticks):
    """Keep how far the pins have opened.

    Args:
        ticks: `Ticks.record`.

    Returns:
        Nothing.

    Source: `simulate.closure`.
    """
    r = ticks[0]
    widest, places = floats(r.widest, 1), rows_of(r.places, r.sites, 3)
    one, two = integers(r.one, r.pins), integers(r.two, r.pins)
    widest[0] = max(widest[0], widest_pin(places, one, two))


def compile_ahead() -> None:
    """Begin to compile what a teleoperated run calls, in a process beside this one."""
    compile_elsewhere(teleoperated_ticks, f"from {__name__} import compile_ticks; compile_ticks()")


def compile_ticks() -> None:
    """Compile what a teleoperated run calls."""
    records = TICKS, SIMULATION, PLANNED, STATE_ROW, CONTACTS, STATION, FLOTOR
    arguments = *(typeof(np.zeros(1, kind)) for kind in records), int64, int64, boolean
    teleoperated_ticks.compile(arguments)
