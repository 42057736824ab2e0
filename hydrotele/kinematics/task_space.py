"""Compiled task-space kinematics of an arm for control loops: poses, joint angles and rates.

The same equations serve the excavator (swing, boom, stick, tool) and the feller-buncher, with a
head that rotates the tool sideways. At the head angle h the tool is `along + radius cos h` ahead of
the tool pin and `side - radius sin h` to the left of the swing axis. `kinematics.arm` and
`kinematics.feller_arm` implement the same geometry with error messages; these functions return a
status instead.
"""

import math

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.kinematics.arm import ArmGeometry
from hydrotele.kinematics.feller_arm import FellerGeometry

(
    BASE_RADIUS,
    BASE_HEIGHT,
    LATERAL_OFFSET,
    BOOM_LENGTH,
    STICK_LENGTH,
    BEND_ANGLE,
    TOOL_ALONG,
    TOOL_UP,
    HEAD_RADIUS,
) = range(9)
REACHED, OUT_OF_REACH, SINGULAR = range(3)
_MIN_ELBOW_SINE = 1e-3  # sine of the elbow, or radius [m], below which rates are not computed


def arm_parameters(geometry: ArmGeometry | FellerGeometry) -> np.ndarray:
    """Pack the dimensions of an arm into the array (9,) that the compiled functions need [m], [rad].

    Args:
        geometry: an excavator's arm, with or without a tool joint, or a feller-buncher's arm.

    Returns:
        Elements BASE_RADIUS, BASE_HEIGHT, LATERAL_OFFSET, BOOM_LENGTH, STICK_LENGTH, BEND_ANGLE (from
        the stick to the bar from stick pin to tip), TOOL_ALONG, TOOL_UP, HEAD_RADIUS.
    """
    g = geometry
    if isinstance(g, FellerGeometry):
        return np.array([
            g.base_radius, g.base_height, 0.0, g.boom_length, g.stick_length, 0.0, g.tilt_length,
            -g.head_depth, g.head_radius,
        ])  # fmt: skip
    along, up = g.tool_offset
    stick, bend = g.stick_length, 0.0
    if not g.has_tool_joint:
        stick, bend = math.hypot(g.stick_length + along, up), math.atan2(up, g.stick_length + along)
        along, up = 0.0, 0.0
    return np.array([
        g.base_radius, g.boom_pin_height, g.lateral_offset, g.boom_length, stick, bend, along, up,
        0.0,
    ])  # fmt: skip


@compiled
def compute_tip_pose(arm, q, pose):
    """Compute the pose of an arm's tip from its joint angles (forward kinematics).

    Args:
        arm: (9,) output of `arm_parameters`.
        q: (k,) swing, boom, stick and, if driven, tool and head angle [rad]; k is 3, 4 or 5.
        pose: (5,) written: r [m], theta [rad], z [m], attitude [rad], head [rad]; the head angle is
            0 for an arm without a head, the attitude is that of the last link.

    Returns:
        Nothing.

    Source: Zhu 1994, 2.2 and 2.7.
    """
    k = len(q)
    head = q[4] if k > 4 else 0.0
    tool = q[3] if k > 3 else 0.0
    elbow = q[1] + q[2] + arm[5]
    attitude = q[1] + q[2] + tool
    along, side = arm[6] + arm[8] * math.cos(head), arm[2] - arm[8] * math.sin(head)
    c, s = math.cos(attitude), math.sin(attitude)
    x = arm[0] + arm[3] * math.cos(q[1]) + arm[4] * math.cos(elbow) + along * c - arm[7] * s
    z = arm[1] + arm[3] * math.sin(q[1]) + arm[4] * math.sin(elbow) + along * s + arm[7] * c
    pose[0] = math.sqrt(x * x + side * side)
    pose[1] = q[0] + math.atan2(side, x)
    pose[2] = z
    pose[3] = attitude
    pose[4] = head


@compiled
def solve_joint_angles(g, pose, present_swing, q):
    """Compute the joint angles for a pose of the arm's tip (inverse kinematics).

    Of several solutions, the function returns that with the tip ahead of the swing axis. The pin
    between boom and stick is then above the line from the boom pin to the outer end of the stick.

    Args:
        g: (9,) output of `arm_parameters`.
        pose: (5,) pose as written by `compute_tip_pose`.
        present_swing: present swing angle, scalar [rad]; the result is within half a turn of it.
        q: (k,) joint angles [rad], written unless the pose is out of reach.

    Returns:
        REACHED (0), or OUT_OF_REACH (1).

    Source: Zhu 1994, 2.3-2.6 and 2.17-2.25.
    """
    k = len(q)
    head = pose[4] if k > 4 else 0.0
    along, side = g[6] + g[8] * math.cos(head), g[2] - g[8] * math.sin(head)
    square = pose[0] * pose[0] - side * side
    if not square >= 0.0:
        return 1
    x = math.sqrt(square)
    c, s = math.cos(pose[3]), math.sin(pose[3])
    px, pz = x - g[0], pose[2] - g[1]
    if k > 3:
        px -= along * c - g[7] * s
        pz -= along * s + g[7] * c
    inner = (px * px + pz * pz - g[3] * g[3] - g[4] * g[4]) / (2.0 * g[3] * g[4])
    if not -1.0 <= inner <= 1.0:
        return 1
    bent = -math.acos(inner)
    q[0] = pose[1] - math.atan2(side, x)
    q[0] += 2.0 * math.pi * np.rint((present_swing - q[0]) / (2.0 * math.pi))
    q[1] = math.atan2(pz, px) - math.atan2(g[4] * math.sin(bent), g[3] + g[4] * inner)
    q[2] = bent - g[5]
    if k > 3:
        q[3] = pose[3] - q[1] - q[2]
    if k > 4:
        q[4] = head
    return 0


@compiled
def compute_joint_rates(g, q, pose, rate, out):
    """Compute the joint rates that give a rate of the tip's pose (inverse Jacobian).

    Args:
        g: (9,) output of `arm_parameters`.
        q: (k,) joint angles [rad].
        pose: (5,) pose of the tip at these angles, as written by `compute_tip_pose`.
        rate: (5,) time derivative of r, theta, z, attitude and head [m/s], [rad/s].
        out: (k,) joint rates [rad/s], written unless the status is SINGULAR.

    Returns:
        REACHED (0), or SINGULAR (2): boom and stick are nearly collinear, or the tip is nearly on
        the swing axis.

    Source: closed-form solution of the derivative of `compute_tip_pose`.
    """
    k = len(q)
    head, turning = (q[4], rate[4]) if k > 4 else (0.0, 0.0)
    along, side = g[6] + g[8] * math.cos(head), g[2] - g[8] * math.sin(head)
    longer, aside = -g[8] * math.sin(head) * turning, -g[8] * math.cos(head) * turning
    bent = q[2] + g[5]
    x = math.sqrt(max(pose[0] * pose[0] - side * side, 0.0))
    if abs(math.sin(bent)) < _MIN_ELBOW_SINE or x < _MIN_ELBOW_SINE:
        return 2
    vx, vz = (pose[0] * rate[0] - side * aside) / x, rate[2]
    out[0] = rate[1] - (aside * x - side * vx) / (pose[0] * pose[0])
    c, s = math.cos(pose[3]), math.sin(pose[3])
    if k > 3:
        vx -= longer * c - (along * s + g[7] * c) * rate[3]
        vz -= longer * s + (along * c - g[7] * s) * rate[3]
    c2, s2 = math.cos(q[1]), math.sin(q[1])
    c23, s23 = math.cos(q[1] + bent), math.sin(q[1] + bent)
    sine = math.sin(bent)
    px, pz = g[3] * c2 + g[4] * c23, g[3] * s2 + g[4] * s23
    out[1] = (c23 * vx + s23 * vz) / (g[3] * sine)
    out[2] = -(px * vx + pz * vz) / (g[3] * g[4] * sine)
    if k > 3:
        out[3] = rate[3] - out[1] - out[2]
    if k > 4:
        out[4] = turning
    return 0


@compiled
def task_jacobian(g, q, out):
    """Compute the derivatives of the tip's pose by the joint angles.

    Args:
        g: (9,) output of `arm_parameters`.
        q: (k,) joint angles [rad].
        out: (k, k) written: d (r, theta, z, attitude, head) / d q, the first k rows [m/rad], [1].

    Returns:
        Nothing.

    Source: derivative of `compute_tip_pose`.
    """
    k = len(q)
    head = q[4] if k > 4 else 0.0
    tool = q[3] if k > 3 else 0.0
    along, side = g[6] + g[8] * math.cos(head), g[2] - g[8] * math.sin(head)
    elbow, attitude = q[1] + q[2] + g[5], q[1] + q[2] + tool
    c, s = math.cos(attitude), math.sin(attitude)
    outer_x, outer_z = along * c - g[7] * s, along * s + g[7] * c
    stick_x, stick_z = g[4] * math.cos(elbow) + outer_x, g[4] * math.sin(elbow) + outer_z
    boom_x, boom_z = g[3] * math.cos(q[1]) + stick_x, g[3] * math.sin(q[1]) + stick_z
    x = g[0] + boom_x
    square = x * x + side * side
    r = math.sqrt(square)
    out[:, :] = 0.0
    out[1, 0] = 1.0
    for j in range(1, k):
        if j < 4:
            lever_x = boom_x if j == 1 else (stick_x if j == 2 else outer_x)
            lever_z = boom_z if j == 1 else (stick_z if j == 2 else outer_z)
            dx, dz, dy = -lever_z, lever_x, 0.0
        else:
            dx, dz = -g[8] * math.sin(head) * c, -g[8] * math.sin(head) * s
            dy = -g[8] * math.cos(head)
        out[0, j] = (x * dx + side * dy) / r
        out[1, j] = (dy * x - side * dx) / square
        out[2, j] = dz
        if k > 3 and j < 4:
            out[3, j] = 1.0
    if k > 4:
        out[4, 4] = 1.0
