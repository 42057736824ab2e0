"""Compiled loop over the control ticks of a run.

Returning to Python between two ticks evicts machine and joystick data from the processor caches,
and makes a tick 12 to 20 % slower.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numba import boolean, int64, typeof

from hydrotele.control.control_loop import (
    PLANNED_RUN_DTYPE,
    step_planned_run,
)
from hydrotele.core.compiled import compile_in_background, compiled
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.simulate.closed_loops import max_pin_opening, pin_sites
from hydrotele.simulate.contact_forces import CONTACTS_DTYPE
from hydrotele.simulate.joystick import FLOTOR_DTYPE
from hydrotele.simulate.record import STATE_ROW_DTYPE, record_row
from hydrotele.simulate.stepping import SIMULATION_DTYPE
from hydrotele.teleop.teleoperation_step import STATION_DTYPE, TICKS_PER_CHECK, step_teleoperation

TICK_LOOP_RECORD = np.dtype(
    [(name, np.int64) for name in ("steps", "every", "rows", "sites", "pins")]
    + [("period", np.float64)]
    + [(name, np.int64) for name in ("places", "one", "two", "widest")],  # addresses
    align=True,
)
"""Record type of the compiled tick loop; see `make_tick_loop`."""


class TickLoop(NamedTuple):
    """Settings and memory of the compiled loop over control ticks, passed to it as one record.

    Attributes:
        record: (1,) record of type `TICK_LOOP_RECORD`.
        max_pin_opening: (1,) largest gap between the two points of a pin so far [m].
        referenced_arrays: arrays whose addresses are in the record; kept alive here.
    """

    record: np.ndarray
    max_pin_opening: np.ndarray
    referenced_arrays: dict[str, np.ndarray]


def make_tick_loop(
    model: mujoco.MjModel, data: mujoco.MjData, steps: int, every: int, rows: int, period: float
) -> TickLoop:  # fmt: skip
    """Create the settings and memory of the compiled loop over control ticks.

    Args:
        model: MuJoCo model of the plant.
        data: MuJoCo data of the plant.
        steps: physics steps per tick.
        every: ticks per log row.
        rows: number of log rows.
        period: duration of a tick [s].
    """
    one, two = pin_sites(model)
    widest = np.zeros(1)
    kept = {"places": data.site_xpos, "one": one.astype(np.int64), "two": two.astype(np.int64),
            "widest": widest}  # fmt: skip
    record = address_record(TICK_LOOP_RECORD, kept)
    for name, value in {"steps": steps, "every": every, "rows": rows, "period": period,
                        "sites": model.nsite, "pins": len(one)}.items():  # fmt: skip
        record[name] = value
    return TickLoop(record, widest, kept)


@compiled
def run_planned_ticks(ticks, simulated, planned, row, contacts, first, last, stopped):
    """Simulate control ticks of a run in which the motion of all axes is planned.

    Args:
        ticks: `TickLoop.record`, modified.
        simulated: record of the machine, from `simulate.stepping.simulation_record`.
        planned: record of plan and controller, from `control.control_loop.planned_run_record`.
        row: record of the log rows, from a `Recorder`.
        contacts: record of contact forces, from `simulate.contact_forces.make_contact_addresses`.
        first: number of the first control tick, scalar.
        last: number of the control tick before which to stop, scalar.
        stopped: whether all commands are set to 0, scalar.

    Returns:
        The next tick, scalar: `last`; or -1 - k if the log row of tick k contains values that are not
        finite, because the simulation is unstable.

    Source: `control.control_loop`.
    """
    for tick in range(first, last):
        if not _record_row(ticks[0], row, contacts, tick):
            return -1 - tick
        step_planned_run(simulated, planned, tick, ticks[0].steps, stopped)
        update_max_pin_opening(ticks)
    return last


@compiled
def run_teleoperated_ticks(
    ticks, simulated, planned, row, contacts, station, flotor, first, last, stopped
):  # fmt: skip
    """Simulate control ticks of a run in which an operator moves the machine with a joystick.

    The loop stops before the physics of a tick at which Python must check safety conditions: every
    TICKS_PER_CHECK ticks, and when the operator station sets a flag.

    Args:
        ticks: `TickLoop.record`, modified.
        simulated: record of the machine, as for `run_planned_ticks`.
        planned: record of plan and controller, as for `run_planned_ticks`.
        row: record of the log rows, as for `run_planned_ticks`.
        contacts: record of contact forces, as for `run_planned_ticks`.
        station: record of the operator station, see `teleop.teleoperation_step`.
        flotor: record of the moving part of the joystick, see `teleop.teleoperation_step`.
        first: first control tick, already prepared by the station, scalar.
        last: control tick before which to stop, scalar.
        stopped: whether the machine has been stopped permanently, scalar.

    Returns:
        The next tick, scalar: `last`, or the tick whose physics is still to be done; or -1 - k if
        the log row of tick k is not finite.

    Source: `control.control_loop`, `teleop.teleoperation_step`.
    """
    for tick in range(first, last):
        if not _record_row(ticks[0], row, contacts, tick):
            return -1 - tick
        if step_teleoperation(station, flotor, tick, stopped) or tick % TICKS_PER_CHECK == 0:
            return tick
        step_planned_run(simulated, planned, tick, ticks[0].steps, stopped)
        update_max_pin_opening(ticks)
    return last


@compiled
def _record_row(r, row, contacts, tick):
    """Write the log row of a control tick, if one is due at this tick.

    `r` is the record of the tick loop, `row` that of the log rows and `contacts` that of the
    contact forces.

    Returns:
        False if the row contains a value that is not finite, otherwise True.
    """
    if tick % r.every != 0 or tick // r.every >= r.rows:
        return True
    return record_row(row, contacts, tick // r.every, tick * r.period)


@compiled
def update_max_pin_opening(ticks):
    """Update the largest pin opening of the run by that of the present state.

    A pin joins two links of a closed kinematic loop; its opening is the distance of the two points.

    Args:
        ticks: `TickLoop.record`, modified.

    Returns:
        Nothing.

    Source: `simulate.closed_loops`.
    """
    r = ticks[0]
    widest, places = float64_view(r.widest, 1), matrix_view(r.places, r.sites, 3)
    one, two = int64_view(r.one, r.pins), int64_view(r.two, r.pins)
    widest[0] = max(widest[0], max_pin_opening(places, one, two))


def start_background_compilation() -> None:
    """Start to compile the tick loop of a teleoperated run in a separate process, and return at once."""
    name = compile_tick_loop.__name__
    compile_in_background(run_teleoperated_ticks, f"from {__name__} import {name}; {name}()")


def compile_tick_loop() -> None:
    """Compile the tick loop of a teleoperated run."""
    records = (
        TICK_LOOP_RECORD,
        SIMULATION_DTYPE,
        PLANNED_RUN_DTYPE,
        STATE_ROW_DTYPE,
        CONTACTS_DTYPE,
        STATION_DTYPE,
        FLOTOR_DTYPE,
    )
    arguments = *(typeof(np.zeros(1, kind)) for kind in records), int64, int64, boolean
    run_teleoperated_ticks.compile(arguments)
