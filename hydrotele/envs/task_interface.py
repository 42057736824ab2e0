"""Interface between the environment step and the native code of a task.

It provides views of the arrays of one simulation, and calls the parts of a task by the address of
its native code, so that every task compiles separately.
"""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import address_to_pointer, float64_view, struct_field_view
from hydrotele.envs.episode import EPISODE_STATE, MAX_MEASURES, TASK_PARAMETERS

BEGIN, TICK, OBSERVE, REWARD, POTENTIAL = range(5)
"""Parts of a task's native code: start an episode, act after a control period, write the
observation of the task, compute the reward of a step, compute the potential of the current state."""

TASK_SIGNATURE = types.float64(*(types.int64,) * 6)
"""Signature of the native code of a task: (part, m, d, number, argument, out) -> reward or potential, otherwise 0.

`part` is BEGIN (start an episode), TICK (after a control period), OBSERVE (write the observation),
REWARD or POTENTIAL (only with shaping; 0 if the task has no potential). `number` is the index of the
simulation; `m`, `d`, `argument` and `out` are the addresses of mjModel, mjData, TASK_PARAMETERS and
the observation (float32)."""


class SimulationView(NamedTuple):
    """Views of the arrays of one simulation.

    Attributes:
        qpos: (nq,) positions, one physics step ahead of the activations, see `simulate.record`.
        qvel: (nv,) velocities, half a physics step ahead of the activations.
        act: (na,) activations: spools and pressures.
        ctrl: (k,) applied commands.
        tip: (3,) position of the arm's tip at the time of the activations [m].
        xfrc: (6 nbody,) external forces and torques on bodies, world frame [N], [N m].
        xpos: (3 nbody,) positions of the bodies in the last physics step [m].
        xipos: (3 nbody,) positions of the centres of mass of the bodies [m].
        xquat: (4 nbody,) quaternions of the bodies.
        xmat: (9 nbody,) rotation matrices of the bodies.
        eq_active: (neq,) uint8, whether an equality constraint is active; part of the state.
        eq_data: (neq eq_width,) data of the equality constraints in the model; changes last until
            the end of this call of the native code.
        eq_rows: (neq eq_width,) data of the constraints that hold from the next call on; empty
            unless the task changes constraints.
        terrain: (width,) terrain state of the episode; empty for tasks without terrain.
        measures: (MAX_MEASURES,) task measures of this step, for `info`.
        model: address of mjModel.
        data: address of mjData.
        index: index of the simulation.
        parameters_address: address of the TASK_PARAMETERS record.
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
    index: int
    parameters_address: int


@compiled
def task_parameters_view(address):
    """Return a view (1,) of the TASK_PARAMETERS record at an address, scalar."""
    return carray(address_to_pointer(address), (1,), TASK_PARAMETERS)


@compiled
def episode_states_view(f):
    """Return a view (count,) of the EPISODE_STATE records of a TASK_PARAMETERS record."""
    return carray(address_to_pointer(f.episodes), (f.count,), EPISODE_STATE)


@compiled
def simulation_view(f, m, d, number, argument):
    """Return views of the arrays of one simulation in MuJoCo's and the task's memory.

    Args:
        f: record of TASK_PARAMETERS.
        m: address of mjModel, scalar.
        d: address of mjData, scalar.
        number: index of the simulation, scalar.
        argument: address of `f`, scalar.

    Returns:
        SimulationView.

    Source: `simulate.mujoco_c_api`.
    """
    place = carray(address_to_pointer(d + f.at_site), (1,), np.int64)[0]
    active = carray(address_to_pointer(d + f.at_eq_active), (1,), np.int64)[0]
    numbers = f.neq * f.eq_width
    site = f.tip_site if f.tip_site >= 0 else 0
    return SimulationView(
        struct_field_view(d, f.at_qpos, f.nq),
        struct_field_view(d, f.at_qvel, f.nv),
        struct_field_view(d, f.at_act, f.na),
        struct_field_view(d, f.at_ctrl, f.axes),
        float64_view(place + 24 * site, 3),
        struct_field_view(d, f.at_xfrc, 6 * f.nbody),
        struct_field_view(d, f.at_xpos, 3 * f.nbody),
        struct_field_view(d, f.at_xipos, 3 * f.nbody),
        struct_field_view(d, f.at_xquat, 4 * f.nbody),
        struct_field_view(d, f.at_xmat, 9 * f.nbody),
        carray(address_to_pointer(active), (f.neq,), np.uint8),
        struct_field_view(m, f.at_eq_data, numbers),
        float64_view(f.eq_rows + 8 * number * numbers, numbers if f.eq_rows else 0),
        float64_view(f.terrain + 8 * number * f.width, f.width),
        float64_view(f.measures + 8 * number * MAX_MEASURES, MAX_MEASURES),
        m,
        d,
        number,
        argument,
    )


@intrinsic
def _call_function_at_address(typingctx, function, part, model, data, number, argument, out):
    """Call the function at the address `function`, which has the signature TASK_SIGNATURE, and return its result."""

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.DoubleType(), [ir.IntType(64)] * 6)
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])

    return types.float64(*(types.int64,) * 7), codegen


@compiled
def call_task_part(f, w, part, out):
    """Call one part of the task's native code for a simulation.

    Args:
        f: record of TASK_PARAMETERS.
        w: SimulationView.
        part: BEGIN, TICK, OBSERVE, REWARD or POTENTIAL, scalar.
        out: address of the float32 output of OBSERVE, scalar; 0 for the other parts.

    Returns:
        The reward, scalar, for REWARD, which also writes `over` of the episode; the potential, scalar,
        for POTENTIAL; otherwise 0.

    Source: this module.
    """
    return _call_function_at_address(f.task, part, w.model, w.data, w.index, w.parameters_address, out)


@compiled
def observation_view(f, out):
    """Return a view of the memory in which a task writes its observation.

    Args:
        f: record of TASK_PARAMETERS.
        out: address of the first value that belongs to the task, scalar.

    Returns:
        (observations,) float32 from this address on; a task writes only as many as it has fields.
    """
    return carray(address_to_pointer(out), (f.observations,), np.float32)


@compiled
def store_episode_end(e, outcome):
    """Store in the episode record whether the episode ends, and return the reward.

    Args:
        e: record of EPISODE_STATE; `over` is written.
        outcome: (reward, whether the episode ends), scalars.

    Returns:
        The reward, scalar.
    """
    reward, done = outcome
    e.over = 1 if done else 0
    return reward
