"""The task `HoldForce`: press with a given force on a plate that stands on a spring.

An episode starts with the bucket above the plate, and the reference force changes once. The
controlled force is the one that the spring and damper of the plate carry, as a load cell under the
plate measures it.
"""

import math

import mujoco
import numpy as np

from hydrotele.control.arm_kinematics import arm_specification
from hydrotele.core.compiled import callback, compiled
from hydrotele.core.memory import struct_field_view
from hydrotele.envs.episode import draw_uniform_between
from hydrotele.envs.observation import ObservationField
from hydrotele.envs.task import Task, sample_start_positions
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    REWARD,
    TASK_SIGNATURE,
    TICK,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo
from hydrotele.scenario.surrounding_objects import Plate, SurroundingObject

MIN_FORCE, MAX_FORCE = 1.0e4, 3.5e4  # N, range of the reference force
OVERLOAD_FORCE = 1.0e5  # N, force that ends the episode
FAILURE_REWARD = -50.0  # reward of an overload or of leaving the plate: as much as 1 s on target pays
MAX_CELL_ERROR = 500.0  # N, maximum error of the load cell: 1 % of 50 kN
_MIN_FORCE_CHANGE = 5.0e3  # N, minimum change of the reference force
_MIN_CHANGE_TIME, _MAX_CHANGE_TIME = (
    0.4,
    0.6,
)  # fractions of the duration between which the reference changes
_CONTACT_FORCE = 200.0  # N, minimum force that counts as contact
_CELL_RANGE = 2.0e5  # N, range of the load cell
_FIRST_FORCE, _SECOND_FORCE, _CHANGE_TIME, _TRUE_FORCE, MEASURED_FORCE, _PEAK_FORCE = range(6)  # indices in `goal`
# indices in `parameters`
PLATE_QPOS, PLATE_DOF, PLATE_JOINT, CENTRE_X, CENTRE_Y, HALF_X, HALF_Y = range(7)


def list_force_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_force_observation` writes.

    They are the measured force, the reference force and the time since its last change.
    """
    return [
        ObservationField("force", "N", -_CELL_RANGE, _CELL_RANGE),
        ObservationField("reference_force", "N", 0.0, MAX_FORCE),
        ObservationField("time_since_change", "s", 0.0, 3600.0),
    ]


@compiled
def compute_plate_force(f, w):
    """Return the force that the spring and the damper under the plate carry, positive when it is pressed down.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView.

    Returns:
        The force, scalar [N].

    Source: `simulate.surroundings`. MuJoCo's positions are one step ahead of the forces and are moved back.
    """
    dof, joint = int(f.parameters[PLATE_DOF]), int(f.parameters[PLATE_JOINT])
    stiffness = struct_field_view(w.model, f.at_stiffness, joint + 1)[joint]
    damping = struct_field_view(w.model, f.at_damping, dof + 1)[dof]
    speed = w.qvel[dof]
    place = w.qpos[int(f.parameters[PLATE_QPOS])] - f.timestep * speed
    return -(stiffness * place + damping * speed)


@compiled
def draw_force_references(f, e, w):
    """Draw the goal of an episode: two reference forces, and the time of the change from one to the other.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; both forces and the time are written to `goal`, and the first
            measured force.
        w: SimulationView, from which the first true and measured force are computed.

    Returns:
        Nothing.

    Source: this module.
    """
    g = e.goal
    g[_FIRST_FORCE] = draw_uniform_between(e, MIN_FORCE, MAX_FORCE)
    # uniform over all forces that differ from the first by at least _MIN_FORCE_CHANGE
    below = max(0.0, g[_FIRST_FORCE] - _MIN_FORCE_CHANGE - MIN_FORCE)
    above = max(0.0, MAX_FORCE - g[_FIRST_FORCE] - _MIN_FORCE_CHANGE)
    place = draw_uniform_between(e, 0.0, below + above)
    g[_SECOND_FORCE] = MIN_FORCE + place if place < below else g[_FIRST_FORCE] + _MIN_FORCE_CHANGE + (place - below)
    g[_CHANGE_TIME] = draw_uniform_between(e, _MIN_CHANGE_TIME, _MAX_CHANGE_TIME) * f.horizon * f.ticks * f.period
    g[_PEAK_FORCE] = 0.0
    _sample_load_cell(f, e, w)


@compiled
def _sample_load_cell(f, e, w):
    """Store the true force on the plate in `goal`, and also the load cell's reading if a sensor sample is due."""
    e.goal[_TRUE_FORCE] = compute_plate_force(f, w)
    if e.tick % f.every == 0:
        error = draw_uniform_between(e, -MAX_CELL_ERROR, MAX_CELL_ERROR) if f.noisy else 0.0
        e.goal[MEASURED_FORCE] = e.goal[_TRUE_FORCE] + error


@compiled
def update_force_measurement(f, e, w):
    """Update the force on the plate after a control period: true value, load cell reading and maximum.

    The maximum is that of the true force since the start of the environment step.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; the three forces are written to `goal`.
        w: SimulationView.

    Returns:
        Nothing.

    Source: this module.
    """
    _sample_load_cell(f, e, w)
    e.goal[_PEAK_FORCE] = max(e.goal[_PEAK_FORCE], e.goal[_TRUE_FORCE])


@compiled
def reference_force(g, time):
    """Return the reference force at a time, and the time for which it has had this value.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        time: time since the start of the episode, scalar [s].

    Returns:
        (force [N], time [s]), scalars.

    Source: this module.
    """
    if time < g[_CHANGE_TIME]:
        return g[_FIRST_FORCE], time
    return g[_SECOND_FORCE], time - g[_CHANGE_TIME]


@compiled
def write_force_observation(f, e, out, at):
    """Write the measured force, the reference force and the time since its last change to the observation.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_force_observation_fields`.
    """
    out[at] = e.goal[MEASURED_FORCE]
    out[at + 1], out[at + 2] = reference_force(e.goal, e.tick * f.period)


@compiled
def compute_force_reward(f, e, w):
    """Compute the reward of a step: 1 minus the relative error of the true force, at least -1.

    The episode ends with a reward of -50 if the force exceeded OVERLOAD_FORCE during the step, or
    if the tip is no longer over the plate.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; the maximum force in `goal` is reset to 0.
        w: SimulationView; `measures` receives the true minus the reference force [N] and, as 0 or
            1, contact with the plate, an overload, and a tip that is no longer over the plate.

    Returns:
        (reward, whether the episode ends), scalars.

    Source: this module.
    """
    g, n = e.goal, f.parameters
    wanted = reference_force(g, e.tick * f.period)[0]
    overload = g[_PEAK_FORCE] > OVERLOAD_FORCE
    aside = math.fabs(e.tip[0] - n[CENTRE_X]) > n[HALF_X]
    aside = aside or math.fabs(e.tip[1] - n[CENTRE_Y]) > n[HALF_Y]
    g[_PEAK_FORCE] = 0.0
    w.measures[0] = g[_TRUE_FORCE] - wanted
    w.measures[1] = 1.0 if g[_TRUE_FORCE] > _CONTACT_FORCE else 0.0
    w.measures[2] = 1.0 if overload else 0.0
    w.measures[3] = 1.0 if aside else 0.0
    if overload or aside:
        return FAILURE_REWARD, True
    return max(-1.0, 1.0 - abs(g[_TRUE_FORCE] - wanted) / wanted), False


_CENTRE = (6.0, 0.0)  # m, centre of the plate
_HALF_SIZE = (1.2, 1.2)  # m, half sizes of the plate
_MASS = 300.0  # kg, mass of the plate
_MIN_STIFFNESS, _MAX_STIFFNESS = 5.0e5, 2.0e6  # N/m, range of the plate's stiffness
_DAMPING_RATIO = 0.87  # damping ratio, as of the plate of Zhu 1994's experiment in `press_stiffness`
_START_HEIGHTS = (0.05, 0.15)  # m, initial height of the tip above the plate


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, arm axis -> [rad], with the bucket over the centre of the plate, teeth down."""
    return sample_start_positions(machine, rng, (5.6, -0.05, 0.2, -1.92), (6.4, 0.05, 0.9, -1.57))


def _sample_plate(machine: Machine, rng: np.random.Generator, start: dict[str, float]) -> tuple[SurroundingObject, ...]:
    """Return a plate on a spring, 0.05 to 0.15 m below the tip, with random stiffness and height.

    `start` holds the positions of the arm axes at the start [rad]. The result is a tuple with this
    plate.
    """
    numbers, axes, _ = arm_specification(machine)
    pose = np.zeros(5)
    compute_tip_pose(numbers, np.array([start[name] for name in axes]), pose)
    stiffness = math.exp(rng.uniform(math.log(_MIN_STIFFNESS), math.log(_MAX_STIFFNESS)))
    height = float(pose[2] - rng.uniform(*_START_HEIGHTS))
    damping = 2.0 * _DAMPING_RATIO * math.sqrt(stiffness * _MASS)
    return (Plate(position=(*_CENTRE, height), size=_HALF_SIZE, mass=_MASS, stiffness=stiffness,
                  damping=damping),)  # fmt: skip


def _make_plate_parameters(machine: Machine, model: mujoco.MjModel) -> tuple[float, ...]:
    """Return the task parameters of the plate, in the order of the constants PLATE_QPOS to HALF_Y.

    They are the index of the plate in `qpos`, that in `qvel`, the id of its joint, its centre (x,
    y) and its half sizes [m].
    """
    joint = model.joint("plate_0")
    return (joint.qposadr[0], joint.dofadr[0], joint.id, *_CENTRE, *_HALF_SIZE)


HOLD_FORCE = Task(
    name="HoldForce",
    kind="force",
    needs=("swing", "boom", "stick", "tool"),
    description=(
        "The bucket of an excavator presses on a plate that stands on a spring of unknown"
        " stiffness. The reference force is between 10 and 35 kN and changes once."
    ),
    reward=(
        "The reward of a step is 1 minus the force error relative to the reference force, at least -1; without"
        " contact it is 0. A force above 100 kN, or a tip that is no longer over the plate, ends the episode with a"
        " reward of -50."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=20.0,
    start=_sample_start_positions,
    fields=list_force_observation_fields,
    measures=(("force_error", "N"), ("contact", "1"), ("overload", "1"), ("off_plate", "1")),
    surroundings=_sample_plate,
    parameters=_make_plate_parameters,
    servo=Servo(position_gain=5.0),  # a higher gain lets the boom hammer on the plate
    pose_rates=(0.3, 0.1, 0.3, 0.3, 0.25),  # as in the scenario `press_stiffness`
)
"""Press on a plate with a given force."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `HoldForce` for the simulation `number`, in native code.

    `part` is BEGIN (draw the reference forces of a new episode), TICK (measure the force), OBSERVE
    (write the task's values to the observation, from the address `out` on) or REWARD (return the
    reward and store whether the episode ends). `m`, `d` and `argument` are the addresses of
    mjModel, mjData and TASK_PARAMETERS. The result is 0 except for REWARD; see
    `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_force_references(f, e, w)
    elif part == TICK:
        update_force_measurement(f, e, w)
    elif part == OBSERVE:
        write_force_observation(f, e, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_force_reward(f, e, w))
    return 0.0
