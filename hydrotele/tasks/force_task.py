"""What `HoldForce` is."""

import math

import mujoco
import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surroundings import Plate, Thing
from hydrotele.tasks.force import force_fields
from hydrotele.tasks.starts import draw_start
from hydrotele.tasks.task import Task

_MIDDLE = (6.0, 0.0)  # m, of the plate
_HALF = (1.2, 1.2)  # m
_MASS = 300.0  # kg
_SOFT, _STIFF = 5.0e5, 2.0e6  # N/m
_DAMPING = 0.87  # of critical, as that of the plate of Zhu 1994's experiment in `press_stiffness`
_ABOVE = (0.05, 0.15)  # m


def _start(machine: Machine, chance: np.random.Generator) -> dict[str, float]:
    """The bucket over the middle of the plate, its teeth down."""
    return draw_start(machine, chance, (5.6, -0.05, 0.2, -1.92), (6.4, 0.05, 0.9, -1.57))


def _plate(
    machine: Machine, chance: np.random.Generator, start: dict[str, float]
) -> tuple[Thing, ...]:
    """A plate below the tip."""
    numbers, axes, _ = arm_facts(machine)
    pose = np.zeros(5)
    task_forward(numbers, np.array([start[name] for name in axes]), pose)
    stiffness = math.exp(chance.uniform(math.log(_SOFT), math.log(_STIFF)))
    height = float(pose[2] - chance.uniform(*_ABOVE))
    damping = 2.0 * _DAMPING * math.sqrt(stiffness * _MASS)
    return (Plate(position=(*_MIDDLE, height), size=_HALF, mass=_MASS, stiffness=stiffness,
                  damping=damping),)  # fmt: skip


def _numbers(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Where the plate is in the model and before the machine, as `force` reads it."""
    joint = model.joint("plate_0")
    return (joint.qposadr[0], joint.dofadr[0], joint.id, *_MIDDLE, *_HALF)


HOLD_FORCE = Task(
    name="HoldForce",
    kind="force",
    sentence=(
        "The bucket of an excavator presses on a plate on a spring, of unknown stiffness, with a"
        " force of 10 to 35 kN that changes once."
    ),
    reward=(
        "1 at the force wanted, less the error as a share of it, at least -1; in the air it is 0."
        " More than 100 kN on the plate, or a tip that is no longer over it, ends the episode"
        " with -50."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=20.0,
    start=_start,
    fields=force_fields,
    measures=(("force_error", "N"), ("contact", "1"), ("overload", "1"), ("beside", "1")),
    surroundings=_plate,
    numbers=_numbers,
    servo=Servo(position_gain=5.0),  # with more, a boom that swings freely comes down as a hammer
    pose_rates=(0.3, 0.1, 0.3, 0.3, 0.25),  # as `press_stiffness`
)
"""A force on a plate."""
