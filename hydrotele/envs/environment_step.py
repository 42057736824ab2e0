"""Environment step in native code: actions, control, sensors, reward and reset.

MuJoCo calls `step_or_reset_simulation` for every simulation from its own threads, without the Python interpreter.
Joint-rate actions move the joint references; pose-rate actions move them by resolved motion. The
joint servo tracks the references. The acceleration of the references is limited, since a machine of
20 t cannot follow a step.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import mujoco
import numpy as np
from numba import carray, types

from hydrotele.control.control_loop import Controller, TickReference, control_tick
from hydrotele.control.rate_references import ArmLimits, advance_joint_reference, advance_pose_reference
from hydrotele.control.servo import (
    TABLE_POINTS,
    ComputedForce,
    DriveReference,
    MeasuredState,
    interpolate_drive_reference,
)
from hydrotele.core.compiled import callback, compiled
from hydrotele.core.memory import address_to_pointer, copy_values, float64_view
from hydrotele.envs.episode import (
    DISABLED,
    JOINT_RATE,
    MAX_ARM_AXES,
    MAX_AXES,
    MAX_CHANNELS,
    MAX_MEASURES,
    NEXT_STEP,
    RESET,
    RESOLVED_MOTION,
    SAME_STEP,
    VALVE,
    arm_values,
    draw_uniform,
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
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.simulate.batch import STATE_KIND
from hydrotele.simulate.mujoco_c_api import call_mj_set_state
from hydrotele.simulate.sensor_models import Readings, SensorParameters, convert_to_readings, store_readings
from hydrotele.simulate.stepping import (
    CommandDelayLine,
    SensorHistory,
    Simulation,
    apply_sensor_delays,
    initialise_history,
    true_sensor_values,
)


@compiled
def _clip_action(f, action, a):
    """Return element `a` of the action clipped to +-1, or 0 if the task locks this action."""
    return 0.0 if a == f.locked else min(1.0, max(-1.0, action[a]))


@compiled
def _integrate_joint_rates(f, e, action, first):
    """Integrate rate actions, from index `first` on, over one control period to the joint references of the servo."""
    for a in range(first, f.actions):
        i = f.driven_axis[a]
        goal = _clip_action(f, action, a) * f.fastest[i]
        e.reference[i], e.reference_rate[i] = advance_joint_reference(
            e.reference[i], e.reference_rate[i], goal, e.joint[i], f.ranges[i], f.acceleration, f.period
        )


@compiled
def _integrate_pose_rates(f, e, action):
    """Integrate tip rate actions over one control period, and convert the tip pose to joint references."""
    k, goal = f.arm_axes, np.zeros(MAX_ARM_AXES)
    for c in range(k):
        goal[c] = _clip_action(f, action, c) * f.fastest_pose[c]
    ranges = np.empty((k, 2))
    q, rates, joint = arm_values(f, e.reference), arm_values(f, e.reference_rate), arm_values(f, e.joint)
    for a in range(k):
        ranges[a, 0], ranges[a, 1] = f.ranges[f.driven_axis[a], 0], f.ranges[f.driven_axis[a], 1]
    arm = ArmLimits(f.arm, ranges, f.accelerations)
    e.blocked = 1 if advance_pose_reference(arm, goal, f.period, joint, e.pose, e.pose_rate, q, rates) else 0
    for a in range(k):
        e.reference[f.driven_axis[a]], e.reference_rate[f.driven_axis[a]] = q[a], rates[a]


@compiled
def convert_action_to_commands(f, e, action):
    """Convert the action into valve commands, or into references of the joint servo, for one control period.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `command` is written for valve actions. For all others, joint
            and pose references and `drive`, the references of the drives, are written.
        action: (actions,) of the agent; values outside +-1 are clipped.

    Returns:
        Nothing.

    Source: `control.resolved_motion`, `control.servo`.
    """
    if f.mode == VALVE:
        for a in range(f.actions):
            i = f.driven_axis[a]
            e.command[i] = _clip_action(f, action, a) * f.limit[i]
        return
    if f.mode == RESOLVED_MOTION:
        _integrate_pose_rates(f, e, action)
        _integrate_joint_rates(f, e, action, f.arm_axes)
    elif f.mode == JOINT_RATE:
        _integrate_joint_rates(f, e, action, 0)
    k = f.axes
    table = float64_view(f.table, k * TABLE_POINTS * 3).reshape((k, TABLE_POINTS, 3))
    interpolate_drive_reference(
        f.grid[:k], table, e.reference[:k], e.reference_rate[:k], f.feedforward, e.drive[0, :k],
        e.drive[1, :k], e.drive[2, :k], e.drive[3, :k],
    )  # fmt: skip


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
    values, scales = np.empty(c), f.scales + 8 * e.variant * MAX_CHANNELS
    true_sensor_values(sim, values)
    for i in range(k):
        e.position[i] = values[i]
        e.sampled_reference[i] = e.reference[i]
    apply_sensor_delays(sim.sensor_history, e.tick * f.substeps, values)
    for i in range(c):
        e.error[i] = f.accuracy[i] * (2.0 * draw_uniform(e) - 1.0) if f.noisy else 0.0
    sensors = SensorParameters(
        float64_view(scales, c), float64_view(f.offsets + 8 * e.variant * MAX_CHANNELS, c), f.converters[0],
        f.converters[1], f.converters[2],
    )  # fmt: skip
    convert_to_readings(sensors, values, e.error[:c])
    span = f.every * f.period if e.tick > 0 else 0.0
    readings = Readings(e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply[: f.supplies])
    store_readings(values, f.hydraulic, span, readings)


assert MAX_CHANNELS >= 4 * MAX_AXES


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
def _run_control_period(f, e, sim):
    """Run the joint servo once and then the physics steps of one control period."""
    k, none = f.axes, np.zeros(f.axes)
    controller = Controller(f.servo[:k], f.closed[:k], e.load[:k], e.command[:k])
    drive = DriveReference(e.drive[0, :k], e.drive[1, :k], e.drive[2, :k], e.drive[3, :k])
    reference = TickReference(
        e.sampled_reference[:k], drive, ComputedForce(False, none, none), False
    )  # fmt: skip
    measured = MeasuredState(e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply[: f.supplies])
    control_tick(sim, e.tick, f.substeps, controller, reference, measured)


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
def _shape_reward(f, e, reward, potential):
    """Add the potential-based shaping F = gamma Phi(s') - Phi(s) to the reward of a step from s to s'; store Phi(s').

    Source: Ng, Harada, Russell 1999, Policy invariance under reward transformations, theorem 1. Phi
    is 0 in a terminal state.
    """
    reward += f.shaping * potential - e.potential
    e.potential = potential
    return reward


@compiled
def _begin_episode(f, e, w):
    """Draw a variant, set the simulation to its start state, and let the task draw a new goal.

    Model parameters, sensors, references and counters of the episode are initialised.
    """
    e.last_variant, e.last_fault = e.variant, e.fault
    e.variant = int(draw_uniform(e) * f.variants)
    start = f.starts + 8 * e.variant * f.states
    call_mj_set_state(f.mj_set_state, w.model, w.data, start, STATE_KIND)
    places = carray(address_to_pointer(f.places), (3 * f.fields,), np.int64)
    for n in range(f.fields):
        size = places[3 * n + 2]
        given = float64_view(places[3 * n] + 8 * e.variant * size, size)
        taken = float64_view(places[3 * n + 1] + 8 * w.index * size, size)
        for c in range(size):
            taken[c] = given[c]
    e.episode += 1
    e.step, e.tick, e.over, e.fault, e.blocked = 0, 0, 0, 0, 0
    e.command[:] = 0.0
    e.work = 0.0
    for i in range(f.axes):
        e.command[i] = w.ctrl[i]
    sim = _make_simulation_record(f, e, w)
    initialise_history(sim, w.ctrl)
    tips = float64_view(f.start_tips + 24 * e.variant, 3)
    copy_values(e.tip, tips)
    e.reference_rate[:], e.pose_rate[:] = 0.0, 0.0
    update_sensors(f, e, sim)
    for i in range(len(e.joint)):
        e.reference[i] = e.sampled_reference[i] = e.joint[i]
    if f.arm_axes > 0:
        compute_tip_pose(f.arm, arm_values(f, e.reference), e.pose)
    for i in range(f.hydraulic):
        e.load[i] = f.servo[i, 1] * e.head[i] - f.servo[i, 2] * e.rod[i]
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
    low = carray(address_to_pointer(f.low), (n,), np.float32)
    high = carray(address_to_pointer(f.high), (n,), np.float32)
    at = write_machine_observation(f, e, out)
    call_task_part(f, w, OBSERVE, address + 4 * (w.index * n + at))
    for c in range(n):
        if not low[c] <= out[c] <= high[c]:
            e.saturated += 1
            out[c] = min(high[c], max(low[c], out[c])) if np.isfinite(out[c]) else low[c]


@compiled
def _run_environment_step(f, e, w, action):
    """Run one environment step with an action and return the reward, `terminated` and `truncated`.

    An unstable simulation gives the reward 0 and terminates. `truncated` is true after the last
    step of the episode's duration.
    """
    sim = _make_simulation_record(f, e, w)
    for _ in range(f.ticks):
        convert_action_to_commands(f, e, action)
        _run_control_period(f, e, sim)
        e.tick += 1
        update_sensors(f, e, sim)
        _add_drive_work(f, e, sim)
        call_task_part(f, w, TICK, 0)  # after the physics: before it, body positions belong to another simulation
    copy_values(e.tip, w.tip)
    e.step += 1
    if _check_stability(f, e, w.data):
        e.fault = 1
        e.faults += 1
        return _shape_reward(f, e, 0.0, 0.0), True, False
    reward = call_task_part(f, w, REWARD, 0)
    done = e.over != 0
    reward = _shape_reward(f, e, reward, 0.0 if done else _compute_potential(f, w))
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
