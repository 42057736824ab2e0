"""Environment step in native code: actions, control, sensors, reward and reset.

MuJoCo calls `step_or_reset_simulation` for every simulation from its own threads, without the Python interpreter.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import mujoco
import numpy as np
from numba import carray, types

from hydrotele.control.servo import TABLE_POINTS, interpolate_drive_reference
from hydrotele.core.compiled import callback, compiled
from hydrotele.core.memory import address_to_pointer, copy_values, float64_view
from hydrotele.envs.episode import (
    DISABLED,
    MAX_AXES,
    MAX_CHANNELS,
    MAX_MEASURES,
    NEXT_STEP,
    RESET,
    SAME_STEP,
)
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
from hydrotele.envs.task_interface import (
    BEGIN,
    OBSERVE,
    POTENTIAL,
    REWARD,
    TICK,
    call_task_part,
    episode_states_view,
    simulation_view,
    task_parameters_view,
)
from hydrotele.hydraulics.actuator_layout import SLOT_COUNT
from hydrotele.simulate.batch import STATE_KIND
from hydrotele.simulate.mujoco_c_api import call_mj_set_state
from hydrotele.simulate.stepping import (
    CommandDelayLine,
    SensorHistory,
    Simulation,
    apply_sensor_delays,
    initialise_history,
    step_physics,
    true_sensor_values,
)


@compiled
def update_sensors(f, e, sim):
    """Sample the sensors if a sample is due, and hold the last sample otherwise.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; true positions are always written; measured values, their random
            errors and `sampled_reference` if a sample is due.
        sim: Simulation of this episode.

    Returns:
        Nothing.

    Source: `simulate.sensor_models`, as in scenario runs.
    """
    k, c = f.axes, f.axes + 2 * f.hydraulic + (f.supplies if f.hydraulic > 0 else 0)
    if e.tick % f.every != 0:
        for i in range(k):
            e.position[i] = sim.qpos[f.qpos[i]] - f.timestep * sim.qvel[f.dof[i]]
        return
    values = np.empty(c)
    true_sensor_values(sim, values)
    for i in range(k):
        e.position[i] = values[i]
    apply_sensor_delays(sim.sensor_history, e.tick * f.substeps, values)
    scale = float64_view(f.scales + 8 * e.variant * MAX_CHANNELS, c)
    sample_sensors(f, e, values, scale, float64_view(f.offsets + 8 * e.variant * MAX_CHANNELS, c))


_WARNING_COUNT = int(mujoco.mjtWarning.mjNWARNING)
_FIRST_BAD_STATE, _LAST_BAD_STATE = (
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
)
_SIGNATURE = types.void(types.int64, types.int64, types.intc, types.int64)


@compiled
def _make_simulation_record(f, e, w):
    """Collect the arrays of an episode's simulation, with its delay lines, in a record for `simulate.stepping`."""
    ring = float64_view(f.commands + 8 * w.index * f.delayed_command * MAX_AXES, f.delayed_command * MAX_AXES).reshape(
        (f.delayed_command, MAX_AXES)
    )
    delays = float64_view(f.delays + 8 * e.variant * MAX_AXES * 2, MAX_AXES * 2).reshape((MAX_AXES, 2))
    c = f.axes + 2 * f.hydraulic + (f.supplies if f.hydraulic > 0 else 0)
    sensed = float64_view(
        f.sensed + 8 * w.index * f.delayed_sensor * MAX_CHANNELS,
        f.delayed_sensor * MAX_CHANNELS,
    ).reshape((f.delayed_sensor, MAX_CHANNELS))
    lags = float64_view(f.lags + 8 * e.variant * MAX_CHANNELS * 2, MAX_CHANNELS * 2).reshape((MAX_CHANNELS, 2))
    past = SensorHistory(
        sensed, float64_view(f.sensed_before + 8 * w.index * MAX_CHANNELS, c), lags,
        float64_view(f.ratios + 8 * e.variant * MAX_CHANNELS, MAX_CHANNELS),
    )  # fmt: skip
    none = f.qpos[:0]
    user = float64_view(f.users + 8 * e.variant * f.axes * SLOT_COUNT, f.axes * SLOT_COUNT)
    return Simulation(
        f.mj_step, w.model, w.data, w.qpos, w.qvel, w.act, w.ctrl, f.timestep, f.axes, f.hydraulic,
        f.qpos[: f.axes], f.dof[: f.axes], none, none, user, CommandDelayLine(ring, delays), past,
    )  # fmt: skip


@compiled
def _add_drive_work(f, e, sim):
    """Add the positive work of the hydraulic drives in one control period to the episode, by the rectangle rule."""
    k, none = f.hydraulic, np.empty(f.hydraulic)
    velocity, rate, arm = np.empty(k), np.empty(k), np.empty(k)
    table = float64_view(f.table, k * TABLE_POINTS * 3).reshape((k, TABLE_POINTS, 3))
    for i in range(k):
        rate[i] = sim.qvel[f.dof[i]]
    interpolate_drive_reference(f.grid[:k], table, e.position[:k], rate, 1.0, velocity, arm, none, none)
    for i in range(k):
        force = f.servo[i, 1] * sim.act[4 * i + 2] - f.servo[i, 2] * sim.act[4 * i + 3]
        e.work += max(0.0, force * velocity[i]) * f.period


@compiled
def _check_stability(f, e, d):
    """Count and clear the warnings of MuJoCo in mjData at the address `d`.

    Returns:
        Whether a position, velocity or acceleration was NaN, infinite or too large.
    """
    warnings = carray(address_to_pointer(d + f.at_warning), (_WARNING_COUNT, 2), np.int32)  # (information, number)
    bad = False
    for kind in range(_WARNING_COUNT):
        if warnings[kind, 1] > 0:
            e.warnings += warnings[kind, 1]
            bad = bad or _FIRST_BAD_STATE <= kind <= _LAST_BAD_STATE
            warnings[kind, 1] = 0
    return bad


@compiled
def _compute_potential(f, w):
    """Return the potential of the current state, 0 without shaping."""
    return call_task_part(f, w, POTENTIAL, 0) if f.shaping > 0.0 else 0.0


@compiled
def _begin_episode(f, e, w):
    """Draw a variant, set the simulation to its start state, and let the task draw a new goal.

    Model parameters, sensors, references and counters of the episode are initialised.
    """
    draw_variant(f, e)
    start = f.starts + 8 * e.variant * f.states
    call_mj_set_state(f.mj_set_state, w.model, w.data, start, STATE_KIND)
    places = carray(address_to_pointer(f.places), (3 * f.fields,), np.int64)
    for n in range(f.fields):
        size = places[3 * n + 2]
        given = float64_view(places[3 * n] + 8 * e.variant * size, size)
        taken = float64_view(places[3 * n + 1] + 8 * w.index * size, size)
        for c in range(size):
            taken[c] = given[c]
    for i in range(f.axes):
        e.command[i] = w.ctrl[i]
    sim = _make_simulation_record(f, e, w)
    initialise_history(sim, w.ctrl)
    tips = float64_view(f.start_tips + 24 * e.variant, 3)
    copy_values(e.tip, tips)
    update_sensors(f, e, sim)
    initialise_references(f, e)
    w.measures[:] = 0.0
    call_task_part(f, w, BEGIN, 0)
    e.potential = _compute_potential(f, w)


@compiled
def _write_observation(f, e, w, address):
    """Write the observation of a simulation, clipped to its bounds, to its row of the array at `address`.

    Values outside the bounds are counted in `saturated`; a value that is not finite becomes the
    lower bound.
    """
    n = f.observations
    out = carray(address_to_pointer(address + 4 * w.index * n), (n,), np.float32)
    at = write_machine_observation(f, e, out)
    call_task_part(f, w, OBSERVE, address + 4 * (w.index * n + at))
    clip_observation(e, out, carray(address_to_pointer(f.low), (n,), np.float32),
                     carray(address_to_pointer(f.high), (n,), np.float32))  # fmt: skip


@compiled
def _run_environment_step(f, e, w, action):
    """Run one environment step with an action and return the reward, `terminated` and `truncated`.

    An unstable simulation gives the reward 0 and terminates. `truncated` is true after the last
    step of the episode's duration.
    """
    sim = _make_simulation_record(f, e, w)
    table = float64_view(f.table, f.axes * TABLE_POINTS * 3).reshape((f.axes, TABLE_POINTS, 3))
    for _ in range(f.ticks):
        convert_action_to_commands(f, e, action, table)
        compute_servo_commands(f, e)
        step_physics(sim, e.tick, f.substeps, e.command[: f.axes])
        e.tick += 1
        update_sensors(f, e, sim)
        _add_drive_work(f, e, sim)
        call_task_part(f, w, TICK, 0)  # after the physics: before it, body positions belong to another simulation
    copy_values(e.tip, w.tip)
    e.step += 1
    if _check_stability(f, e, w.data):
        e.fault = 1
        e.faults += 1
        return shape_reward(f, e, 0.0, 0.0), True, False
    reward = call_task_part(f, w, REWARD, 0)
    done = e.over != 0
    reward = shape_reward(f, e, reward, 0.0 if done else _compute_potential(f, w))
    return reward, done, e.step >= f.horizon and not done


@compiled
def _step_or_reset_simulation(m, d, sim, argument):
    f = task_parameters_view(argument)[0]
    e, w = episode_states_view(f)[sim], simulation_view(f, m, d, sim, argument)
    reward = carray(address_to_pointer(f.reward), (f.count,), np.float64)
    terminated = carray(address_to_pointer(f.terminated), (f.count,), np.uint8)
    truncated = carray(address_to_pointer(f.truncated), (f.count,), np.uint8)
    reward[sim], terminated[sim], truncated[sim] = 0.0, 0, 0
    fresh = f.call == RESET or (f.autoreset == NEXT_STEP and e.over != 0)
    if fresh:
        _begin_episode(f, e, w)
        _write_observation(f, e, w, f.observation)
        return
    if f.autoreset == DISABLED and e.over != 0:
        return
    action = carray(address_to_pointer(f.action + 4 * sim * f.actions), (f.actions,), np.float32)
    value, done, late = _run_environment_step(f, e, w, action)
    reward[sim], terminated[sim], truncated[sim] = value, done, late
    e.over = 1 if done or late else 0
    if f.autoreset == SAME_STEP and e.over != 0:
        copy_values(float64_view(f.final_measures + 8 * sim * MAX_MEASURES, MAX_MEASURES), w.measures)
        _write_observation(f, e, w, f.final)
        _begin_episode(f, e, w)
    _write_observation(f, e, w, f.observation)


@callback(_SIGNATURE)
def step_or_reset_simulation(m, d, sim, argument):
    """Step or reset one simulation, and write observation, reward, `terminated` and `truncated`.

    The arguments are the addresses of mjModel and mjData, the index of the simulation and the address of
    TASK_PARAMETERS. Its `call` selects step or reset. In a step, its `autoreset` says whether an
    episode that is over starts again.
    """
    _step_or_reset_simulation(m, d, sim, argument)
