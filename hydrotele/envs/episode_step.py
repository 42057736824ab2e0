"""Parts of an environment step that do not depend on the simulation of the machine.

Joint-rate actions move the joint references; pose-rate actions move them by resolved motion. The
joint servo tracks the references. The acceleration of the references is limited, since a machine of
20 t cannot follow a step.
"""

import math

import numpy as np

from hydrotele.control.rate_references import ArmLimits, advance_joint_reference, advance_pose_reference
from hydrotele.control.servo import (
    ComputedForce,
    DriveReference,
    MeasuredState,
    interpolate_drive_reference,
    servo_step,
)
from hydrotele.core.compiled import compiled
from hydrotele.envs.episode import (
    JOINT_RATE,
    MAX_ARM_AXES,
    MAX_AXES,
    MAX_CHANNELS,
    RESOLVED_MOTION,
    VALVE,
    arm_values,
    draw_uniform,
)
from hydrotele.kinematics.task_space import compute_tip_pose
from hydrotele.simulate.sensor_models import Readings, SensorParameters, convert_to_readings, store_readings

assert MAX_CHANNELS >= 4 * MAX_AXES


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
    ranges = np.empty((MAX_ARM_AXES, 2))[:k]
    q, rates, joint = (
        arm_values(f, e.reference, np.empty(MAX_ARM_AXES)[: f.arm_axes]),
        arm_values(f, e.reference_rate, np.empty(MAX_ARM_AXES)[: f.arm_axes]),
        arm_values(f, e.joint, np.empty(MAX_ARM_AXES)[: f.arm_axes]),
    )
    for a in range(k):
        ranges[a, 0], ranges[a, 1] = f.ranges[f.driven_axis[a], 0], f.ranges[f.driven_axis[a], 1]
    arm = ArmLimits(f.arm, ranges, f.accelerations)
    e.blocked = 1 if advance_pose_reference(arm, goal, f.period, joint, e.pose, e.pose_rate, q, rates) else 0
    for a in range(k):
        e.reference[f.driven_axis[a]], e.reference_rate[f.driven_axis[a]] = q[a], rates[a]


@compiled
def convert_action_to_commands(f, e, action, table):
    """Convert the action into valve commands, or into references of the joint servo, for one control period.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `command` is written for valve actions. For all others, joint
            and pose references and `drive`, the references of the drives, are written.
        action: (actions,) of the agent; values outside +-1 are clipped.
        table: (axes, TABLE_POINTS, 3) of `servo.tabulate_drive_geometry`.

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
    interpolate_drive_reference(
        f.grid[:k], table, e.reference[:k], e.reference_rate[:k], f.feedforward, e.drive[0, :k],
        e.drive[1, :k], e.drive[2, :k], e.drive[3, :k],
    )  # fmt: skip


@compiled
def compute_servo_commands(f, e):
    """Run the joint servo once; the commands of the axes under feedback are written.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; `command` and `load` are written.

    Returns:
        Nothing.

    Source: `control.servo`.
    """
    k = f.axes
    none = np.zeros(MAX_AXES)[:k]
    drive = DriveReference(e.drive[0, :k], e.drive[1, :k], e.drive[2, :k], e.drive[3, :k])
    measured = MeasuredState(e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply[: f.supplies])
    servo_step(
        f.servo[:k], f.closed[:k], drive, e.sampled_reference[:k], measured, e.load[:k],
        ComputedForce(False, none, none), e.command[:k],
    )  # fmt: skip


@compiled
def sample_sensors(f, e, values, scale, offset):
    """Convert true values into readings with random errors, and store them in the episode.

    Args:
        f: record of TASK_PARAMETERS.
        e: record of EPISODE_STATE; measured values, their random errors and `sampled_reference` are written.
        values: (c,) true values after delay and lag: positions, head and rod pressure of every valve, supply
            pressures [rad] or [m], [Pa]; replaced by the readings.
        scale: (c,) scale factors of the sensors [1].
        offset: (c,) offsets of the sensors.

    Returns:
        Nothing.

    Source: `simulate.sensor_models`, as in scenario runs.
    """
    k, c = f.axes, len(values)
    for i in range(k):
        e.sampled_reference[i] = e.reference[i]
    for i in range(c):
        e.error[i] = f.accuracy[i] * (2.0 * draw_uniform(e) - 1.0) if f.noisy else 0.0
    sensors = SensorParameters(scale, offset, f.converters[0], f.converters[1], f.converters[2])
    convert_to_readings(sensors, values, e.error[:c])
    span = f.every * f.period if e.tick > 0 else 0.0
    readings = Readings(e.joint[:k], e.rate[:k], e.head[:k], e.rod[:k], e.supply[: f.supplies])
    store_readings(values, f.hydraulic, span, readings)


@compiled
def draw_variant(f, e):
    """Draw the variant of a new episode, and initialise its counters and commands.

    `f` and `e` are records of TASK_PARAMETERS and EPISODE_STATE.
    """
    e.last_variant, e.last_fault = e.variant, e.fault
    e.variant = int(draw_uniform(e) * f.variants)
    e.episode += 1
    e.step, e.tick, e.over, e.fault, e.blocked = 0, 0, 0, 0, 0
    e.work = 0.0
    for i in range(len(e.command)):
        e.command[i] = 0.0


@compiled
def initialise_references(f, e):
    """Set the references of a new episode to the measured positions, with rates of 0, and the filtered drive forces.

    `f` and `e` are records of TASK_PARAMETERS and EPISODE_STATE.
    """
    for i in range(len(e.joint)):
        e.reference[i] = e.sampled_reference[i] = e.joint[i]
        e.reference_rate[i] = 0.0
    for c in range(len(e.pose_rate)):
        e.pose_rate[c] = 0.0
    if f.arm_axes > 0:
        compute_tip_pose(f.arm, arm_values(f, e.reference, np.empty(MAX_ARM_AXES)[: f.arm_axes]), e.pose)
    for i in range(f.hydraulic):
        e.load[i] = f.servo[i, 1] * e.head[i] - f.servo[i, 2] * e.rod[i]


@compiled
def shape_reward(f, e, reward, potential):
    """Add the potential-based shaping F = gamma Phi(s') - Phi(s) to the reward of a step from s to s'; store Phi(s').

    Source: Ng, Harada, Russell 1999, Policy invariance under reward transformations, theorem 1. Phi
    is 0 in a terminal state.
    """
    reward += f.shaping * potential - e.potential
    e.potential = potential
    return reward


@compiled
def clip_observation(e, out, low, high):
    """Clip an observation to its bounds, in place; a value that is not finite becomes the lower bound.

    Args:
        e: record of EPISODE_STATE; values outside the bounds are counted in `saturated`.
        out: (observations,) float32.
        low: (observations,) lower bounds.
        high: (observations,) upper bounds.

    Returns:
        Nothing.
    """
    for c in range(len(out)):
        if not low[c] <= out[c] <= high[c]:
            e.saturated += 1
            out[c] = min(high[c], max(low[c], out[c])) if math.isfinite(out[c]) else low[c]
