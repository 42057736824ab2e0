"""The task `HoldForce`: press with a given force on a plate that stands on a spring.

An episode starts with the bucket above the plate, and the reference force changes once. The
controlled force is the one that the spring and damper of the plate carry, as a load cell under the
plate measures it.
"""

import math

import mujoco
import numpy as np

from hydrotele.control.resolved_motion import arm_facts
from hydrotele.core.compiled import callback, compiled
from hydrotele.core.memory import field
from hydrotele.envs.episode import uniform_between
from hydrotele.envs.task import Task, draw_start
from hydrotele.envs.world import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_CODE,
    TICK,
    Field,
    episodes,
    observed,
    parameters_at,
    rewarded,
    world,
)
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Plate, Servo, SurroundingObject

WEAKEST, STRONGEST = 1.0e4, 3.5e4  # N, range of the reference force
OVERLOAD = 1.0e5  # N, force that ends the episode
FAILURE = -50.0  # reward of an overload or of leaving the plate: as much as 1 s on target pays
CELL = 500.0  # N, maximum error of the load cell: 1 % of 50 kN
_CHANGE = 5.0e3  # N, minimum change of the reference force
_EARLY, _LATE = 0.4, 0.6  # fractions of the duration between which the reference changes
_TOUCH = 200.0  # N, minimum force that counts as contact
_RANGE = 2.0e5  # N, range of the load cell
_FIRST, _SECOND, _TIME, _FORCE, FORCE_READ, _PEAK = range(6)  # indices in `goal`
# indices in `parameters`
PLATE_QPOS, PLATE_DOF, PLATE_JOINT, MIDDLE_X, MIDDLE_Y, HALF_X, HALF_Y = range(7)


def force_fields(machine: Machine, axes: tuple[str, ...]) -> list[Field]:
    """Return the fields that `observe_force` writes: measured and reference force, time."""
    return [
        Field("force", "N", -_RANGE, _RANGE),
        Field("wanted_force", "N", 0.0, STRONGEST),
        Field("time_since_change", "s", 0.0, 3600.0),
    ]


@compiled
def plate_force(f, w):
    """Return the force in the spring and damper of the plate, positive when pressed down.

    Args:
        f: record of TASK_PARAMETERS.
        w: World.

    Returns:
        The force, scalar [N].

    Source: `simulate.surroundings`; positions are one step ahead, see `simulate.record`.
    """
    dof, joint = int(f.parameters[PLATE_DOF]), int(f.parameters[PLATE_JOINT])
    stiffness = field(w.model, f.at_stiffness, joint + 1)[joint]
    damping = field(w.model, f.at_damping, dof + 1)[dof]
    speed = w.qvel[dof]
    place = w.qpos[int(f.parameters[PLATE_QPOS])] - f.timestep * speed
    return -(stiffness * place + damping * speed)


@compiled
def begin_force(f, e, w):
    """Draw the two reference forces and the time of the change.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    g[_FIRST] = uniform_between(e, WEAKEST, STRONGEST)
    # uniform over all forces that differ from the first by at least _CHANGE
    below = max(0.0, g[_FIRST] - _CHANGE - WEAKEST)
    above = max(0.0, STRONGEST - g[_FIRST] - _CHANGE)
    place = uniform_between(e, 0.0, below + above)
    g[_SECOND] = WEAKEST + place if place < below else g[_FIRST] + _CHANGE + (place - below)
    g[_TIME] = uniform_between(e, _EARLY, _LATE) * f.horizon * f.ticks * f.period
    g[_PEAK] = 0.0
    _read(f, e, w)


@compiled
def _read(f, e, w):
    """Update the true force, and sample the load cell if a sensor sample is due."""
    e.goal[_FORCE] = plate_force(f, w)
    if e.tick % f.every == 0:
        error = uniform_between(e, -CELL, CELL) if f.noisy else 0.0
        e.goal[FORCE_READ] = e.goal[_FORCE] + error


@compiled
def tick_force(f, e, w):
    """Read the load cell and update the maximum force of this step.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` is written.
        w: World.

    Returns:
        Nothing.

    Source: this module.
    """
    _read(f, e, w)
    e.goal[_PEAK] = max(e.goal[_PEAK], e.goal[_FORCE])


@compiled
def reference_force(g, time):
    """Return the reference force, and the time since its last change.

    Args:
        g: (GOAL,) goal of the episode.
        time: since the start, scalar [s].

    Returns:
        (force [N], time [s]), scalars.

    Source: this module.
    """
    if time < g[_TIME]:
        return g[_FIRST], time
    return g[_SECOND], time - g[_TIME]


@compiled
def observe_force(f, e, out, at):
    """Write the measured force, the reference force and the time since its last change.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: scalar.

    Returns:
        Nothing.

    Source: `force_fields`.
    """
    out[at] = e.goal[FORCE_READ]
    out[at + 1], out[at + 2] = reference_force(e.goal, e.tick * f.period)


@compiled
def reward_force(f, e, w):
    """Compute the reward from the true force; an overload or leaving the plate ends the episode.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: World; `measures` receives the force error [N] and, as 0 or 1, contact with the plate, an
            overload, and a tip that is no longer over the plate.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: this module.
    """
    g, n = e.goal, f.parameters
    wanted = reference_force(g, e.tick * f.period)[0]
    overload = g[_PEAK] > OVERLOAD
    aside = math.fabs(e.tip[0] - n[MIDDLE_X]) > n[HALF_X]
    aside = aside or math.fabs(e.tip[1] - n[MIDDLE_Y]) > n[HALF_Y]
    g[_PEAK] = 0.0
    w.measures[0] = g[_FORCE] - wanted
    w.measures[1] = 1.0 if g[_FORCE] > _TOUCH else 0.0
    w.measures[2] = 1.0 if overload else 0.0
    w.measures[3] = 1.0 if aside else 0.0
    if overload or aside:
        return FAILURE, True
    return max(-1.0, 1.0 - abs(g[_FORCE] - wanted) / wanted), False


_MIDDLE = (6.0, 0.0)  # m, centre of the plate
_HALF = (1.2, 1.2)  # m, half sizes of the plate
_MASS = 300.0  # kg, mass of the plate
_SOFT, _STIFF = 5.0e5, 2.0e6  # N/m, range of the plate's stiffness
_DAMPING = 0.87  # damping ratio, as of the plate of Zhu 1994's experiment in `press_stiffness`
_ABOVE = (0.05, 0.15)  # m, initial height of the tip above the plate


def _start(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Draw a start with the bucket over the centre of the plate, teeth down."""
    return draw_start(machine, rng, (5.6, -0.05, 0.2, -1.92), (6.4, 0.05, 0.9, -1.57))


def _plate(
    machine: Machine, rng: np.random.Generator, start: dict[str, float]
) -> tuple[SurroundingObject, ...]:
    """Draw the stiffness and height of a plate below the tip."""
    numbers, axes, _ = arm_facts(machine)
    pose = np.zeros(5)
    task_forward(numbers, np.array([start[name] for name in axes]), pose)
    stiffness = math.exp(rng.uniform(math.log(_SOFT), math.log(_STIFF)))
    height = float(pose[2] - rng.uniform(*_ABOVE))
    damping = 2.0 * _DAMPING * math.sqrt(stiffness * _MASS)
    return (Plate(position=(*_MIDDLE, height), size=_HALF, mass=_MASS, stiffness=stiffness,
                  damping=damping),)  # fmt: skip


def _parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Return the indices of the plate in the model, its centre and its half sizes."""
    joint = model.joint("plate_0")
    return (joint.qposadr[0], joint.dofadr[0], joint.id, *_MIDDLE, *_HALF)


HOLD_FORCE = Task(
    name="HoldForce",
    kind="force",
    sentence=(
        "The bucket of an excavator presses on a plate that stands on a spring of unknown"
        " stiffness. The reference force is between 10 and 35 kN and changes once."
    ),
    reward=(
        "The reward is 1 minus the relative force error, at least -1; without contact it is 0. A"
        " force above 100 kN, or a tip that is no longer over the plate, ends the episode with a"
        " reward of -50."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=20.0,
    start=_start,
    fields=force_fields,
    measures=(("force_error", "N"), ("contact", "1"), ("overload", "1"), ("beside", "1")),
    surroundings=_plate,
    parameters=_parameters,
    servo=Servo(position_gain=5.0),  # a higher gain lets the boom hammer on the plate
    pose_rates=(0.3, 0.1, 0.3, 0.3, 0.25),  # as in the scenario `press_stiffness`
)
"""Press on a plate with a given force."""


@callback(TASK_CODE)
def code(part, m, d, number, argument, out):
    """Run one part of the task in native code; see `world`."""
    f = parameters_at(argument)[0]
    e, w = episodes(f)[number], world(f, m, d, number, argument)
    if part == BEGIN:
        begin_force(f, e, w)
    elif part == TICK:
        tick_force(f, e, w)
    elif part == OBSERVE:
        observe_force(f, e, observed(f, out), 0)
    elif part == REWARD:
        return rewarded(e, reward_force(f, e, w))
    return 0.0
