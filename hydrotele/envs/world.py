"""What native code of an environment sees of its simulation, and how it calls that of its task.

Every task has code of its own, called by address: so a task compiles without the others, and the
loop that calls them without any.

What an agent sees of the machine: its sensors, the tip by nominal kinematics, the commands.

`machine_fields` says in Python what `observe_machine` writes in native code, in the same order.
"""

# pyright: reportCallIssue=false, reportPrivateImportUsage=false
# numba's intrinsics are called without their typing context, and carray is its documented API.

import math
from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

from hydrotele.core.compiled import compiled
from hydrotele.core.memory import field, floats, pointer
from hydrotele.envs.episode import ARM, EPISODE_STATE, MEASURES, TASK_PARAMETERS
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.machine import Machine

BEGIN, TICK, OBSERVE, REWARD = range(4)
"""What a task is called for: a new episode, after a control period, for what it observes of itself,
for the reward of the step that is over."""

TASK_CODE = types.float64(*(types.int64,) * 6)
"""(what it is called for, mjModel*, mjData*, number, TASK_PARAMETERS*, where to observe, float32*)
-> the reward."""


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
        number: of the simulation.
        argument: address of the record of TASK_PARAMETERS.
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
    number: int
    argument: int


@compiled
def parameters_at(argument):
    """(1,) record of TASK_PARAMETERS at an address, scalar."""
    return carray(pointer(argument), (1,), TASK_PARAMETERS)


@compiled
def episodes(f):
    """(count,) records of EPISODE_STATE of a record of TASK_PARAMETERS."""
    return carray(pointer(f.episodes), (f.count,), EPISODE_STATE)


@compiled
def world(f, m, d, number, argument):
    """The live arrays of a simulation.

    Args:
        f: record of TASK_PARAMETERS.
        m: address of its mjModel, scalar.
        d: address of its mjData, scalar.
        number: its number, scalar.
        argument: address of `f`, scalar.

    Returns:
        World.

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
        floats(f.eq_rows + 8 * number * numbers, numbers if f.eq_rows else 0),
        floats(f.terrain + 8 * number * f.width, f.width),
        floats(f.measures + 8 * number * MEASURES, MEASURES),
        m,
        d,
        number,
        argument,
    )


@intrinsic
def _call(typingctx, function, part, model, data, number, argument, out):
    """Call a function of the signature TASK_CODE by its address."""

    def codegen(context, builder, signature, args):
        kind = ir.FunctionType(ir.DoubleType(), [ir.IntType(64)] * 6)
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])

    return types.float64(*(types.int64,) * 7), codegen


@compiled
def call_task(f, w, part, out):
    """Let the task do its part.

    Args:
        f: record of TASK_PARAMETERS.
        w: World.
        part: BEGIN, TICK, OBSERVE or REWARD, scalar.
        out: address of the float32 that OBSERVE writes, scalar; 0 for the others.

    Returns:
        The reward, scalar; 0 but for REWARD, which also writes `over` of the episode.

    Source: this module.
    """
    return _call(f.task, part, w.model, w.data, w.number, w.argument, out)


@compiled
def observed(f, out):
    """Room for what a task observes, at least.

    Args:
        f: record of TASK_PARAMETERS.
        out: address, scalar.

    Returns:
        (observations,) float32.
    """
    return carray(pointer(out), (f.observations,), np.float32)


@compiled
def rewarded(e, outcome):
    """Keep whether an episode ends.

    Args:
        e: record of EPISODE_STATE; `over` is written.
        outcome: (reward, whether it ends), scalars.

    Returns:
        The reward, scalar.
    """
    reward, done = outcome
    e.over = 1 if done else 0
    return reward


_TURNS = 20.0  # rad: of a slewing house, which has no end
_BEYOND = 0.15  # rad or m by which a joint and its sensor may read beyond the range
_FASTEST = 5.0  # rad/s or m/s of a difference quotient of noisy readings
_PRESSURES = (-1.0e6, 6.0e7)  # Pa: with a sensor's offset and noise; reliefs open at some 32 MPa


class Field(NamedTuple):
    """One number of an observation.

    Attributes:
        name: `what.where`.
        unit: SI unit.
        low: lowest value; what lies outside saturates.
        high: highest value.
    """

    name: str
    unit: str
    low: float
    high: float


def position_field(machine: Machine, axis: str, what: str = "") -> Field:
    """Field of an axis' position; `what` is its first part, that of the reading by default."""
    low, high = machine.joints[machine.axes[axis].joint].range or (-_TURNS, _TURNS)
    kind = machine.position_kind(axis)
    unit = "rad" if kind == "angle" else "m"
    return Field(f"{what or kind}.{axis}", unit, low - _BEYOND, high + _BEYOND)


def rate_field(machine: Machine, axis: str, what: str = "rate") -> Field:
    """Field of the rate of an axis' position."""
    unit = "rad/s" if machine.position_kind(axis) == "angle" else "m/s"
    return Field(f"{what}.{axis}", unit, -_FASTEST, _FASTEST)


def pose_fields(machine: Machine, arm_axes: int, what: str = "tip") -> list[Field]:
    """Fields of a pose of the tip: r, theta, z, attitude, and the head of an arm with five axes."""
    far = reach(machine)
    fields = [
        Field(f"{what}.r", "m", 0.0, far),
        Field(f"{what}.theta", "rad", -_TURNS, _TURNS),
        Field(f"{what}.z", "m", -far, far),
        Field(f"{what}.attitude", "rad", -2.0 * math.pi, 2.0 * math.pi),
        Field(f"{what}.head", "rad", -math.pi, math.pi),
    ]
    return fields[: max(4, arm_axes)]


def reach(machine: Machine) -> float:
    """A radius that the tip surely stays within [m]: all links in one line."""
    lengths = [float(np.linalg.norm(link.position)) for link in machine.links.values()]
    assert machine.arm
    return sum(lengths) + float(np.linalg.norm(machine.arm.tip.position))


def machine_fields(machine: Machine, axes: tuple[str, ...], arm_axes: int) -> list[Field]:
    """What `observe_machine` writes.

    Args:
        machine: the machine.
        axes: names of the driven axes.
        arm_axes: number of axes of the arm.

    Returns:
        The fields, in order: positions, rates, head and rod pressures of the driven axes, supply
        pressure, pose of the tip, commands.
    """
    valves = [name for name in axes if machine.axes[name].hydraulic]
    fields = [position_field(machine, name) for name in axes]
    fields += [rate_field(machine, name) for name in axes]
    fields += [Field(f"pressure_head.{name}", "Pa", *_PRESSURES) for name in valves]
    fields += [Field(f"pressure_rod.{name}", "Pa", *_PRESSURES) for name in valves]
    if valves:
        fields.append(Field("pressure_supply", "Pa", *_PRESSURES))
    fields += pose_fields(machine, arm_axes)
    for name in axes:
        force = machine.axes[name].force
        limit = force.command_limit if force else 1.0
        unit = force.command_unit if force else "1"
        fields.append(Field(f"command.{name}", unit, -limit, limit))
    return fields


@compiled
def observe_machine(f, e, out):
    """Write what the machine's sensors say.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32; the first ones are written.

    Returns:
        Number of values written, scalar.

    Source: `machine_fields`.
    """
    at = 0
    for a in range(f.axes_driven):
        out[at] = e.joint[f.driven_axis[a]]
        at += 1
    for a in range(f.axes_driven):
        out[at] = e.rate[f.driven_axis[a]]
        at += 1
    for a in range(f.axes_driven):
        if f.driven_axis[a] < f.hydraulic:
            out[at] = e.head[f.driven_axis[a]]
            at += 1
    for a in range(f.axes_driven):
        if f.driven_axis[a] < f.hydraulic:
            out[at] = e.rod[f.driven_axis[a]]
            at += 1
    if f.hydraulic > 0:
        out[at] = e.supply
        at += 1
    pose = np.empty(ARM)
    task_forward(f.arm, e.joint[: f.arm_axes], pose)
    for c in range(max(4, f.arm_axes)):
        out[at] = pose[c]
        at += 1
    for a in range(f.axes_driven):
        out[at] = e.command[f.driven_axis[a]]
        at += 1
    return at
