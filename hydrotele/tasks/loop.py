"""An environment step in native code: actions, control, physics, sensors, reward, a new episode.

MuJoCo calls `advance` for every simulation from its own threads; nothing of Python runs in it.

Actions of an agent into commands of valves and drives, once per control period.

Rates are bounded in their change, since a machine of 20 t follows no jump: joint rates move joint
references, pose rates those of the arm by resolved motion, and the joint servo follows them.

Sensors of an episode: true values at one time, late, with defects and errors, converted.

The simulation of an episode as its task sees it: MuJoCo's arrays by name.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

from typing import NamedTuple

import mujoco
import numpy as np
from numba import carray, types

from hydrotele.control.resolved_motion import follow_pose
from hydrotele.control.servo import (
    POINTS,
    ComputedForce,
    DriveReference,
    Measured,
    drive_row,
    servo_step,
)
from hydrotele.core.compiled import callback, compiled
from hydrotele.hydraulics.circuit import SCRATCH
from hydrotele.hydraulics.parameters import SLOTS
from hydrotele.kinematics.task import task_forward
from hydrotele.simulate.feedback import convert
from hydrotele.simulate.fleet import STATE
from hydrotele.simulate.layout import call_set_state, call_step, field, floats, pointer
from hydrotele.simulate.record import state_supply
from hydrotele.tasks.kinds import begin_task, observe_task, reward_task, tick_task
from hydrotele.tasks.memory import (
    ARM,
    AXES,
    CHANNELS,
    DISABLED,
    FACTS,
    JOINT_RATE,
    MEASURES,
    MEMORY,
    NEXT_STEP,
    RESET,
    RESOLVED_MOTION,
    SAME_STEP,
    VALVE,
)
from hydrotele.tasks.rng import draw

_AHEAD = 0.2  # rad or m by which a reference may lead its joint: a stalled arm winds nothing up


@compiled
def _asked(f, action, a):
    """An action as it counts."""
    return 0.0 if a == f.locked else min(1.0, max(-1.0, action[a]))


@compiled
def _towards(now, goal, change):
    return min(now + change, max(now - change, goal))


@compiled
def _joint_rates(f, e, action, first):
    """Move the references of axes by their own rates; actions from `first` on."""
    for a in range(first, f.actions):
        i = f.driven_axis[a]
        goal = _asked(f, action, a) * f.fastest[i]
        rate = _towards(e.reference_rate[i], goal, f.acceleration * f.period)
        place = e.reference[i] + f.period * rate
        low = max(f.ranges[i, 0], e.joint[i] - _AHEAD)
        high = min(f.ranges[i, 1], e.joint[i] + _AHEAD)
        if place < low or place > high:
            place, rate = min(high, max(low, e.reference[i])), 0.0
        e.reference[i], e.reference_rate[i] = place, rate


@compiled
def _pose_rates(f, e, action):
    """Move the references of the arm by rates of its pose."""
    k, wanted = f.arm_axes, np.empty(ARM)
    for c in range(ARM):
        goal = 0.0
        if c < k:
            goal = _asked(f, action, c) * f.fastest_pose[c]
        e.pose_rate[c] = _towards(e.pose_rate[c], goal, f.accelerations[c] * f.period)
        wanted[c] = e.pose[c] + f.period * e.pose_rate[c]
    far = False
    for i in range(k):
        far = far or abs(e.reference[i] - e.joint[i]) > _AHEAD
    held = far or follow_pose(
        f.arm, f.ranges[:k], wanted, e.pose_rate, False, e.pose, e.reference[:k],
        e.reference_rate[:k],
    )  # fmt: skip
    e.blocked = 1 if held else 0
    if held:
        e.pose_rate[:] = 0.0
        e.reference_rate[:k] = 0.0
    if far:  # the arm is stopped by something: go on from where it stands
        for i in range(k):
            e.reference[i] = _towards(e.joint[i], e.reference[i], _AHEAD)
        task_forward(f.arm, e.reference[:k], e.pose)


@compiled
def act(f, e, action):
    """Commands of this control period.

    Args:
        f: record of FACTS.
        e: record of MEMORY; `command` and, unless actions are valves, references are written.
        action: (actions,) of the agent, full at +-1; beyond they count as full.

    Returns:
        Nothing.

    Source: `control.resolved_motion`, `control.servo`.
    """
    if f.mode == VALVE:
        for a in range(f.actions):
            i = f.driven_axis[a]
            e.command[i] = _asked(f, action, a) * f.limit[i]
        return
    if f.mode == RESOLVED_MOTION:
        _pose_rates(f, e, action)
        _joint_rates(f, e, action, f.arm_axes)
    elif f.mode == JOINT_RATE:
        _joint_rates(f, e, action, 0)
    k = f.axes
    table = floats(f.table, k * POINTS * 3).reshape((k, POINTS, 3))
    drive_row(
        f.grid[:k], table, e.reference[:k], e.reference_rate[:k], f.feedforward, e.drive[0, :k],
        e.drive[1, :k], e.drive[2, :k], e.drive[3, :k],
    )  # fmt: skip
    none = np.zeros(k)
    drive = DriveReference(e.drive[0, :k], e.drive[1, :k], e.drive[2, :k], e.drive[3, :k])
    measured = Measured(e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply)
    servo_step(
        f.servo[:k], f.closed[:k], drive, e.sampled_reference[:k], measured, e.load[:k],
        ComputedForce(False, none, none), e.command[:k],
    )  # fmt: skip


@compiled
def true_positions(f, e, w):
    """Bring an episode's true axis positions up to date.

    Args:
        f: record of FACTS.
        e: record of MEMORY; `position` is written.
        w: World, staggered as `simulate.record` says.

    Returns:
        Nothing.

    Source: `simulate.record.aligned_positions`.
    """
    for i in range(f.axes):
        e.position[i] = w.qpos[f.qpos[i]] - f.timestep * w.qvel[f.dof[i]]


@compiled
def _sensed(f, e, w, out):
    """What stands before the sensors: positions [rad], [m], head and rod pressures, supply [Pa]."""
    k = f.axes
    for i in range(k):
        out[i] = e.position[i]
    for i in range(f.hydraulic):
        out[k + 2 * i], out[k + 2 * i + 1] = w.act[4 * i + 2], w.act[4 * i + 3]
    if f.hydraulic > 0:
        scratch = np.empty(SCRATCH)
        user = floats(f.users + 8 * e.variant * k * SLOTS, k * SLOTS)
        out[k + 2 * f.hydraulic] = state_supply(user, f.hydraulic, w.act, scratch)


@compiled
def _late(f, e, sim, values):
    """Put values into the ring of the past; take out those that the sensors see now."""
    length = f.delayed_sensor
    ring = floats(f.sensed + 8 * sim * length * CHANNELS, length * CHANNELS)
    lags = floats(f.lags + 8 * e.variant * CHANNELS, CHANNELS)
    now = e.tick % length
    for c in range(CHANNELS):
        ring[now * CHANNELS + c] = values[c]
    for c in range(CHANNELS):
        lag = min(lags[c], 1.0 * e.tick)
        if lag > 0.0:
            whole = int(lag)
            part = lag - whole
            new = ring[((now - whole) % length) * CHANNELS + c]
            old = ring[((now - whole - 1) % length) * CHANNELS + c] if part > 0.0 else new
            values[c] = new + part * (old - new)


@compiled
def sense(f, e, w, sim):
    """Read the sensors, if a reading is due; otherwise they are held.

    Args:
        f: record of FACTS.
        e: record of MEMORY; readings are written.
        w: World.
        sim: number of the simulation, scalar.

    Returns:
        Nothing.

    Source: as `simulate.feedback` for scenario runs; late readings are linear between control
        periods, and before the start everything stood as at the start.
    """
    true_positions(f, e, w)
    due = e.tick % f.every == 0
    if not due and f.delayed_sensor == 0:
        return
    values = np.zeros(CHANNELS)
    _sensed(f, e, w, values)
    if f.delayed_sensor > 0:
        _late(f, e, sim, values)
    if not due:
        return
    k, many = f.axes, f.axes + 2 * f.hydraulic
    scales = floats(f.scales + 8 * e.variant * CHANNELS, CHANNELS)
    offsets = floats(f.offsets + 8 * e.variant * CHANNELS, CHANNELS)
    for c in range(many + (1 if f.hydraulic > 0 else 0)):
        value = scales[c] * values[c] + offsets[c]
        if f.noisy:
            value += f.accuracy[c] * (2.0 * draw(e) - 1.0)
            value = convert(value, f.converters[0, c], f.converters[1, c], f.converters[2, c])
        values[c] = value
    span = f.every * f.period
    for i in range(k):
        e.rate[i] = (values[i] - e.joint[i]) / span if e.tick > 0 else 0.0
        e.joint[i] = values[i]
        e.sampled_reference[i] = e.reference[i]
    for i in range(f.hydraulic):
        e.head[i], e.rod[i] = values[k + 2 * i], values[k + 2 * i + 1]
    e.supply = values[many] if f.hydraulic > 0 else 0.0


assert CHANNELS >= 3 * AXES + 1


class World(NamedTuple):
    """Live arrays of one simulation.

    Attributes:
        qpos: (nq,) positions; staggered, see `simulate.record`.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (k,) commands that act.
        tip: (3,) place of the arm's tip at the time of the activations [m].
        xfrc: (6 nbody,) forces and torques from outside on bodies, world frame [N], [N m].
        xpos: (3 nbody,) places of bodies [m], of the last physics step.
        xipos: (3 nbody,) places of their centres of mass [m].
        xquat: (4 nbody,) quaternions of the bodies.
        xmat: (9 nbody,) their rotation matrices.
        eq_active: (neq,) uint8, which equalities act; part of the state.
        eq_data: (neq eq_width,) numbers of the equalities for the rest of this call.
        eq_rows: the same from the next call on; empty unless the task writes them.
        terrain: (width,) what the episode keeps of its ground, empty without.
        measures: (MEASURES,) figures of this step, for `info`.
        model: address of mjModel.
        data: address of mjData.
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    ctrl: np.ndarray
    tip: np.ndarray
    xfrc: np.ndarray
    xpos: np.ndarray
    xipos: np.ndarray
    xquat: np.ndarray
    xmat: np.ndarray
    eq_active: np.ndarray
    eq_data: np.ndarray
    eq_rows: np.ndarray
    terrain: np.ndarray
    measures: np.ndarray
    model: int
    data: int


@compiled
def world(f, m, d, sim):
    """The World of a simulation.

    Args:
        f: record of FACTS.
        m: address of its mjModel, scalar.
        d: address of its mjData, scalar.
        sim: its number, scalar.

    Returns:
        The World.

    Source: `simulate.layout`.
    """
    place = carray(pointer(d + f.at_site), (1,), np.int64)[0]
    active = carray(pointer(d + f.at_eq_active), (1,), np.int64)[0]
    numbers = f.neq * f.eq_width
    site = f.tip_site if f.tip_site >= 0 else 0
    return World(
        field(d, f.at_qpos, f.nq),
        field(d, f.at_qvel, f.nv),
        field(d, f.at_act, f.na),
        field(d, f.at_ctrl, f.axes),
        floats(place + 24 * site, 3),
        field(d, f.at_xfrc, 6 * f.nbody),
        field(d, f.at_xpos, 3 * f.nbody),
        field(d, f.at_xipos, 3 * f.nbody),
        field(d, f.at_xquat, 4 * f.nbody),
        field(d, f.at_xmat, 9 * f.nbody),
        carray(pointer(active), (f.neq,), np.uint8),
        field(m, f.at_eq_data, numbers),
        floats(f.eq_rows + 8 * sim * numbers, numbers if f.eq_rows else 0),
        floats(f.terrain + 8 * sim * f.width, f.width),
        floats(f.measures + 8 * sim * MEASURES, MEASURES),
        m,
        d,
    )


_WARNINGS = int(mujoco.mjtWarning.mjNWARNING)
_FIRST_BAD, _LAST_BAD = int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADQACC)
_SIGNATURE = types.void(types.int64, types.int64, types.intc, types.int64)


@compiled
def _delayed(f, e, sim, s, ctrl):
    """Commands that reach valves and drives in physics step `s` of this control period."""
    length = f.delayed_command
    ring = floats(f.commands + 8 * sim * length * AXES, length * AXES)
    delays = floats(f.delays + 8 * e.variant * AXES * 2, AXES * 2)
    now = e.tick * f.substeps + s
    for i in range(f.axes):
        at = now - int(delays[2 * i])
        part = delays[2 * i + 1]
        value = ring[_slot(at, f.substeps, e.tick, length) * AXES + i]
        if part > 0.0:
            before = ring[_slot(at - 1, f.substeps, e.tick, length) * AXES + i]
            value += part * (before - value)
        ctrl[i] = value


@compiled
def _slot(step, substeps, tick, length):
    """Place in the ring of the command that was given for a physics step; -1 is before all."""
    given = step // substeps
    return (min(max(given, -1), tick) + 1) % length


@compiled
def _physics(f, e, m, d, sim, w):
    """Step through one control period."""
    if f.delayed_command == 0:
        for i in range(f.axes):
            w.ctrl[i] = e.command[i]
        for _ in range(f.substeps):
            call_step(f.mj_step, m, d)
        return
    length = f.delayed_command
    ring = floats(f.commands + 8 * sim * length * AXES, length * AXES)
    for i in range(f.axes):
        ring[((e.tick + 1) % length) * AXES + i] = e.command[i]
    for s in range(f.substeps):
        _delayed(f, e, sim, s, w.ctrl)
        call_step(f.mj_step, m, d)


@compiled
def _unstable(f, e, d):
    """Count MuJoCo's warnings; whether it met infinite states or such as are not a number."""
    warnings = carray(pointer(d + f.at_warning), (_WARNINGS, 2), np.int32)  # (information, number)
    bad = False
    for kind in range(_WARNINGS):
        if warnings[kind, 1] > 0:
            e.warnings += warnings[kind, 1]
            bad = bad or _FIRST_BAD <= kind <= _LAST_BAD
            warnings[kind, 1] = 0
    return bad


@compiled
def _begin_episode(f, e, m, d, sim, w):
    """Put the simulation at the start of a variant, and draw a new goal."""
    e.last_variant, e.last_fault = e.variant, e.fault
    e.variant = int(draw(e) * f.variants)
    start = f.starts + 8 * e.variant * f.states
    call_set_state(f.mj_set_state, m, d, start, STATE)
    places = carray(pointer(f.places), (3 * f.fields,), np.int64)
    for n in range(f.fields):
        size = places[3 * n + 2]
        given = floats(places[3 * n] + 8 * e.variant * size, size)
        taken = floats(places[3 * n + 1] + 8 * sim * size, size)
        for c in range(size):
            taken[c] = given[c]
    e.episode += 1
    e.step, e.tick, e.over, e.fault, e.blocked = 0, 0, 0, 0, 0
    e.command[:] = 0.0
    for i in range(f.axes):
        e.command[i] = w.ctrl[i]
    if f.delayed_command > 0:
        length = f.delayed_command
        ring = floats(f.commands + 8 * sim * length * AXES, length * AXES)
        for n in range(length):
            for i in range(f.axes):
                ring[n * AXES + i] = w.ctrl[i]
    tips = floats(f.start_tips + 24 * e.variant, 3)
    e.tip[:] = tips
    e.reference_rate[:], e.pose_rate[:] = 0.0, 0.0
    sense(f, e, w, sim)
    e.reference[:] = e.joint
    e.sampled_reference[:] = e.joint
    if f.arm_axes > 0:
        task_forward(f.arm, e.reference[: f.arm_axes], e.pose)
    for i in range(f.hydraulic):
        e.load[i] = f.servo[i, 1] * e.head[i] - f.servo[i, 2] * e.rod[i]
    w.measures[:] = 0.0
    begin_task(f, e, w)


@compiled
def _observe(f, e, w, address, sim):
    """Write the observation; readings saturate at the ends of their ranges."""
    n = f.observations
    out = carray(pointer(address + 4 * sim * n), (n,), np.float32)
    low = carray(pointer(f.low), (n,), np.float32)
    high = carray(pointer(f.high), (n,), np.float32)
    observe_task(f, e, w, out)
    for c in range(n):
        if not low[c] <= out[c] <= high[c]:
            e.saturated += 1
            out[c] = min(high[c], max(low[c], out[c])) if np.isfinite(out[c]) else low[c]


@compiled
def _step(f, e, m, d, sim, w, action):
    """One environment step; reward, whether the task is over, whether the time is."""
    for _ in range(f.ticks):
        act(f, e, action)
        _physics(f, e, m, d, sim, w)
        e.tick += 1
        sense(f, e, w, sim)
        tick_task(f, e, w)  # after the physics: before, MuJoCo's places are another simulation's
    e.tip[:] = w.tip
    e.step += 1
    if _unstable(f, e, d):
        e.fault = 1
        e.faults += 1
        return 0.0, True, False
    reward, done = reward_task(f, e, w)
    return reward, done, e.step >= f.horizon and not done


@compiled
def _advance(m, d, sim, argument):
    f = carray(pointer(argument), (1,), FACTS)[0]
    e = carray(pointer(f.memory), (f.count,), MEMORY)[sim]
    w = world(f, m, d, sim)
    reward = carray(pointer(f.reward), (f.count,), np.float64)
    terminated = carray(pointer(f.terminated), (f.count,), np.uint8)
    truncated = carray(pointer(f.truncated), (f.count,), np.uint8)
    reward[sim], terminated[sim], truncated[sim] = 0.0, 0, 0
    fresh = f.call == RESET or (f.autoreset == NEXT_STEP and e.over != 0)
    if fresh:
        _begin_episode(f, e, m, d, sim, w)
        _observe(f, e, w, f.observation, sim)
        return
    if f.autoreset == DISABLED and e.over != 0:
        return
    action = carray(pointer(f.action + 4 * sim * f.actions), (f.actions,), np.float32)
    value, done, late = _step(f, e, m, d, sim, w, action)
    reward[sim], terminated[sim], truncated[sim] = value, done, late
    e.over = 1 if done or late else 0
    if f.autoreset == SAME_STEP and e.over != 0:
        floats(f.final_measures + 8 * sim * MEASURES, MEASURES)[:] = w.measures
        _observe(f, e, w, f.final, sim)
        _begin_episode(f, e, m, d, sim, w)
    _observe(f, e, w, f.observation, sim)


@callback(_SIGNATURE)
def advance(m, d, sim, argument):
    """A step or a reset of one simulation: (mjModel*, mjData*, number, record of FACTS)."""
    _advance(m, d, sim, argument)
