"""What an agent sees of the machine: its sensors, the tip by nominal kinematics, the commands.

`machine_fields` says in Python what `observe_machine` writes in native code, in the same order.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.envs.episode import ARM
from hydrotele.kinematics.task import task_forward
from hydrotele.machine.machine import Machine

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
