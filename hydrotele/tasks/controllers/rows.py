"""Laws of one machine, applied to the rows of a batch."""

import numpy as np

from hydrotele.control.drive_rows import drive_row
from hydrotele.control.servo import servo_step
from hydrotele.core.compiled import compiled
from hydrotele.kinematics.task import task_forward, task_inverse


@compiled
def servo_rows(
    numbers, grid, table, reference, rate_ahead, joint, rate, head, rod, supply, load, out
):  # fmt: skip
    """Commands of n episodes by the joint servo.

    Args:
        numbers: (k, 14) of `control.servo.servo_numbers`.
        grid: (k, 2) of `control.drive_rows.drive_tables`.
        table: (k, POINTS, 3) of the same.
        reference: (n, k) [rad] or [m].
        rate_ahead: (n, k) wanted rates, ahead by the spool's lag [rad/s] or [m/s].
        joint: (n, k) measured [rad] or [m].
        rate: (n, k) measured [rad/s] or [m/s].
        head: (n, k) measured head-side pressures [Pa].
        rod: (n, k) measured rod-side pressures [Pa].
        supply: (n,) measured [Pa].
        load: (n, k) slow means of the drive forces, updated [N] or [N m].
        out: (n, k) commands, written [1] or in the drive's unit.

    Returns:
        Nothing.

    Source: `control.servo.servo_step`.
    """
    k = len(numbers)
    closed, none = np.ones(k), np.zeros(k)
    velocity, arm, volume_head, volume_rod = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    for i in range(len(reference)):
        drive_row(
            grid, table, reference[i], rate_ahead[i], 1.0, velocity, arm, volume_head, volume_rod
        )
        servo_step(
            numbers, closed, velocity, arm, volume_head, volume_rod, reference[i], joint[i],
            rate[i], head[i], rod[i], supply[i], load[i], False, none, none, out[i],
        )  # fmt: skip


@compiled
def forward_rows(arm, q, pose):
    """Poses of the tip of n episodes.

    Args:
        arm: (9,) of `kinematics.task.task_numbers`.
        q: (n, k) joint angles [rad].
        pose: (n, 5) written: r [m], theta [rad], z [m], attitude [rad], head [rad].

    Returns:
        Nothing.

    Source: `kinematics.task.task_forward`.
    """
    for i in range(len(q)):
        task_forward(arm, q[i], pose[i])


@compiled
def inverse_rows(arm, ranges, pose, q):
    """Joint angles of n episodes for poses of the tip; those out of reach keep their angles.

    Args:
        arm: (9,) of `kinematics.task.task_numbers`.
        ranges: (k, 2) of the joints [rad].
        pose: (n, 5) r [m], theta [rad], z [m], attitude [rad], head [rad].
        q: (n, k) joint angles, updated [rad].

    Returns:
        Nothing.

    Source: `kinematics.task.task_inverse`.
    """
    k = q.shape[1]
    found = np.empty(k)
    for i in range(len(q)):
        good = task_inverse(arm, pose[i], q[i, 0], found) == 0
        for j in range(k):
            good = good and ranges[j, 0] <= found[j] <= ranges[j, 1]
        if good:
            q[i] = found
