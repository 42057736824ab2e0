"""The setup of an environment: a task combined with the user's options.

It holds time steps, driven axes, machine variants, observation fields, and the limits of rates and
accelerations in SI units.
"""

from typing import NamedTuple

import numpy as np

from hydrotele.control.action_limits import MAX_ACCELERATION as MAX_ACCELERATION
from hydrotele.control.action_limits import MAX_POSE_ACCELERATIONS as MAX_POSE_ACCELERATIONS
from hydrotele.control.action_limits import full_action_rate as full_action_rate
from hydrotele.core.errors import InputError
from hydrotele.envs.observation import ObservationField
from hydrotele.envs.task import Options, Task
from hydrotele.envs.variants import Variants
from hydrotele.machine.machine import Machine

_MIN_CONTROL_RATE = 200.0  # Hz, minimum control rate of the servo


class Timing(NamedTuple):
    """Time steps of an environment and length of its episodes.

    Attributes:
        ticks: control periods per environment step.
        substeps: physics steps per control period.
        period: control period [s].
        horizon: environment steps per episode, after which it is truncated.
    """

    ticks: int
    substeps: int
    period: float
    horizon: int


class TaskSetup(NamedTuple):
    """A task combined with the user's options, and the machine data that an environment needs.

    Attributes:
        task: the task.
        options: the user's options with all defaults filled in.
        clock: time steps of the environment.
        machine: the machine without added or randomised effects, as a controller knows it.
        axes: driven axes in the order of the actions (`valve`, `joint_rate`).
        arm_axes: number of arm axes, which come first in `axes`.
        variants: machines and starts of the episodes.
        fields: fields of the observation.
        drive_table: (k, TABLE_POINTS, 3) moment arm and chamber volumes of every axis over its
            range, from `control.servo.tabulate_drive_geometry`.
    """

    task: Task
    options: Options
    clock: Timing
    machine: Machine
    axes: tuple[str, ...]
    arm_axes: int
    variants: Variants
    fields: list[ObservationField]
    drive_table: np.ndarray


def make_timing(options: Options) -> Timing:
    """Compute control period, physics steps per period and episode length from the options.

    The control rate is the multiple of the environment rate `options.control_rate` that is nearest
    to 200 Hz; it is the environment rate itself if that is higher.

    Raises:
        InputError: the environment rate or the physics step is out of range, the control period is
            not a whole number of physics steps, or the duration is shorter than half an environment
            step.
    """
    rate, step = options.control_rate, options.timestep
    if not (0.0 < rate <= 1.0e4 and 1.0e-5 <= step <= 5.0e-3):
        message = (
            f"{rate:g} Hz with a physics step of {step:g} s is out of range: at most 10000 Hz, and"
            " a physics step from 1e-05 to 0.005 s"
        )
        raise InputError("control_rate", message)
    ticks = max(1, round(_MIN_CONTROL_RATE / rate))
    substeps = 1.0 / (rate * ticks * step)
    if substeps < 0.999 or abs(substeps - round(substeps)) > 1e-6:
        message = f"{rate:g} Hz needs a control period of whole physics steps of {step:g} s; use for example 50 or 200"
        raise InputError("control_rate", message)
    assert options.duration is not None
    horizon = round(options.duration * rate)
    if horizon < 1:
        raise InputError("duration", f"{options.duration:g} s is shorter than one step")
    return Timing(ticks, round(substeps), round(substeps) * step, horizon)
