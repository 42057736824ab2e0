"""One control tick: the servo, the physics that its commands drive, and the next readings.

Scenario runs and environments share it; what they follow, a plan or the actions of an agent, is
written into the references before.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    DriveReferences,
    ForceReferences,
    Measured,
    servo_step,
)
from hydrotele.core.compiled import compiled
from hydrotele.simulate.feedback import FeedbackTable, sample
from hydrotele.simulate.stepping import Simulation, step_physics


class Controller(NamedTuple):
    """Servo of k axes.

    Attributes:
        parameters: (k, 14) of `control.servo.servo_parameters`.
        closed: (k,) whether an axis is under feedback; the others keep their command.
        load: (k,) slow mean of the drive forces, updated [N] or [N m].
        command: (k,) written where closed [1], or in the drive's unit.
    """

    parameters: np.ndarray
    closed: np.ndarray
    load: np.ndarray
    command: np.ndarray


class TickReference(NamedTuple):
    """What k axes are to do in one tick.

    Attributes:
        joint: (k,) references when the joints were measured [rad] or [m].
        drive: of the drives.
        computed: forces that inverse dynamics asks for.
        stopped: whether all commands are 0 whatever the servo says.
    """

    joint: np.ndarray
    drive: DriveReference
    computed: ComputedForce
    stopped: bool


@compiled
def control_tick(sim, tick, steps, controller, reference, measured):
    """Commands of all axes by the servo, and the physics of the tick under them.

    Args:
        sim: Simulation.
        tick: control tick, from 0, scalar.
        steps: physics steps per tick, scalar.
        controller: Controller.
        reference: TickReference.
        measured: Measured.

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


class Planned(NamedTuple):
    """A run along a plan of n ticks and k axes.

    Attributes:
        sim: the plant.
        steps: physics steps per tick.
        controller: its servo.
        feedback: its sensors.
        drives: (n, k) each, references of the drives.
        forces: (n, k) each, computed forces.
        reference: (n, k) joint references [rad] or [m].
        command: (n, k) commands of the axes that are not closed [1], or in the drives' units.
        given: (n, k) written: commands of every tick.
    """

    sim: Simulation
    steps: int
    controller: Controller
    feedback: FeedbackTable
    drives: DriveReferences
    forces: ForceReferences
    reference: np.ndarray
    command: np.ndarray
    given: np.ndarray


@compiled
def planned_tick(run, tick, stopped):
    """Go on by one tick and take the readings that are due after it.

    Args:
        run: Planned, with the readings of this tick.
        tick: control tick, scalar.
        stopped: whether all commands are 0, scalar.

    Returns:
        Nothing.

    Source: `control_tick`.
    """
    controller, readings = run.controller, run.feedback.readings
    for i in range(len(controller.command)):
        controller.command[i] = run.command[tick, i]
    drives, forces = run.drives, run.forces
    drive = DriveReference(
        drives.velocity[tick], drives.arm[tick], drives.volume_head[tick], drives.volume_rod[tick]
    )
    reference = TickReference(
        run.reference[tick - tick % run.feedback.every], drive,
        ComputedForce(forces.known, forces.force[tick], forces.rate[tick]), stopped,
    )  # fmt: skip
    measured = Measured(
        readings.joint, readings.rate, readings.head, readings.rod, readings.supply[0]
    )
    control_tick(run.sim, tick, run.steps, controller, reference, measured)
    for i in range(len(controller.command)):
        run.given[tick, i] = controller.command[i]
    sample(run.feedback, run.sim, tick + 1, run.steps)
