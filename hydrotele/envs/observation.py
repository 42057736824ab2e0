"""Fields of an observation with name, SI unit and bounds.

The observation of the machine has its sensors, the tip pose from nominal kinematics, and the
commands.
"""

import math
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.envs.episode import MAX_ARM_AXES, arm_values
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.machine.machine import Machine

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

    Examples:
        >>> import gymnasium
        >>> import hydrotele as ht
        >>> import hydrotele.envs
        >>> env = gymnasium.make("hydrotele/HoldForce-v0", variants=1)
        >>> fields = {field.name: field for field in env.unwrapped.core.setup.fields}
        >>> fields["pressure_head.boom"]
        ObservationField(name='pressure_head.boom', unit='Pa', low=-1000000.0, high=60000000.0)

        A custom task declares its observation with such fields.

        >>> height = ht.ObservationField("height_error", "m", low=-5.0, high=5.0)
    """

    name: str
    unit: str
    low: float
    high: float


def make_position_observation_field(machine: Machine, axis: str, what: str = "") -> ObservationField:
    """Return the observation field (name, unit, bounds) of an axis position.

    `what` is the quantity in the name; if empty, it is `angle` or `position`, by the kind of joint.
    The bounds exceed the joint range by 0.15 rad or m.
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
    """Return the observation fields of a tip pose: r, theta, z, attitude, and head for a five-axis arm.

    `what` is the first part of their names, for example `tip.r`.
    """
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
    """Return an upper bound of the tip radius [m]: the sum of the lengths of all links and of the tip offset."""
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
        The fields, in order: positions, rates, head and rod pressures of the driven axes,
        supply pressures, pose of the tip (for a machine with an arm), commands.
    """
    valves = [name for name in axes if machine.axes[name].is_hydraulic]
    fields = [make_position_observation_field(machine, name) for name in axes]
    fields += [make_rate_observation_field(machine, name) for name in axes]
    fields += [ObservationField(f"pressure_head.{name}", "Pa", *_PRESSURE_BOUNDS) for name in valves]
    fields += [ObservationField(f"pressure_rod.{name}", "Pa", *_PRESSURE_BOUNDS) for name in valves]
    if valves:
        fields += [ObservationField(channel, "Pa", *_PRESSURE_BOUNDS) for channel in machine.supply_channels]
    if arm_axes:
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
        Number of values written, scalar; 0 for a task whose observation has no readings.

    Source: `list_machine_observation_fields`.
    """
    at = 0
    if f.with_readings == 0:
        return at
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
        for i in range(f.supplies):
            out[at] = e.supply[i]
            at += 1
    if f.arm_axes > 0:
        pose = np.empty(MAX_ARM_AXES)
        compute_tip_pose(f.arm, arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]), pose)
        for c in range(max(4, f.arm_axes)):
            out[at] = pose[c]
            at += 1
    for a in range(f.axes_driven):
        out[at] = e.command[f.driven_axis[a]]
        at += 1
    return at
