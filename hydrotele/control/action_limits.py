"""Rates and accelerations of full actions, which environments and policies in scenario runs share."""

import numpy as np

from hydrotele.kinematics.drive_linkage import axis_linkage
from hydrotele.machine.machine import Machine

_FULL_RATE_FRACTION = 0.8  # fraction of the speed at rated or pump flow that a full action commands
_FORCE_DRIVE_RATE = 0.5  # rad/s or m/s, rate of a force drive at full action
MAX_ACCELERATION = 1.0  # rad/s^2 or m/s^2, limit of the joint references
MAX_POSE_ACCELERATIONS = (1.0, 0.5, 1.0, 1.0, 0.8)  # m/s^2, rad/s^2, limits of the pose reference
POSE_RATES = (0.5, 0.3, 0.5, 0.4, 0.25)  # m/s, rad/s: tip rates at full action: r, theta, z, attitude, head


def full_action_rate(machine: Machine, axis: str) -> float:
    """Return the rate of an axis that a full action commands.

    The flow of valve and pump suffices for this rate in the whole range of the joint.

    Args:
        machine: the machine.
        axis: name of the axis.

    Returns:
        The rate [rad/s] or [m/s]: 0.8 times the smaller of rated valve flow and pump flow, divided by the
        head-side area and by the largest moment arm in the joint range; 0.5 for an axis without a
        valve.
    """
    facts = machine.axes[axis]
    low, high = machine.joints[facts.joint].range or (-1.0, 1.0)
    if not (facts.valve and machine.supply):
        return _FORCE_DRIVE_RATE
    arm = np.abs(axis_linkage(machine, axis).rate(np.linspace(low, high, 101))).max()
    flow = min(facts.valve.rated_flow, machine.supply.pump_flow)
    return _FULL_RATE_FRACTION * flow / facts.hydraulic_drive.effective_areas[0] / float(arm)
