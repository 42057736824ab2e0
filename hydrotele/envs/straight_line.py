"""The task `StraightLine`: move the tip along a straight line at constant tool attitude.

The speed profile is trapezoidal. The line is straight in r and z; in some episodes the swing
rotates in proportion to the travel. Lines are drawn at random until one lies in the workspace and
does not exceed the rates of the drives.
"""

import math

import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import MAX_ARM_AXES, arm_values, draw_uniform, draw_uniform_between
from hydrotele.envs.observation import ObservationField, make_pose_observation_fields, max_reach
from hydrotele.envs.task import (
    Task,
    compute_measured_pose,
    compute_path_effort,
    compute_tracking_potential,
    sample_start_positions,
    size_ratio,
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

PREVIEW_TIMES = (0.1, 0.2, 0.4)  # s, look-ahead times of the observed reference
CROSS_ERROR_SCALE, ALONG_ERROR_SCALE, ATTITUDE_ERROR_SCALE = (
    0.1,
    0.2,
    0.2,
)  # m, m, rad of error that cost a reward of 1
SETTLE_TIME = 0.5  # s before the motion starts
_MIN_LENGTH, _MAX_LENGTH = 1.0, 3.0  # m, range of the length
_MIN_SPEED, _MAX_SPEED = 0.2, 0.6  # m/s, range of the speed
_MIN_ACCELERATION, _MAX_ACCELERATION = 0.5, 1.0  # m/s^2, range of the acceleration
_MAX_SWING_PER_METRE, _SWING_FRACTION = (
    0.08,
    0.4,
)  # rad of swing per metre at most, fraction of episodes with swing
_MIN_RADIUS, _MIN_HEIGHT, _MAX_HEIGHT = (
    3.0,
    0.1,
    6.0,
)  # m: minimum radius beyond the tracks, range of the height
_MAX_EFFORT = 0.9  # maximum sum of relative axis rates, see `compute_path_effort`
_MAX_DRAWS, _FULL_SIZE_DRAWS = (
    240,
    200,
)  # maximum number of draws; draws before the line is shortened
_SHRINK_FACTOR = 0.7  # factor of length and speed per draw after those
# indices in `goal`: pose at the start (r, theta, z, attitude), change of the pose per metre
_START, _PER_METRE, _LENGTH, _SPEED, _ACCELERATION = 0, 4, 7, 8, 9
_SIZE_RATIO = 0  # index in the task parameters
_R, _THETA, _Z, _ATTITUDE, _HEAD = range(MAX_ARM_AXES)
# indices in the observation of the task: pose, its rate, positions ahead, errors
_POSE_COLUMN, _RATE_COLUMN, _PREVIEW_COLUMN = 0, 4, 7
_ALONG_COLUMN = _PREVIEW_COLUMN + 3 * len(PREVIEW_TIMES)
_CROSS_COLUMN = _ALONG_COLUMN + 1
_RATE_BOUND = 1.0  # m/s, rad/s: bound of the reference rates


def list_line_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_line_observation` writes.

    They are the reference pose, its rates, the reference position 0.1, 0.2 and 0.4 s ahead, and the
    tracking errors along and across the line.
    """
    k, far = len(axes), max_reach(machine)
    fields = make_pose_observation_fields(machine, k, "reference")
    fields += [ObservationField(f"reference_rate.{c}", unit, -_RATE_BOUND, _RATE_BOUND)
               for c, unit in (("r", "m/s"), ("theta", "rad/s"), ("z", "m/s"))]  # fmt: skip
    for ahead in PREVIEW_TIMES:
        fields += make_pose_observation_fields(machine, k, f"reference_in_{ahead * 1000:.0f}_ms")[:3]
    return [
        *fields,
        ObservationField("along_track_error", "m", -2.0 * far, 2.0 * far),
        ObservationField("cross_track_error", "m", 0.0, 2.0 * far),
    ]


@compiled
def draw_line_goal(f, e):
    """Draw the goal of an episode: a straight line from the present tip position, with speed and acceleration.

    Direction and length are drawn again until the end has an allowed radius and height, and the
    path lies in the workspace and does not exceed the rates of the drives (`compute_path_effort`).
    After 200 draws, length and speed are reduced with every draw. The last of 240 draws is kept in
    any case. Lengths, heights and speeds are those of the CAT 215 times the ratio of the reaches.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; the line is written to `goal`.

    Returns:
        Nothing.

    Source: this module.
    """
    g, start, change = e.goal, np.zeros(MAX_ARM_AXES), np.zeros(MAX_ARM_AXES)
    ratio = f.parameters[_SIZE_RATIO]
    compute_tip_pose(f.arm, arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes]), start)
    for c in range(4):
        g[_START + c] = start[c]
    speed, g[_ACCELERATION] = (
        ratio * draw_uniform_between(e, _MIN_SPEED, _MAX_SPEED),
        draw_uniform_between(e, _MIN_ACCELERATION, _MAX_ACCELERATION),
    )
    turn = draw_uniform_between(e, -_MAX_SWING_PER_METRE, _MAX_SWING_PER_METRE) / ratio
    if draw_uniform(e) >= _SWING_FRACTION:
        turn = 0.0
    size = f.difficulty
    for n in range(_MAX_DRAWS):
        if n >= _FULL_SIZE_DRAWS:
            size *= _SHRINK_FACTOR  # the start is inside the workspace, so a short slow line fits
        way, length = (
            draw_uniform_between(e, -math.pi, math.pi),
            size * ratio * draw_uniform_between(e, _MIN_LENGTH, _MAX_LENGTH),
        )
        g[_PER_METRE + _R], g[_PER_METRE + _THETA] = math.cos(way), turn
        g[_PER_METRE + _Z] = math.sin(way)
        g[_LENGTH], g[_SPEED] = length, size * speed
        for c in range(3):
            change[c] = length * g[_PER_METRE + c]
        radius, height = start[_R] + change[_R], start[_Z] + change[_Z]
        if radius < ratio * _MIN_RADIUS or not _MIN_HEIGHT <= height <= ratio * _MAX_HEIGHT:
            continue
        if compute_path_effort(f, start, change) * g[_SPEED] / length <= _MAX_EFFORT:
            break


@compiled
def compute_line_travel(g, time):
    """Return the distance that the reference has travelled along the line at a time, and its speed.

    The speed profile is trapezoidal and starts 0.5 s (SETTLE_TIME) after the start of the episode.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        time: time since the start of the episode, scalar [s].

    Returns:
        (distance [m], speed [m/s]), scalars.

    Source: this module.
    """
    length, most = g[_LENGTH], g[_ACCELERATION]
    speed = min(g[_SPEED], math.sqrt(most * length))
    ramp = speed / most
    total = length / speed + ramp
    t = min(max(time - SETTLE_TIME, 0.0), total)
    if t < ramp:
        return 0.5 * most * t * t, most * t
    left = total - t
    if left < ramp:
        return length - 0.5 * most * left * left, most * left
    return speed * (t - 0.5 * ramp), speed


@compiled
def compute_line_pose(g, time, pose, rate):
    """Compute the reference pose on the line at a time, and its rate.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        time: time since the start of the episode, scalar [s].
        pose: (MAX_ARM_AXES,) written: r [m], theta [rad], z [m], attitude [rad], 0.
        rate: (MAX_ARM_AXES,) written: time derivative of the pose [m/s], [rad/s]; 0 for attitude
            and head.

    Returns:
        Nothing.

    Source: this module.
    """
    way, speed = compute_line_travel(g, time)
    for c in range(3):
        pose[c] = g[_START + c] + way * g[_PER_METRE + c]
        rate[c] = speed * g[_PER_METRE + c]
    pose[_ATTITUDE], pose[_HEAD] = g[_START + _ATTITUDE], 0.0
    rate[_ATTITUDE], rate[_HEAD] = 0.0, 0.0


@compiled
def compute_line_errors(g, reference, r, theta, z):
    """Return the errors of the tip position along and across the line, relative to the reference position.

    The radial, tangential and vertical distance of the tip from the reference are projected onto
    the direction of the line.

    Args:
        g: (GOAL_SIZE,) task values of the episode (`goal` of EPISODE_STATE).
        reference: (MAX_ARM_AXES,) reference pose: r [m], theta [rad], z [m]; the others are not
            used.
        r: radius of the tip, scalar [m].
        theta: angle of the tip about the swing axis, modulo 2 pi, scalar [rad].
        z: height of the tip, scalar [m].

    Returns:
        (along-track error [m], positive if the tip is ahead of the reference; cross-track error
        [m], not negative), scalars.

    Source: this module.
    """
    x, up = r - reference[_R], z - reference[_Z]
    y = reference[_R] * wrap_angle(theta - reference[_THETA])
    ahead, rise = g[_PER_METRE + _R], g[_PER_METRE + _Z]
    aside = reference[_R] * g[_PER_METRE + _THETA]
    along = (x * ahead + y * aside + up * rise) / math.sqrt(ahead**2 + aside**2 + rise**2)
    return along, math.sqrt(max(0.0, x * x + y * y + up * up - along * along))


@compiled
def write_line_observation(f, e, out, at):
    """Write reference pose and rate, the reference position ahead, and the tracking errors to the observation.

    The errors are those of the tip position that follows from the measured joint positions.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_line_observation_fields`.
    """
    now, pose, rate, tip = (
        e.tick * f.period,
        np.empty(MAX_ARM_AXES),
        np.empty(MAX_ARM_AXES),
        np.empty(MAX_ARM_AXES),
    )
    compute_line_pose(e.goal, now, pose, rate)
    compute_measured_pose(f, e, tip)
    for c in range(4):
        out[at + _POSE_COLUMN + c] = pose[c]
    for c in range(3):
        out[at + _RATE_COLUMN + c] = rate[c]
    along, across = compute_line_errors(e.goal, pose, tip[_R], tip[_THETA], tip[_Z])
    out[at + _ALONG_COLUMN], out[at + _CROSS_COLUMN] = along, across
    for p in range(len(PREVIEW_TIMES)):
        compute_line_pose(e.goal, now + PREVIEW_TIMES[p], pose, rate)
        for c in range(3):
            out[at + _PREVIEW_COLUMN + 3 * p + c] = pose[c]


@compiled
def reward_from_errors(across, along, attitude):
    """Return the reward of tracking errors: 1 minus their weighted sum, at least -1.

    The errors are `across` the line [m], `along` the line [m] and in `attitude` [rad], by absolute
    value. 0.1 m across, 0.2 m along or 0.2 rad cost 1 each.
    """
    costs = across / CROSS_ERROR_SCALE + abs(along) / ALONG_ERROR_SCALE + abs(attitude) / ATTITUDE_ERROR_SCALE
    return max(-1.0, 1.0 - costs)


@compiled
def compute_true_line_errors(f, e):
    """Return the true errors of an episode, from its records of TASK_PARAMETERS and EPISODE_STATE.

    They are (error across the line [m], error along the line [m], attitude error [rad]), scalars.
    """
    pose, rate = np.empty(MAX_ARM_AXES), np.empty(MAX_ARM_AXES)
    compute_line_pose(e.goal, e.tick * f.period, pose, rate)
    r, theta = math.hypot(e.tip[0], e.tip[1]), math.atan2(e.tip[1], e.tip[0])
    along, across = compute_line_errors(e.goal, pose, r, theta, e.tip[2])
    arm = arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes])
    attitude = arm[1] + arm[2] + arm[3] - pose[_ATTITUDE]
    return across, along, attitude


@compiled
def compute_line_reward(f, e, w):
    """Compute the reward of a step from the true errors of tip position and attitude.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView; `measures` receives the cross-track and along-track errors [m] and the attitude
            error [rad].

    Returns:
        (reward, False), scalars; False because this task never ends an episode early.

    Source: `reward_from_errors`.
    """
    across, along, attitude = compute_true_line_errors(f, e)
    w.measures[0], w.measures[1], w.measures[2] = across, along, attitude
    return reward_from_errors(across, along, attitude), False


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, arm axis -> [rad], with the bucket in the air.

    The range is about that of Zhu 1994, Figs 6.45-6.48, for a machine of the reach of the CAT 215.
    """
    ratio = size_ratio(machine, "cat215", "bucket")
    low, high = (4.8 * ratio, -0.5, 0.4 * ratio, -1.9), (6.5 * ratio, 0.5, 2.4 * ratio, -1.2)
    return sample_start_positions(machine, rng, low, high)


@compiled
def compute_line_potential(f, e):
    """Return the potential of the sum of the true errors, see `compute_tracking_potential`.

    `f` and `e` are records of TASK_PARAMETERS and EPISODE_STATE.
    """
    across, along, attitude = compute_true_line_errors(f, e)
    return compute_tracking_potential(f, across + abs(along) + abs(attitude))


STRAIGHT_LINE = Task(
    name="StraightLine",
    kind="line",
    needs=("swing", "boom", "stick", "tool"),
    description=(
        "The tip of an excavator's bucket moves along a straight line of 1 to 3 m at 0.2 to 0.6 m/s"
        " with constant attitude."
    ),
    reward=(
        "The reward of a step is 1 without error and at least -1. It decreases by 1 for every 0.1 m of error"
        " perpendicular to the line, every 0.2 m along the line, and every 0.2 rad of attitude error."
    ),
    machine="cat215",
    tool="bucket",
    action="resolved_motion",
    duration=16.5,  # s: enough for the longest and slowest line
    start=_sample_start_positions,
    fields=list_line_observation_fields,
    parameters=lambda machine, model: (size_ratio(machine, "cat215", "bucket"),),
    measures=(("cross_track_error", "m"), ("along_track_error", "m"), ("attitude_error", "rad")),
    # a higher gain excites the oil resonance of the boom near the end of its range
    servo=Servo(axis_gains={"boom": 2.0}),
    pose_rates=(0.9, 0.3, 0.9, 0.4, 0.25),  # 1.5 times the fastest line
)
"""Move the tip along a straight line."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `StraightLine` for the simulation `number`, in native code.

    `part` is BEGIN (draw the line of a new episode), TICK (do nothing), OBSERVE (write
    the task's values to the observation, from the address `out` on), REWARD (return the reward
    and store whether the episode ends) or POTENTIAL (return the potential). `m`, `d` and `argument`
    are the addresses of mjModel, mjData and TASK_PARAMETERS. The result is 0 for the other parts;
    see `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_line_goal(f, e)
    elif part == OBSERVE:
        write_line_observation(f, e, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_line_reward(f, e, w))
    elif part == POTENTIAL:
        return compute_line_potential(f, e)
    return 0.0
