"""An environment step in native code: actions, control, physics, sensors, reward, a new episode.

MuJoCo calls `advance` for every simulation from its own threads; nothing of Python runs in it.
"""
# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import mujoco
import numpy as np
from numba import carray, types

from hydrotele.core.compiled import callback, compiled
from hydrotele.kinematics.task import task_forward
from hydrotele.simulate.fleet import STATE
from hydrotele.simulate.pointers import call_set_state, call_step, floats, pointer
from hydrotele.tasks.act import act
from hydrotele.tasks.chance import draw
from hydrotele.tasks.kinds import begin_task, judge_task, observe_task, tick_task
from hydrotele.tasks.memory import (
    AXES,
    DISABLED,
    FACTS,
    MEASURES,
    MEMORY,
    NEXT_STEP,
    RESET,
    SAME_STEP,
)
from hydrotele.tasks.sense import sense
from hydrotele.tasks.world import world

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
    reward, done = judge_task(f, e, w)
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
