"""The task `ReachFeller`: bring the head of a feller-buncher to a pose and hold it there.

The arm has five axes. Poses are drawn at random until the straight path to one lies in the
workspace.
"""

import math

import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import MAX_ARM_AXES, arm_values, draw_uniform_between
from hydrotele.envs.observation import ObservationField, make_pose_observation_fields, max_reach
from hydrotele.envs.task import (
    Task,
    compute_measured_pose,
    compute_path_effort,
    sample_start_positions,
    wrap_angle,
)
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    POTENTIAL,
    REWARD,
    TASK_SIGNATURE,
    episode_states_view,
    observation_view,
    simulation_view,
    store_episode_end,
    task_parameters_view,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine
from hydrotele.scenario.scenario import Servo

MAX_DISTANCE, MAX_ANGLE, HOLD_TIME = 0.05, 0.03, 0.5  # m, rad, s: tolerances of a reached pose
REWARD_PER_METRE, STEP_COST, SUCCESS_REWARD = (
    1.0,
    0.01,
    10.0,
)  # reward per m, cost per step, reward of success
ANGLE_WEIGHT = 1.0  # m per rad, weight of the attitude error
_GOAL_RADII, _MAX_GOAL_SWING, _GOAL_HEIGHTS = (
    (4.5, 9.0),
    1.0,
    (0.8, 4.0),
)  # m, rad, m: range of the goal
_MAX_GOAL_ATTITUDE, _MAX_GOAL_HEAD = (
    0.6,
    0.4,
)  # rad, maximum angles of the goal from level and straight
_MAX_DRAWS, _FULL_SIZE_DRAWS = (
    140,
    100,
)  # maximum number of draws; draws before the path is shortened
_SHRINK_FACTOR = 0.7  # factor of the path per draw after those
_TARGET, _TIME_HELD, _REMAINING_DISTANCE = 0, 5, 6  # indices in `goal`


def list_reach_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_reach_observation` writes.

    They are the goal pose, the measured distance of the tip to it, and the time for which it has
    been held.
    """
    return [
        *make_pose_observation_fields(machine, len(axes), "reference"),
        ObservationField("distance", "m", 0.0, 2.0 * max_reach(machine)),
        ObservationField("held", "s", 0.0, 2.0 * HOLD_TIME),
    ]


@compiled
def draw_reach_goal(f, e):
    """Draw a goal pose of an episode that the arm can reach on a straight path from its start pose.

    Poses are drawn again until the path lies in the workspace (`compute_path_effort` is finite).
    After 100 draws, the path is shortened with every draw. The last of 140 draws is kept in any
    case.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; the goal pose, the remaining distance to it and the time held,
            0, are written to `goal`.

    Returns:
        Nothing.

    Source: this module.
    """
    g, start, change = e.goal, np.empty(MAX_ARM_AXES), np.empty(MAX_ARM_AXES)
    compute_tip_pose(f.arm, arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes]), start)
    size = f.difficulty
    for n in range(_MAX_DRAWS):
        if n >= _FULL_SIZE_DRAWS:
            size *= _SHRINK_FACTOR  # the start is inside the workspace, so a close pose is reachable
        change[0] = size * (draw_uniform_between(e, _GOAL_RADII[0], _GOAL_RADII[1]) - start[0])
        change[1] = size * draw_uniform_between(e, -_MAX_GOAL_SWING, _MAX_GOAL_SWING)
        change[2] = size * (draw_uniform_between(e, _GOAL_HEIGHTS[0], _GOAL_HEIGHTS[1]) - start[2])
        change[3] = size * (draw_uniform_between(e, -_MAX_GOAL_ATTITUDE, _MAX_GOAL_ATTITUDE) - start[3])
        change[4] = size * (draw_uniform_between(e, -_MAX_GOAL_HEAD, _MAX_GOAL_HEAD) - start[4])
        for c in range(MAX_ARM_AXES):
            g[_TARGET + c] = start[c] + change[c]
        if compute_path_effort(f, start, change) < np.inf:
            break
    g[_TIME_HELD] = 0.0
    g[_REMAINING_DISTANCE] = combine_pose_errors(*_compute_true_pose_errors(f, e))


@compiled
def compute_pose_errors(target, x, y, z, attitude, head):
    """Return the position and angle errors of the tip with respect to the goal pose.

    Args:
        target: (MAX_ARM_AXES,) goal pose: r [m], theta [rad], z [m], attitude, head [rad].
        x: position of the tip in the world frame, scalar [m].
        y: the same along y, scalar [m].
        z: the same along z, scalar [m].
        attitude: angle of the tilt link to the horizontal, scalar [rad].
        head: angle of the head, scalar [rad].

    Returns:
        (distance of the tip from the goal position [m], angle [rad]), scalars; the angle is the
        larger of the absolute errors of attitude and head.

    Source: this module.
    """
    dx, dy = x - target[0] * math.cos(target[1]), y - target[0] * math.sin(target[1])
    distance = math.sqrt(dx * dx + dy * dy + (z - target[2]) ** 2)
    return distance, max(abs(wrap_angle(attitude - target[3])), abs(head - target[4]))


@compiled
def combine_pose_errors(distance, angle):
    """Return position error [m] plus `ANGLE_WEIGHT` [m/rad] times angle error [rad] as one distance [m]."""
    return distance + ANGLE_WEIGHT * angle


@compiled
def _compute_true_pose_errors(f, e):
    arm = arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes])
    attitude = arm[1] + arm[2] + arm[3]
    target = e.goal[_TARGET : _TARGET + MAX_ARM_AXES]
    return compute_pose_errors(target, e.tip[0], e.tip[1], e.tip[2], attitude, arm[4])


@compiled
def write_reach_observation(f, e, out, at):
    """Write the goal pose, the measured distance to it, and the time for which it has been held to the observation.

    The distance is that of the tip position that follows from the measured joint positions.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_reach_observation_fields`.
    """
    tip = np.empty(MAX_ARM_AXES)
    compute_measured_pose(f, e, tip)
    for c in range(MAX_ARM_AXES):
        out[at + c] = e.goal[_TARGET + c]
    x, y = tip[0] * math.cos(tip[1]), tip[0] * math.sin(tip[1])
    target = e.goal[_TARGET : _TARGET + MAX_ARM_AXES]
    out[at + MAX_ARM_AXES] = compute_pose_errors(target, x, y, tip[2], tip[3], tip[4])[0]
    out[at + MAX_ARM_AXES + 1] = e.goal[_TIME_HELD]


@compiled
def compute_reach_reward(f, e, w):
    """Compute the reward of a step from the decrease of the remaining distance to the goal pose.

    The distance is that of the true pose; 1 rad of the larger angle error counts as 1 m. The reward
    is 1 per metre minus 0.01 per step. Holding the pose within the tolerances (MAX_DISTANCE,
    MAX_ANGLE, divided by the difficulty) for HOLD_TIME adds 10 and ends the episode.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` receives the remaining distance and the time held.
        w: SimulationView; `measures` receives the distance [m], the larger error of attitude and head [rad],
            and, as 0 or 1, whether the pose has been held for HOLD_TIME.

    Returns:
        (reward, whether the episode ends because the pose has been held), scalars.

    Source: this module.
    """
    g = e.goal
    distance, angle = _compute_true_pose_errors(f, e)
    left = combine_pose_errors(distance, angle)
    reward = REWARD_PER_METRE * (g[_REMAINING_DISTANCE] - left) - STEP_COST
    g[_REMAINING_DISTANCE] = left
    inside = distance <= MAX_DISTANCE / f.difficulty and angle <= MAX_ANGLE / f.difficulty
    step = f.ticks * f.period
    g[_TIME_HELD] = g[_TIME_HELD] + step if inside else 0.0
    done = g[_TIME_HELD] >= HOLD_TIME - 0.5 * step
    w.measures[0], w.measures[1], w.measures[2] = distance, angle, 1.0 if done else 0.0
    return reward + (SUCCESS_REWARD if done else 0.0), done


@compiled
def compute_reach_potential(f, e):
    """Return the potential of the true pose: the success reward, discounted until the pose has been held.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.

    Returns:
        The potential, scalar: 10 gamma^n. In n steps, the errors of r, theta, z, attitude and head vanish
        one after the other at the rates of full actions, and the rest of HOLD_TIME passes.

    Source: this module.
    """
    pose = np.empty(MAX_ARM_AXES)
    compute_tip_pose(f.arm, arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)
    time = HOLD_TIME - e.goal[_TIME_HELD]
    for c in range(MAX_ARM_AXES):
        error = pose[c] - e.goal[_TARGET + c]
        time += abs(error if c in (0, 2) else wrap_angle(error)) / f.fastest_pose[c]
    return SUCCESS_REWARD * f.shaping ** (time / (f.ticks * f.period))


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, arm axis -> [rad], with the head in the air before the machine, about level."""
    return sample_start_positions(
        machine, rng, (5.0, -0.5, 0.8, -0.4, -0.3), (8.0, 0.5, 3.0, 0.4, 0.3)
    )  # fmt: skip


REACH_FELLER = Task(
    name="ReachFeller",
    kind="reach",
    needs=("swing", "boom", "stick", "tool", "head"),
    description="A feller-buncher moves its head to a pose with all five axes and holds it there.",
    reward=(
        "The reward is 1 for every metre that the head approaches the pose (1 rad of attitude or"
        " head angle counts as 1 m), minus 0.01 per step. Holding the pose within 0.05 m and"
        " 0.03 rad for 0.5 s ends the episode with an additional reward of 10 (success)."
    ),
    machine="cat325",
    tool=None,
    duration=20.0,
    start=_sample_start_positions,
    fields=list_reach_observation_fields,
    measures=(("distance", "m"), ("attitude_error", "rad"), ("success", "1")),
    servo=Servo(axis_gains={"swing": 1.0, "boom": 2.0}),  # large inertia on compressible oil
    pose_rates=(0.5, 0.2, 0.5, 0.2, 0.2),
)
"""Reach and hold a pose of the feller-buncher's head."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `ReachFeller` for the simulation `number`, in native code.

    `part` is BEGIN (draw the goal pose of a new episode), TICK (do nothing), OBSERVE (write
    the task's values to the observation, from the address `out` on), REWARD (return the reward
    and store whether the episode ends) or POTENTIAL (return the potential). `m`, `d` and `argument`
    are the addresses of mjModel, mjData and TASK_PARAMETERS. The result is 0 for the other parts;
    see `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_reach_goal(f, e)
    elif part == OBSERVE:
        write_reach_observation(f, e, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_reach_reward(f, e, w))
    elif part == POTENTIAL:
        return compute_reach_potential(f, e)
    return 0.0
