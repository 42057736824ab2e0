"""Access of native code to a simulation, calls of the native code of a task, machine observations.

`SimulationView` holds the arrays of one simulation. The native code of a task is called by address, so every
task, and the loop that calls it, compiles separately. `write_machine_observation` writes the observation of
the machine: sensors, tip pose from nominal kinematics, and commands. `list_machine_observation_fields` returns the
names, units and bounds of these values in the same order.
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
from hydrotele.core.memory import address_to_pointer, float64_view, struct_field_view
from hydrotele.envs.episode import EPISODE_STATE, MAX_ARM_AXES, MAX_MEASURES, TASK_PARAMETERS
from hydrotele.kinematics.task import compute_tip_pose
from hydrotele.machine.machine import Machine

BEGIN, TICK, OBSERVE, REWARD = range(4)
"""Parts of a task's native code: start an episode, act after a control period, write the
observation of the task, compute the reward of a step."""

TASK_SIGNATURE = types.float64(*(types.int64,) * 6)
"""Signature (part, mjModel*, mjData*, index of the simulation, TASK_PARAMETERS*, float32* output of
the observation) -> reward."""


class SimulationView(NamedTuple):
    """Views of the arrays of one simulation.

    Attributes:
        qpos: (nq,) positions; staggered, see `simulate.record`.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (k,) applied commands.
        tip: (3,) position of the arm's tip at the time of the activations [m].
        xfrc: (6 nbody,) external forces and torques on bodies, world frame [N], [N m].
        xpos: (3 nbody,) positions of the bodies in the last physics step [m].
        xipos: (3 nbody,) positions of their centres of mass [m].
        xquat: (4 nbody,) quaternions of the bodies.
        xmat: (9 nbody,) rotation matrices of the bodies.
        eq_active: (neq,) uint8, whether an equality constraint is active; part of the state.
        eq_data: (neq eq_width,) data of the equality constraints; changes last until the end of this call.
        eq_rows: the same data from the next call on; empty unless the task changes constraints.
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

    Source: `simulate.layout`.
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
    """Call a function with the signature TASK_SIGNATURE by its address."""

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
        part: BEGIN, TICK, OBSERVE or REWARD, scalar.
        out: address of the float32 output of OBSERVE, scalar; 0 for the other parts.

    Returns:
        The reward, scalar, for REWARD, which also writes `over` of the episode; otherwise 0.

    Source: this module.
    """
    return _call_function_at_address(f.task, part, w.model, w.data, w.index, w.parameters_address, out)


@compiled
def observation_view(f, out):
    """Return a view of the memory in which a task writes its observation.

    Args:
        f: record of TASK_PARAMETERS.
        out: address, scalar.

    Returns:
        (observations,) float32; a task writes only its own fields, from the first element on.
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


_SWING_BOUND = 20.0  # rad, bound for a slewing house, which has no joint limits
_POSITION_MARGIN = 0.15  # rad or m by which a measured position may exceed the joint range
_RATE_BOUND = 5.0  # rad/s or m/s, bound of the difference quotient of noisy samples
_PRESSURE_BOUNDS = (
    -1.0e6,
    6.0e7,
)  # Pa, with sensor offset and noise; relief valves open at about 32 MPa


class ObservationField(NamedTuple):
    """One value of an observation.

    Attributes:
        name: `<quantity>.<axis or coordinate>`.
        unit: SI unit.
        low: lower bound, at which values saturate.
        high: upper bound.
    """

    name: str
    unit: str
    low: float
    high: float


def make_position_observation_field(machine: Machine, axis: str, what: str = "") -> ObservationField:
    """Return the observation field (name, unit, bounds) of an axis position.

    `what` is the quantity in the name; the default is `angle` or `position`.
    """
    low, high = machine.joints[machine.axes[axis].joint].range or (-_SWING_BOUND, _SWING_BOUND)
    kind = machine.position_kind(axis)
    unit = "rad" if kind == "angle" else "m"
    return ObservationField(f"{what or kind}.{axis}", unit, low - _POSITION_MARGIN, high + _POSITION_MARGIN)


def make_rate_observation_field(machine: Machine, axis: str, what: str = "rate") -> ObservationField:
    """Return the observation field (name, unit, bounds) of an axis rate; `what` is the quantity in its name."""
    unit = "rad/s" if machine.position_kind(axis) == "angle" else "m/s"
    return ObservationField(f"{what}.{axis}", unit, -_RATE_BOUND, _RATE_BOUND)


def make_pose_observation_fields(machine: Machine, arm_axes: int, what: str = "tip") -> list[ObservationField]:
    """Return the observation fields of a tip pose: r, theta, z, attitude, and head for a five-axis arm."""
    far = max_reach(machine)
    fields = [
        ObservationField(f"{what}.r", "m", 0.0, far),
        ObservationField(f"{what}.theta", "rad", -_SWING_BOUND, _SWING_BOUND),
        ObservationField(f"{what}.z", "m", -far, far),
        ObservationField(f"{what}.attitude", "rad", -2.0 * math.pi, 2.0 * math.pi),
        ObservationField(f"{what}.head", "rad", -math.pi, math.pi),
    ]
    return fields[: max(4, arm_axes)]


def max_reach(machine: Machine) -> float:
    """Return an upper bound of the tip radius [m]: the sum of all link lengths."""
    lengths = [float(np.linalg.norm(link.position)) for link in machine.links.values()]
    assert machine.arm
    return sum(lengths) + float(np.linalg.norm(machine.arm.tip.position))


def list_machine_observation_fields(machine: Machine, axes: tuple[str, ...], arm_axes: int) -> list[ObservationField]:
    """Return the observation fields that `write_machine_observation` writes.

    Args:
        machine: the machine.
        axes: names of the driven axes.
        arm_axes: number of axes of the arm.

    Returns:
        The fields, in order: positions, rates, head and rod pressures of the driven axes, supply
        pressure, pose of the tip, commands.
    """
    valves = [name for name in axes if machine.axes[name].is_hydraulic]
    fields = [make_position_observation_field(machine, name) for name in axes]
    fields += [make_rate_observation_field(machine, name) for name in axes]
    fields += [ObservationField(f"pressure_head.{name}", "Pa", *_PRESSURE_BOUNDS) for name in valves]
    fields += [ObservationField(f"pressure_rod.{name}", "Pa", *_PRESSURE_BOUNDS) for name in valves]
    if valves:
        fields.append(ObservationField("pressure_supply", "Pa", *_PRESSURE_BOUNDS))
    fields += make_pose_observation_fields(machine, arm_axes)
    for name in axes:
        force = machine.axes[name].force
        limit = force.command_limit if force else 1.0
        unit = force.command_unit if force else "1"
        fields.append(ObservationField(f"command.{name}", unit, -limit, limit))
    return fields


@compiled
def write_machine_observation(f, e, out):
    """Write the measured values of the machine, the tip pose and the commands to the observation.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE.
        out: (observations,) float32, written from index 0 on.

    Returns:
        Number of values written, scalar.

    Source: `list_machine_observation_fields`.
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
    pose = np.empty(MAX_ARM_AXES)
    compute_tip_pose(f.arm, e.joint[: f.arm_axes], pose)
    for c in range(max(4, f.arm_axes)):
        out[at] = pose[c]
        at += 1
    for a in range(f.axes_driven):
        out[at] = e.command[f.driven_axis[a]]
        at += 1
    return at
