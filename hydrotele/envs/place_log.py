"""The task `PlaceLog`: pick up a log from the ground with a grapple and lay it down at a goal pose.

The start pose and the goal pose of the log are drawn for every episode. The log is a free body
whose coordinates are set at the start, so one compiled model serves all episodes. The grapple hangs
from two free joints. Both have angle sensors with the sampling rate, error and resolution of the
first axis.
"""

import math

import mujoco
import numpy as np

from hydrotele.core.compiled import callback, compiled
from hydrotele.envs.episode import MAX_ARM_AXES, arm_values, draw_uniform, draw_uniform_between
from hydrotele.envs.observation import ObservationField, max_reach
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
from hydrotele.scenario.surrounding_objects import LogOnGround
from hydrotele.simulate.gripping import (
    GRIP_SIZE,
    POCKET_CENTRE,
    TAKEN,
    WELD_SIZE,
    grip_step,
    timber_log_grip_parameters,
)
from hydrotele.simulate.sensor_models import quantise_reading

GRAPPLE_BODY, LOG_BODY, WELD_ID, JAW_QPOS, LOG_QPOS, LOG_RADIUS, LOG_HALF_LENGTH = range(
    GRIP_SIZE, GRIP_SIZE + 7
)  # indices in `parameters`
_FREE_JOINT_INDICES = GRIP_SIZE + 7  # index in `parameters`: (qpos, qvel) indices of pitch, then of roll
FREE_JOINTS = ("grapple_pitch", "grapple_roll")
MEASURED_START = 0  # index in `goal` of the measured values: pitch, roll, their rates
MEASURED_COUNT = 4  # number of measured values of the free joints


def pack_grapple_parameters(machine: Machine, model: mujoco.MjModel, log: LogOnGround) -> np.ndarray:
    """Return the task parameters for a grapple and one log.

    Args:
        machine: the machine.
        model: its MuJoCo model with the log as `log_0`.
        log: the log.

    Returns:
        (GRIP_SIZE + 11,): parameters of `simulate.gripping.grip_step`, then the ids of the grapple's
        body, the log's body and the weld, the indices in `qpos` of jaw and log, the radius and half
        length of the log [m], and the indices of the free joints in `qpos` and `qvel`.
    """
    hand = machine.links[machine.link_of(machine.axes[log.grab].joint)].parent
    places = [
        model.body(hand).id, model.body("log_0").id, model.equality("log_0_held").id,
        model.joint(machine.axes[log.grab].joint).qposadr[0], model.joint("log_0").qposadr[0],
        log.diameter / 2.0, log.length / 2.0,
    ]  # fmt: skip
    for name in FREE_JOINTS:
        places += [model.joint(name).qposadr[0], model.joint(name).dofadr[0]]
    return np.concatenate([timber_log_grip_parameters(model, log), np.array(places, float)])


@compiled
def is_log_held(f, w):
    """Return whether the grapple holds the log, that is, whether the weld constraint between them is active.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView.

    Returns:
        bool.

    Source: this module.
    """
    return w.eq_active[int(f.parameters[WELD_ID])] != 0


@compiled
def _slice_body_values(values, count, at):
    """Return the `count` values of the body with index `at` from an array of all bodies."""
    return values[count * at : count * at + count]


@compiled
def _update_grip(f, w):
    hand, log, weld = (
        int(f.parameters[GRAPPLE_BODY]),
        int(f.parameters[LOG_BODY]),
        int(f.parameters[WELD_ID]),
    )
    first = weld * f.eq_width
    change = grip_step(
        f.parameters[:GRIP_SIZE], _slice_body_values(w.xpos, 3, hand), _slice_body_values(w.xquat, 4, hand),
        _slice_body_values(w.xpos, 3, log), _slice_body_values(w.xquat, 4, log), w.qpos[int(f.parameters[JAW_QPOS])],
        w.eq_active[weld] != 0, w.eq_rows[first : first + WELD_SIZE],
    )  # fmt: skip
    if change == 0:
        return
    w.eq_active[weld] = 1 if change == TAKEN else 0
    for c in range(first, first + WELD_SIZE):  # eq_data acts now, eq_rows from the next call on
        w.eq_data[c] = w.eq_rows[c]


@compiled
def measure_free_joints(f, e, w):
    """Measure the angles and rates of the two joints from which the grapple swings, if a sample is due.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; both angles and then both rates are written to `goal`.
        w: SimulationView, with staggered positions and velocities, see `simulate.record`.

    Returns:
        Nothing.

    Source: like `envs.environment_step.update_sensors`, with the error and resolution of the sensor of the first axis.
    """
    if e.tick % f.every != 0:
        return
    for j in range(2):
        place, dof = (
            int(f.parameters[_FREE_JOINT_INDICES + 2 * j]),
            int(f.parameters[_FREE_JOINT_INDICES + 2 * j + 1]),
        )
        value = w.qpos[place] - f.timestep * w.qvel[dof]
        if f.noisy:
            value += f.accuracy[0] * (2.0 * draw_uniform(e) - 1.0)
            value = quantise_reading(value, f.converters[0, 0], f.converters[1, 0], f.converters[2, 0])
        past = e.goal[MEASURED_START + j]
        e.goal[MEASURED_START + 2 + j] = (value - past) / (f.every * f.period) if e.tick > 0 else 0.0
        e.goal[MEASURED_START + j] = value


@compiled
def update_grapple(f, e, w):
    """Grip or release the log according to the jaw angle, and measure the swing joints of the grapple.

    Args:
        f: record of TASK_PARAMETERS; its parameters are those of `pack_grapple_parameters`.
        e: record of EPISODE_STATE; the measured swing angles and rates are written to `goal`.
        w: SimulationView after a physics step; the weld is written.

    Returns:
        Nothing.

    Source: `simulate.gripping.grip_step`.
    """
    _update_grip(f, w)
    measure_free_joints(f, e, w)


@compiled
def compute_grip_misalignment(f, w):
    """Return the distance and the angle between the grapple's pocket and the log.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView after a physics step.

    Returns:
        (distance from the centre of the pocket to the part of the log's axis that can be gripped
        [m], angle between the axes of pocket and log [rad]), scalars.

    Source: this module.
    """
    hand, log, reach = (
        int(f.parameters[GRAPPLE_BODY]),
        int(f.parameters[LOG_BODY]),
        f.parameters[GRIP_SIZE - 1],
    )
    turn, own = _slice_body_values(w.xmat, 9, hand), _slice_body_values(w.xmat, 9, log)
    along, across, square = 0.0, 0.0, 0.0
    way = np.empty(3)
    for c in range(3):
        way[c] = w.xpos[3 * hand + c] - w.xpos[3 * log + c]
        for k in range(3):
            way[c] += turn[3 * c + k] * f.parameters[POCKET_CENTRE + k]
        along += way[c] * own[3 * c]
        across += turn[3 * c + 1] * own[3 * c]
    along = min(reach, max(-reach, along))
    for c in range(3):
        square += (way[c] - along * own[3 * c]) ** 2
    return np.sqrt(square), np.arccos(min(1.0, abs(across)))


@compiled
def grapple_tilt_angle(f, w):
    """Return the angle between the grapple and the vertical.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView after a physics step.

    Returns:
        The angle, scalar [rad].

    Source: the x axis of the grapple points down.
    """
    down = -w.xmat[9 * int(f.parameters[GRAPPLE_BODY]) + 6]
    return np.arccos(min(1.0, max(-1.0, down)))


MAX_DISTANCE, MAX_YAW_ERROR, HOLD_TIME = (
    0.3,
    math.radians(15.0),
    0.5,
)  # m, rad, s: tolerances of a placed log
REWARD_PER_METRE, STEP_COST, TILT_COST = (
    1.0,
    0.005,
    0.02,
)  # reward per m, cost per step, per step and rad of tilt
GRIP_REWARD, SUCCESS_REWARD, LOST_REWARD = (
    5.0,
    20.0,
    -20.0,
)  # rewards of the first grip, of success, of a lost log
YAW_WEIGHT, MISALIGNMENT_WEIGHT = (
    1.0,
    0.5,
)  # m per rad: weights of the log's yaw error and the grapple's misalignment
_LYING_TOLERANCE = 0.05  # m and rad, maximum height error and slope of a log that lies on the ground
_GRIP_RADII = (2.3, 8.7)  # m from the swing axis, range in which the log can be gripped
_GOAL_RADII = (4.5, 6.5)  # m, range of the radius of log and goal
_LOG_ANGLES = (0.15, 0.5)  # rad, range of the angle from the grapple to the log
_GOAL_ANGLES = (math.radians(30.0), math.radians(90.0))  # rad, range of the angle from log to goal
_MIN_GOAL_SIZE = 0.25  # of the distance to the goal pose: 7.5 deg at 4.5 m are 0.6 m, twice the tolerance
_X, _Y, _YAW, _REMAINING_DISTANCE, _TIME_HELD, _WAS_GRIPPED = range(
    MEASURED_START + MEASURED_COUNT, MEASURED_START + MEASURED_COUNT + 6
)  # in `goal`
GOAL_POSE = slice(_X, _YAW + 1)  # slice of `goal`: x [m], y [m], yaw [rad] of the goal pose
_RATE_BOUND = 10.0  # rad/s, bound of the difference quotient of noisy samples


def list_place_observation_fields(machine: Machine, axes: tuple[str, ...]) -> list[ObservationField]:
    """Return name, unit and bounds of the values that `write_place_observation` writes.

    They are the poses of log and goal, whether the log is held, and angles and rates of the two
    free joints from which the grapple swings.
    """
    far = 2.0 * max_reach(machine)
    fields = []
    for what, high in (("log", ("z",)), ("goal", ())):
        fields += [
            ObservationField(f"{what}.r", "m", 0.0, far), ObservationField(f"{what}.theta", "rad", -math.pi, math.pi)
        ]  # fmt: skip
        fields += [ObservationField(f"{what}.{name}", "m", -far, far) for name in high]
        fields += [ObservationField(f"{what}.{name}_2_yaw", "1", -1.0, 1.0) for name in ("sin", "cos")]
    fields.append(ObservationField("held", "1", 0.0, 1.0))
    for name in FREE_JOINTS:
        low, top = machine.joints[name].range or (-math.pi, math.pi)
        fields.append(ObservationField(f"pendulum.{name}", "rad", low - 0.15, top + 0.15))
    fields += [ObservationField(f"pendulum_rate.{name}", "rad/s", -_RATE_BOUND, _RATE_BOUND) for name in FREE_JOINTS]
    return fields


@compiled
def draw_log_poses(f, e, w):
    """Draw the start pose and the goal pose of the log on the ground, both with random yaw.

    A difficulty below 1 moves the log towards the grapple, and the goal pose towards the log; their distance is at
    least a quarter of that of the task, so that the log does not lie at its goal from the start. The swing of the
    grapple is measured for the first time.

    Args:
        f: record of TASK_PARAMETERS; its parameters are those of `pack_grapple_parameters`.
        e: record of EPISODE_STATE; the goal pose is written to `goal`.
        w: SimulationView; the log's coordinates in `qpos` are written.

    Returns:
        Nothing.

    Source: this module.
    """
    g, pose, at = e.goal, np.empty(MAX_ARM_AXES), int(f.parameters[LOG_QPOS])
    compute_tip_pose(f.arm, arm_values(f, e.position, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)
    near, goal = f.difficulty, max(f.difficulty, _MIN_GOAL_SIZE)
    radius, theta = (
        near * draw_uniform_between(e, _GOAL_RADII[0], _GOAL_RADII[1]) + (1.0 - near) * pose[0],
        pose[1] + near * _draw_with_random_sign(e, _LOG_ANGLES),
    )
    half = 0.5 * draw_uniform_between(e, 0.0, math.pi)
    w.qpos[at], w.qpos[at + 1] = radius * math.cos(theta), radius * math.sin(theta)
    w.qpos[at + 3], w.qpos[at + 4], w.qpos[at + 5] = math.cos(half), 0.0, 0.0
    w.qpos[at + 6] = math.sin(half)
    theta += goal * _draw_with_random_sign(e, _GOAL_ANGLES)
    radius = goal * draw_uniform_between(e, _GOAL_RADII[0], _GOAL_RADII[1]) + (1.0 - goal) * radius
    g[_X], g[_Y] = radius * math.cos(theta), radius * math.sin(theta)
    g[_YAW] = goal * draw_uniform_between(e, 0.0, math.pi) + (1.0 - goal) * 2.0 * half
    g[_REMAINING_DISTANCE], g[_TIME_HELD], g[_WAS_GRIPPED] = -1.0, 0.0, 0.0
    measure_free_joints(f, e, w)


@compiled
def _draw_with_random_sign(e, size):
    value = draw_uniform_between(e, size[0], size[1])
    return value if draw_uniform(e) < 0.5 else -value


@compiled
def compute_wood_log_pose(f, w):
    """Return the position and the direction of the wooden log.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView.

    Returns:
        (x [m], y [m], z [m], sine and cosine of twice the yaw of the axis, sine of the angle
        between axis and horizontal plane), scalars. Twice the yaw, since both ends are equivalent.

    Source: this module.
    """
    at = int(f.parameters[LOG_QPOS])
    a, b, c, d = w.qpos[at + 3], w.qpos[at + 4], w.qpos[at + 5], w.qpos[at + 6]
    ax, ay, az = 1.0 - 2.0 * (c * c + d * d), 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)
    level = max(1.0e-12, ax * ax + ay * ay)
    return (
        w.qpos[at], w.qpos[at + 1], w.qpos[at + 2], 2.0 * ax * ay / level,
        (ax * ax - ay * ay) / level, az,
    )  # fmt: skip


@compiled
def undirected_yaw_difference(sine, cosine, yaw):
    """Return the angle between two undirected horizontal axes.

    Args:
        sine: sine of twice the yaw of the first axis, scalar.
        cosine: cosine of twice the yaw of the first axis, scalar.
        yaw: yaw of the second axis, scalar [rad].

    Returns:
        The angle, scalar from 0 to pi/2 [rad].

    Source: this module.
    """
    s, c = math.sin(2.0 * yaw), math.cos(2.0 * yaw)
    return 0.5 * abs(math.atan2(sine * c - cosine * s, cosine * c + sine * s))


@compiled
def write_place_observation(f, e, w, out, at):
    """Write the poses of log and goal, whether the log is held, and the swing of the grapple to the observation.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        w: SimulationView.
        out: (observations,) float32, written from index `at` on.
        at: index of the first value to write, scalar.

    Returns:
        Nothing.

    Source: `list_place_observation_fields`.
    """
    g = e.goal
    x, y, z, sine, cosine, _ = compute_wood_log_pose(f, w)
    out[at], out[at + 1], out[at + 2] = math.hypot(x, y), math.atan2(y, x), z
    out[at + 3], out[at + 4] = sine, cosine
    out[at + 5], out[at + 6] = math.hypot(g[_X], g[_Y]), math.atan2(g[_Y], g[_X])
    out[at + 7], out[at + 8] = math.sin(2.0 * g[_YAW]), math.cos(2.0 * g[_YAW])
    out[at + 9] = 1.0 if is_log_held(f, w) else 0.0
    for c in range(MEASURED_COUNT):
        out[at + 10 + c] = g[MEASURED_START + c]


@compiled
def compute_place_reward(f, e, w):
    """Compute the reward of a step for moving the grapple to the log and the log to its goal.

    It is 1 per metre by which the remaining distance decreases: distance and yaw error of the log
    and, while the log is neither held nor at its goal, also distance and misalignment of the
    grapple. Every step costs 0.005, plus 0.02 per radian of the grapple's tilt. The first grip adds
    5. A released log that has lain within the tolerances of its goal for HOLD_TIME is placed, which
    adds 20; one out of reach adds -20.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `goal` receives the remaining distance, the time at the goal,
            and whether the log has been gripped.
        w: SimulationView; `measures` receives the distance [m] and yaw error [rad] of the log, whether it is
            held, whether it is placed, and the angle of the grapple to the vertical [rad].

    Returns:
        (reward, whether the episode ends because the log is placed or out of reach), scalars.

    Source: this module.
    """
    g, held = e.goal, is_log_held(f, w)
    x, y, z, sine, cosine, slope = compute_wood_log_pose(f, w)
    height = z - f.parameters[LOG_RADIUS]
    distance = math.sqrt((x - g[_X]) ** 2 + (y - g[_Y]) ** 2 + height**2)
    yaw, swing = undirected_yaw_difference(sine, cosine, g[_YAW]), grapple_tilt_angle(f, w)
    lies = not held and height < _LYING_TOLERANCE and abs(slope) < _LYING_TOLERANCE
    there = lies and distance <= MAX_DISTANCE and yaw <= MAX_YAW_ERROR
    left = distance + YAW_WEIGHT * yaw
    if not (held or there):
        apart, askew = compute_grip_misalignment(f, w)
        left += apart + MISALIGNMENT_WEIGHT * askew
    if g[_REMAINING_DISTANCE] < 0.0:  # first step: the position of the grapple is not known before
        g[_REMAINING_DISTANCE] = left
    reward = REWARD_PER_METRE * (g[_REMAINING_DISTANCE] - left) - STEP_COST - TILT_COST * swing
    g[_REMAINING_DISTANCE] = left
    if held and g[_WAS_GRIPPED] == 0.0:
        g[_WAS_GRIPPED] = 1.0
        reward += GRIP_REWARD
    step = f.ticks * f.period
    g[_TIME_HELD] = g[_TIME_HELD] + step if there else 0.0
    placed = g[_TIME_HELD] >= HOLD_TIME - 0.5 * step
    lost = not held and not _GRIP_RADII[0] <= math.hypot(x, y) <= _GRIP_RADII[1]
    w.measures[0], w.measures[1], w.measures[2] = distance, yaw, 1.0 if held else 0.0
    w.measures[3], w.measures[4] = 1.0 if placed else 0.0, swing
    if placed:
        reward += SUCCESS_REWARD
    elif lost:
        reward += LOST_REWARD
    return reward, placed or lost


LOG_TO_PLACE = LogOnGround(position=(5.5, 0.0), direction=math.pi / 2.0)
"""The log; `draw_log_poses` overwrites its pose."""

_MIN_START_POSE, _MAX_START_POSE = (
    (4.5, -0.5, 2.2),
    (6.5, 0.5, 2.8),
)  # m, rad, m: start of the pin at the stick's tip


def _sample_start_positions(machine: Machine, rng: np.random.Generator) -> dict[str, float]:
    """Return random start positions, joint or axis -> [rad].

    The open grapple hangs vertically with random rotation. The pin at the stick's tip is 2.2 to 2.8
    m high.
    """
    joints = sample_start_positions(machine, rng, _MIN_START_POSE, _MAX_START_POSE)
    plumb = -0.5 * math.pi - joints["boom"] - joints["stick"]
    turned = float(rng.uniform(-0.5, 0.5) * math.pi)
    return {**joints, "grapple_pitch": plumb, "grapple": turned, "claw": 0.0}


def _make_grapple_parameters(machine: Machine, model: mujoco.MjModel) -> np.ndarray:
    return pack_grapple_parameters(machine, model, LOG_TO_PLACE)


PLACE_LOG = Task(
    name="PlaceLog",
    kind="place",
    needs=("swing", "boom", "stick", *FREE_JOINTS),
    description=(
        "An excavator picks up a log from the ground with a freely swinging grapple and lays it"
        " down at a goal position and yaw. The poses of log and goal are known exactly, also with"
        " real sensors."
    ),
    reward=(
        "The reward is 1 for every metre that the log approaches its goal; 1 rad of yaw error"
        " counts as 1 m. While the log is not held, it is also 1 for every metre that the grapple approaches the log;"
        " 1 rad of misalignment counts as 0.5 m. The first grip is worth 5. Every step costs 0.005,"
        " and in addition 0.02 per radian between the grapple and the vertical. The episode ends with an additional"
        " reward of 20 (success) when the released log has lain within 0.3 m and 15 deg of its goal for 0.5 s. It ends"
        " with -20 if the log is out of reach."
    ),
    machine="cat215",
    tool="grapple_claw",
    extra_axes=("grapple", "claw"),
    action="resolved_motion",
    duration=60.0,
    start=_sample_start_positions,
    fields=list_place_observation_fields,
    measures=(
        ("log_distance", "m"), ("yaw_error", "rad"), ("held", "1"), ("success", "1"),
        ("swing_angle", "rad"),
    ),
    surroundings=lambda *_: (LOG_TO_PLACE,),
    ground=True,
    parameters=_make_grapple_parameters,
    written_fields=("eq_data",),
    # with the default of 4 /s, valve delay and stiction make boom and grapple oscillate
    servo=Servo(position_gain=2.5, axis_gains={"boom": 2.0}),
)  # fmt: skip
"""Pick up a log and lay it down with the claw of the CAT 215."""


@callback(TASK_SIGNATURE)
def run_task_part(part, m, d, number, argument, out):
    """Run one part of the task `PlaceLog` for the simulation `number`, in native code.

    `part` is BEGIN (draw start and goal pose of the log), TICK (grip or release the log, and
    measure), OBSERVE (write the task's values to the observation, from the address `out` on) or
    REWARD (return the reward and store whether the episode ends). `m`, `d` and `argument` are the
    addresses of mjModel, mjData and TASK_PARAMETERS. The result is 0 except for REWARD; see
    `task_interface.TASK_SIGNATURE`.
    """
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[number], simulation_view(f, m, d, number, argument)
    if part == BEGIN:
        draw_log_poses(f, e, w)
    elif part == TICK:
        update_grapple(f, e, w)
    elif part == OBSERVE:
        write_place_observation(f, e, w, observation_view(f, out), 0)
    elif part == REWARD:
        return store_episode_end(e, compute_place_reward(f, e, w))
    return 0.0
