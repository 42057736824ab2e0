"""References of the drives for one control period: moment arm and chamber volumes, from tables."""

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.kinematics.from_machine import axis_linkage
from hydrotele.machine.machine import Machine

POINTS = 4001  # over a joint's range: interpolation is good to some 1e-7 of a moment arm
_LOW, _STEP = range(2)
_WIDE = 1.0  # rad or m, of a joint without a range, whose drive is direct


def drive_tables(machine: Machine, axes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Moment arms and chamber volumes over the joints' ranges.

    Args:
        machine: the machine.
        axes: axis names in column order.

    Returns:
        (grid (k, 2): lowest joint position and step, table (k, POINTS, 3): d(drive)/d(joint), head
        and rod chamber volume [m^3]).
    """
    grid, table = np.zeros((len(axes), 2)), np.ones((len(axes), POINTS, 3))
    for i, name in enumerate(axes):
        axis = machine.axes[name]
        low, high = machine.joints[axis.joint].range or (-_WIDE, _WIDE)
        places = np.linspace(low, high, POINTS)
        grid[i] = low, places[1] - places[0]
        linkage = axis_linkage(machine, name)
        table[i, :, 0] = linkage.rate(places)
        if axis.hydraulic:
            x = np.asarray(linkage.length(places))
            if axis.cylinder:
                x = np.clip(x - axis.cylinder.closed_length, 0.0, axis.cylinder.stroke)
            table[i, :, 1], table[i, :, 2] = axis.hydraulic_drive.volumes(x)
    return grid, table


@compiled
def drive_row(grid, table, reference, rate, scale, velocity, arm, volume_head, volume_rod):
    """Drive references of one period.

    Args:
        grid: (k, 2) of `drive_tables`.
        table: (k, POINTS, 3) of `drive_tables`.
        reference: (k,) joint references [rad] or [m].
        rate: (k,) their rates [rad/s] or [m/s].
        scale: of the velocities, the servo's feedforward; scalar.
        velocity: (k,) written: wanted drive velocity [m/s] or [rad/s].
        arm: (k,) written: d(drive)/d(joint).
        volume_head: (k,) written [m^3].
        volume_rod: (k,) written [m^3].

    Returns:
        Nothing.

    Source: linkages of the machine, interpolated linearly.
    """
    last = table.shape[1] - 1
    for i in range(len(reference)):
        place = (reference[i] - grid[i, 0]) / grid[i, 1]
        place = min(last - 1e-6, max(0.0, place))
        row = int(place)
        part = place - row
        arm[i] = table[i, row, 0] + part * (table[i, row + 1, 0] - table[i, row, 0])
        volume_head[i] = table[i, row, 1] + part * (table[i, row + 1, 1] - table[i, row, 1])
        volume_rod[i] = table[i, row, 2] + part * (table[i, row + 1, 2] - table[i, row, 2])
        velocity[i] = scale * arm[i] * rate[i]
