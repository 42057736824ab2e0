"""One control tick: servo, physics steps with its commands, and the next sensor readings.

Scenario runs and environments share it. The references come from a plan or from an agent's actions.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    DriveReferences,
    ForceReferences,
    MeasuredState,
    servo_step,
)
from hydrotele.core.compiled import compiled
from hydrotele.core.memory import address_record, float64_view, int64_view, matrix_view
from hydrotele.simulate.sensor_models import FeedbackTable, Readings, SensorParameters, sample_sensors_if_due
from hydrotele.simulate.stepping import step_physics, unpack_simulation_record


class Controller(NamedTuple):
    """State and parameters of the servo of k axes.

    Attributes:
        parameters: (k, 15) of `control.servo.servo_parameters`.
        closed: (k,) whether the servo controls an axis by feedback; the others keep their command.
        load: (k,) drive forces (minus computed forces, if any), low-pass filtered with the time
            constant `Servo.load_time`; updated in every tick for hydraulic drives [N] or [N m].
        command: (k,) commands of the drives; written where `closed` [1], or in the drive's unit.
    """

    parameters: np.ndarray
    closed: np.ndarray
    load: np.ndarray
    command: np.ndarray


class TickReference(NamedTuple):
    """References of k axes in one tick.

    Attributes:
        joint: (k,) joint references at the time at which the joints were measured [rad] or [m].
        drive: reference velocities of the drives, with moment arms and chamber volumes.
        computed: drive forces by inverse dynamics.
        stopped: whether the commands of all axes are set to 0 in this tick.
    """

    joint: np.ndarray
    drive: DriveReference
    computed: ComputedForce
    stopped: bool


@compiled
def control_tick(sim, tick, steps, controller, reference, measured):
    """Compute the servo commands of all axes and simulate the physics of one control tick.

    Args:
        sim: Simulation; its state is advanced by one tick.
        tick: index of the control tick, from 0, scalar.
        steps: physics steps per tick, scalar.
        controller: Controller; its `command` and `load` are updated.
        reference: TickReference.
        measured: MeasuredState.

    Returns:
        Nothing.

    Source: `control.servo`, `simulate.stepping`.
    """
    servo_step(
        controller.parameters, controller.closed, reference.drive, reference.joint, measured,
        controller.load, reference.computed, controller.command,
    )  # fmt: skip
    if reference.stopped:
        for i in range(len(controller.command)):
            controller.command[i] = 0.0
    step_physics(sim, tick, steps, controller.command)


class PlannedRun(NamedTuple):
    """Data of a run along a plan of n ticks and k axes.

    Attributes:
        controller: state and parameters of the servo.
        feedback: the sensors, their errors and their last readings.
        drives: references of the drives, (n, k) each.
        forces: drive forces by inverse dynamics, (n, k) each.
        reference: (n, k) joint references [rad] or [m].
        command: (n, k) planned commands, used for the axes without feedback [1], or in the drives'
            units.
        given: (n, k) written: commands of all axes in every tick, by servo or plan.
    """

    controller: Controller
    feedback: FeedbackTable
    drives: DriveReferences
    forces: ForceReferences
    reference: np.ndarray
    command: np.ndarray
    given: np.ndarray


_INT, _SERVO_COLUMNS = np.int64, 15
PLANNED_RUN_DTYPE = np.dtype(
    [(name, _INT) for name in ("axes", "ticks", "channels", "samples", "every", "known", "supplies")]
    + [("period", np.float64)]
    + [(name, _INT) for name in ("parameters", "closed", "load", "command")]  # addresses from here on
    + [(name, _INT) for name in ("scale", "offset", "step", "low", "high", "errors")]
    + [(name, _INT) for name in ("joint", "rate", "head", "rod", "supply")]
    + [(name, _INT) for name in ("velocity", "arm", "volume_head", "volume_rod")]
    + [(name, _INT) for name in ("force", "force_rate", "reference", "planned_command", "given")],
    align=True,
)
"""Record type of a `PlannedRun`: sizes, scalars and array addresses."""


def planned_run_record(run: PlannedRun) -> np.ndarray:
    """Pack a `PlannedRun` into a record (1,) of sizes and array addresses; the arrays must outlive the record."""
    table, controller = run.feedback, run.controller
    arrays = {
        "parameters": controller.parameters, "closed": controller.closed, "load": controller.load,
        "command": controller.command, **table.sensors._asdict(), "errors": table.errors,
        **table.readings._asdict(), **run.drives._asdict(), "force": run.forces.force,
        "force_rate": run.forces.rate, "reference": run.reference, "planned_command": run.command,
        "given": run.given,
    }  # fmt: skip
    record = address_record(PLANNED_RUN_DTYPE, arrays)
    (record["ticks"], record["axes"]), record["every"] = run.reference.shape, table.ticks_per_sample
    (record["samples"], record["channels"]), record["period"] = table.errors.shape, table.period
    record["known"], record["supplies"] = run.forces.is_computed, len(table.readings.supply)
    return record


@compiled
def _read_planned_run(r):
    """Unpack a record of `planned_run_record` to a `PlannedRun` whose arrays share its memory."""
    n, k, c = r.ticks, r.axes, r.channels
    controller = Controller(
        matrix_view(r.parameters, k, _SERVO_COLUMNS), int64_view(r.closed, k), float64_view(r.load, k),
        float64_view(r.command, k),
    )  # fmt: skip
    sensors = SensorParameters(
        float64_view(r.scale, c), float64_view(r.offset, c), float64_view(r.step, c), float64_view(r.low, c),
        float64_view(r.high, c),
    )  # fmt: skip
    readings = Readings(
        float64_view(r.joint, k), float64_view(r.rate, k), float64_view(r.head, k), float64_view(r.rod, k),
        float64_view(r.supply, r.supplies),
    )  # fmt: skip
    drives = DriveReferences(
        matrix_view(r.velocity, n, k), matrix_view(r.arm, n, k), matrix_view(r.volume_head, n, k),
        matrix_view(r.volume_rod, n, k),
    )  # fmt: skip
    return PlannedRun(
        controller,
        FeedbackTable(r.every, r.period, sensors, matrix_view(r.errors, r.samples, c), readings),
        drives,
        ForceReferences(r.known != 0, matrix_view(r.force, n, k), matrix_view(r.force_rate, n, k)),
        matrix_view(r.reference, n, k), matrix_view(r.planned_command, n, k), matrix_view(r.given, n, k),
    )  # fmt: skip


@compiled
def step_planned_run(simulated, planned, tick, steps, stopped):
    """Simulate one control tick of a run along a plan, and sample the sensors that are due after it.

    Args:
        simulated: record of `simulate.stepping.simulation_record`.
        planned: record of `planned_run_record`, with the readings of this tick.
        tick: index of the control tick, from 0, scalar.
        steps: physics steps per tick, scalar.
        stopped: whether the commands of all axes are set to 0 in this tick, scalar.

    Returns:
        Nothing.

    Source: `control_tick`.
    """
    sim, run = unpack_simulation_record(simulated[0]), _read_planned_run(planned[0])
    controller, readings = run.controller, run.feedback.readings
    for i in range(len(controller.command)):
        controller.command[i] = run.command[tick, i]
    drives, forces = run.drives, run.forces
    drive = DriveReference(drives.velocity[tick], drives.arm[tick], drives.volume_head[tick], drives.volume_rod[tick])
    reference = TickReference(
        run.reference[tick - tick % run.feedback.ticks_per_sample], drive,
        ComputedForce(forces.is_computed, forces.force[tick], forces.rate[tick]), stopped,
    )  # fmt: skip
    measured = MeasuredState(readings.joint, readings.rate, readings.head, readings.rod, readings.supply)
    control_tick(sim, tick, steps, controller, reference, measured)
    for i in range(len(controller.command)):
        run.given[tick, i] = controller.command[i]
    sample_sensors_if_due(run.feedback, sim, tick + 1, steps)
