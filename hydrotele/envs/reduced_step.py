"""Environment step on the reduced model: functions that run in the control periods of `hydrotele.batch.Batch`.

Actions, servo, sensors, observation, reward and goals are those of the environments on MuJoCo: the functions of
`episode_step` and of the tasks. The motion of the machine is that of the reduced model.
"""

from typing import Any, NamedTuple

import numpy as np

from hydrotele.batch.machine_step import restart_history, restart_machine
from hydrotele.core.compiled import compiled
from hydrotele.core.device import rebuild_function
from hydrotele.envs.episode import NEXT_STEP, SAME_STEP
from hydrotele.envs.episode_step import (
    clip_observation,
    compute_servo_commands,
    convert_action_to_commands,
    draw_variant,
    initialise_references,
    sample_sensors,
    shape_reward,
)
from hydrotele.envs.observation import write_machine_observation
from hydrotele.envs.reach_feller import (
    compute_reach_potential,
    compute_reach_reward,
    draw_reach_goal,
    write_reach_observation,
)
from hydrotele.envs.straight_line import (
    compute_line_potential,
    compute_line_reward,
    draw_line_goal,
    write_line_observation,
)
from hydrotele.envs.track_trajectory import (
    compute_track_potential,
    compute_track_reward,
    draw_track_references,
    write_track_observation,
)
from hydrotele.multibody.reduced_dynamics import ORIGIN, ROTATION


class EpisodeArrays(NamedTuple):
    """Arrays of m episodes on the reduced model, with a actions, o observations, c sensors and v variants.

    Attributes:
        parameters: (1,) record of TASK_PARAMETERS.
        episodes: (m,) records of EPISODE_STATE.
        action: (m, a) float32 actions.
        observation: (m, o) float32.
        final_observation: (m, o) float32 observations before an autoreset in the same step.
        low: (o,) float32 lower bounds of the observation.
        high: (o,) float32 upper bounds.
        reward: (m,) rewards of the last step.
        terminated: (m,) uint8, whether the last step ended the episode.
        truncated: (m,) uint8, whether the last step was the last one of the episode's duration.
        measures: (m, MAX_MEASURES) task measures of the step.
        final_measures: (m, MAX_MEASURES) the same before an autoreset in the same step.
        tip_frame: index of the link of the tip in `ReducedMotion.frame`.
        tip: (v, 3) position of the tip in the frame of its link [m].
        start_tip: (v, 3) position of the tip at the start [m].
        start_reading: (v, c) true values of the sensors at the start.
        scale: (v, MAX_CHANNELS) scale factors of the sensors [1].
        offset: (v, MAX_CHANNELS) offsets of the sensors.
        table: (nu, TABLE_POINTS, 3) of `servo.tabulate_drive_geometry`.
        start_command: (v, nu) commands that hold the machine at the start [1] or [V].
        shape: (v or 1, ...) parameters of the variants, see `batch.PARAMETERS`; one row if they are equal.
        joint: likewise.
        gravity: likewise.
        user: likewise.
        gain: likewise.
        delay: likewise.
        transmission: likewise.
    """

    parameters: np.ndarray
    episodes: np.ndarray
    action: np.ndarray
    observation: np.ndarray
    final_observation: np.ndarray
    low: np.ndarray
    high: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    measures: np.ndarray
    final_measures: np.ndarray
    tip_frame: int
    tip: np.ndarray
    start_tip: np.ndarray
    start_reading: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    table: np.ndarray
    start_command: np.ndarray
    shape: np.ndarray
    joint: np.ndarray
    gravity: np.ndarray
    user: np.ndarray
    gain: np.ndarray
    delay: np.ndarray
    transmission: np.ndarray


class StepMeasures(NamedTuple):
    """What a reward function writes; it has the name of the field of `task_interface.SimulationView`.

    Attributes:
        measures: (MAX_MEASURES,) task measures of the step.
    """

    measures: np.ndarray


@compiled
def draw_goal(f, e):
    """Draw the goal of an episode; replaced by the function of the task."""


@compiled
def write_task_observation(f, e, out, at):
    """Write the observation of the task; replaced by the function of the task."""


@compiled
def compute_reward(f, e, w):
    """Return (reward, whether the episode ends); replaced by the function of the task."""
    return 0.0, False


@compiled
def compute_potential(f, e):
    """Return the potential of the current state; replaced by the function of the task."""
    return 0.0


class TaskFunctions(NamedTuple):
    """Functions of a task that replace those of this module with the same names."""

    draw_goal: Any
    write_task_observation: Any
    compute_reward: Any
    compute_potential: Any


TASK_FUNCTIONS = {
    "track": TaskFunctions(
        draw_track_references, write_track_observation, compute_track_reward, compute_track_potential
    ),
    "line": TaskFunctions(draw_line_goal, write_line_observation, compute_line_reward, compute_line_potential),
    "reach": TaskFunctions(draw_reach_goal, write_reach_observation, compute_reach_reward, compute_reach_potential),
}
"""Kind of task -> its functions; the other kinds need contact."""


@compiled
def begin_episode(task, i, reading):
    """Draw variant and goal of a new episode, and take the first readings of its sensors.

    Args:
        task: EpisodeArrays.
        i: index of the episode.
        reading: (c,) written: the first readings.
    """
    f, e = task.parameters[0], task.episodes[i]
    draw_variant(f, e)
    for c in range(3):
        e.tip[c] = task.start_tip[e.variant, c]
    for c in range(len(reading)):
        reading[c] = task.start_reading[e.variant, c]
    for k in range(f.axes):
        e.position[k], e.command[k] = reading[k], task.start_command[e.variant, k]
    sample_sensors(f, e, reading, task.scale[e.variant], task.offset[e.variant])
    initialise_references(f, e)
    for c in range(task.measures.shape[1]):
        task.measures[i, c] = 0.0
    draw_goal(f, e)
    e.potential = compute_potential(f, e) if f.shaping > 0.0 else 0.0


@compiled
def write_observation(task, i, out):
    """Write the observation of episode i, clipped to its bounds, to `out` (o,)."""
    f, e = task.parameters[0], task.episodes[i]
    at = write_machine_observation(f, e, out)
    write_task_observation(f, e, out, at)
    clip_observation(e, out, task.low, task.high)


@compiled
def begin_chosen_episode(task, model, machines, random, chosen, n):
    """Begin episode `chosen[n]` with its machine, and write its observation.

    Args:
        task: EpisodeArrays.
        model: Model whose parameters have one row, or one per machine.
        machines: Machines.
        random: (k,) new states of the episodes' random generators, or (0,) to continue the present ones.
        chosen: (k,) indices of the episodes.
        n: from 0 to k - 1.
    """
    i, e = chosen[n], task.episodes[chosen[n]]
    if len(random) > 0:
        e.random = random[n]
    begin_episode(task, i, machines.reading[i])
    for k in range(machines.state.shape[1]):
        machines.state[i, k] = machines.start[e.variant, k]
    restart_history(machines, i, e.variant)
    shape, joint, gravity = model.mech.shape, model.mech.joint, model.mech.gravity
    user, gain, delay, transmission = model.user, model.gain, model.delay, model.transmission
    copy_variant(
        task, machines, i, shape[i if len(shape) > 1 else 0], joint[i if len(joint) > 1 else 0],
        gravity[i if len(gravity) > 1 else 0], user[i if len(user) > 1 else 0], gain[i if len(gain) > 1 else 0],
        delay[i if len(delay) > 1 else 0], transmission[i if len(transmission) > 1 else 0],
    )  # fmt: skip
    task.reward[i], task.terminated[i], task.truncated[i] = 0.0, 0, 0
    write_observation(task, i, task.observation[i])


@compiled
def begin_episodes(task, model, machines, random, chosen):
    """Call `begin_chosen_episode` for all chosen episodes."""
    for n in range(len(chosen)):
        begin_chosen_episode(task, model, machines, random, chosen, n)


@compiled
def copy_variant(task, machines, i, shape, joint, gravity, user, gain, delay, transmission):
    """Copy the parameters of the variant of episode i to its machine, and the commands that hold it at the start.

    The arrays after `i` are the parameters of the machine, see `batch.PARAMETERS`.
    """
    variant = task.episodes[i].variant
    copy_variant_matrix(task.shape, variant, shape)
    copy_variant_matrix(task.joint, variant, joint)
    copy_variant_values(task.gravity, variant, gravity)
    copy_variant_values(task.user, variant, user)
    copy_variant_values(task.gain, variant, gain)
    copy_variant_values(task.delay, variant, delay)
    copy_variant_matrix(task.transmission, variant, transmission)
    for k in range(machines.command.shape[1]):
        machines.command[i, k] = task.start_command[variant, k]
        for row in range(machines.history.shape[1]):
            machines.history[i, row, k] = task.start_command[variant, k]


@compiled
def copy_variant_values(table, variant, out):
    """Copy the numbers (k,) of a variant to a machine; nothing is done if all variants have equal ones."""
    if len(table) > 1:
        for k in range(len(out)):
            out[k] = table[variant, k]


@compiled
def copy_variant_matrix(table, variant, out):
    """Copy the matrix of a variant to a machine, see `copy_variant_values`."""
    for r in range(len(out)):
        copy_variant_values(table[:, r], variant, out[r])


@compiled
def restart_episode(task, model, sp, z, machines, i):
    """Begin a new episode with its machine, in the step of the batch; see `machine_step.after_period`."""
    begin_episode(task, i, machines.reading[i])
    restart_machine(model, sp, z, machines, i, task.episodes[i].variant)
    copy_variant(
        task, machines, i, model.mech.shape, model.mech.joint, model.mech.gravity, model.user, model.gain, model.delay,
        model.transmission,
    )  # fmt: skip


@compiled
def command_machine(task, model, sp, z, machines, i):
    """Convert the action of episode i into the commands of a control period; see `machine_step.before_period`."""
    f, e = task.parameters[0], task.episodes[i]
    if e.over != 0 or machines.failed[i] != 0:
        return
    convert_action_to_commands(f, e, task.action[i], task.table)
    compute_servo_commands(f, e)
    for k in range(machines.command.shape[1]):
        machines.command[i, k] = e.command[k]


@compiled
def measure_tip(task, e, frame):
    """Write the true position of the tip [m] to the record `e` of EPISODE_STATE, from the frames of the links."""
    link = task.tip_frame
    for r in range(3):
        place = frame[link, ORIGIN + r]
        for c in range(3):
            place += frame[link, ROTATION + 3 * r + c] * task.tip[e.variant, c]
        e.tip[r] = place


@compiled
def finish_step(task, e, i, failed):
    """Compute reward and end of an environment step of episode i; `failed` is whether its state is not finite."""
    f = task.parameters[0]
    e.step += 1
    if failed:
        e.fault = 1
        e.faults += 1
        reward, done = shape_reward(f, e, 0.0, 0.0), True
    else:
        reward, done = compute_reward(f, e, StepMeasures(task.measures[i]))
        potential = compute_potential(f, e) if f.shaping > 0.0 and not done else 0.0
        reward = shape_reward(f, e, reward, potential)
    late = e.step >= f.horizon and not done
    task.reward[i], task.terminated[i], task.truncated[i] = reward, 1 if done else 0, 1 if late else 0
    e.over = 1 if done or late else 0


@compiled
def finish_period(task, model, sp, z, machines, i):
    """Take readings after a control period of episode i, and finish the environment step after its last period.

    An episode that ended is restarted as the autoreset mode says. See `machine_step.after_period`.
    """
    f, e = task.parameters[0], task.episodes[i]
    last, was_over = machines.period_count[i] % f.ticks == 0, e.over != 0
    if not was_over:
        e.tick += 1
        for k in range(f.axes):
            e.position[k] = machines.reading[i, k]
        if e.tick % f.every == 0 and machines.failed[i] == 0:
            sample_sensors(f, e, machines.reading[i], task.scale[e.variant], task.offset[e.variant])
    if not last:
        return
    if was_over:
        task.reward[i], task.terminated[i], task.truncated[i] = 0.0, 0, 0
        if f.autoreset != NEXT_STEP:
            return
        restart_episode(task, model, sp, z, machines, i)
    else:
        measure_tip(task, e, sp.motion.frame)
        finish_step(task, e, i, machines.failed[i] != 0)
        if f.autoreset == SAME_STEP and e.over != 0:
            for c in range(task.measures.shape[1]):
                task.final_measures[i, c] = task.measures[i, c]
            write_observation(task, i, task.final_observation[i])
            restart_episode(task, model, sp, z, machines, i)
    write_observation(task, i, task.observation[i])


class StepFunctions(NamedTuple):
    """Compiled functions of a kind of task.

    Attributes:
        before: `command_machine`.
        after: `finish_period`.
        begin: `begin_episodes`.
        begin_one: `begin_chosen_episode`.
    """

    before: Any
    after: Any
    begin: Any
    begin_one: Any


def make_step_functions(kind: str) -> StepFunctions:
    """Return the step functions for a kind of task in TASK_FUNCTIONS."""
    own = TASK_FUNCTIONS[kind]
    swapped = {globals()[name]: function for name, function in own._asdict().items()}

    def wrap(function: Any) -> Any:
        function.__qualname__ += f"_{kind}"
        return compiled(function)

    functions = command_machine, finish_period, begin_episodes, begin_chosen_episode
    return StepFunctions(*(rebuild_function(function, wrap, swapped, copy_all=False) for function in functions))
