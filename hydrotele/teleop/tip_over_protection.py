"""Protection of the machine against tipping over, by a force on the handle's vertical axis."""

import math

import numpy as np

from hydrotele.scenario.teleoperation import TipOver
from hydrotele.teleop.axis_table import (
    COORDINATE,
    SIGN,
)
from hydrotele.teleop.master import TIP_FORCE, TIP_POSITION, MasterParameters

_GRAVITY = 9.81
_FULL_ACTION_RANGE = 0.1  # range of the tipping ratio, above the allowed one, over which the spring builds up


def tipping_ratio(tip_over: TipOver, radius: float, force: float) -> float:
    """Return how close a vertical tip force brings the machine to tipping over.

    It is the ratio of the moment of the force to that of the machine's weight about the same edge.

    Args:
        tip_over: tip-over parameters of the machine.
        radius: distance of the tip from the swing axis [m].
        force: force of the environment on the tip, positive up [N].

    Returns:
        Ratio [1]; the machine tips at 1: backwards about its rear edge if pushed up, forwards about
        the front edge if pulled down.

    >>> machine = TipOver(mass=20000.0, centre_of_mass_behind=0.4, tipping_edge=1.6)
    >>> round(tipping_ratio(machine, 6.4, 29430.0), 3)
    1.0
    """
    weight = tip_over.mass * _GRAVITY
    if force > 0.0:
        return (
            force
            * (radius + tip_over.tipping_edge)
            / (weight * (tip_over.tipping_edge - tip_over.centre_of_mass_behind))
        )
    return (
        -force
        * max(radius - tip_over.tipping_edge, 0.0)
        / (weight * (tip_over.tipping_edge + tip_over.centre_of_mass_behind))
    )


def compute_tip_over_protection(
    tip_over: TipOver, numbers: MasterParameters, packet: np.ndarray, start: np.ndarray, handle: np.ndarray,
    speed: np.ndarray, extra: np.ndarray,
) -> None:  # fmt: skip
    """Compute a force on the handle's vertical axis that keeps the machine from tipping.

    The force is that of an additional spring and damper to the centre. It builds up while the
    tipping ratio rises from `moment_fraction` to 0.1 above. It acts only while the handle is
    deflected in the direction that increases the tipping moment. It moves the handle towards its
    dead band and never commands a motion.

    Args:
        tip_over: tip-over parameters of the machine.
        numbers: parameters of the master.
        packet: (8, k) data from the machine, rows as in `compute_reflected_forces`.
        start: (5,) pose of the tip at the start: r [m], theta [rad], z [m], attitude, head [rad].
        handle: (6,) measured displacement of the handle [m], [rad].
        speed: (6,) rate of the handle's displacement [m/s], [rad/s].
        extra: (6,) additional force on the handle, written [N], [N m]; 0 without danger.

    Source: Zhu 1994, chapter 6 (tip-over of an excavator that presses too hard).
    """
    extra[:] = 0.0
    force, radius = float(packet[TIP_FORCE, 2]), float(packet[TIP_POSITION, 0] + start[0])
    danger = min(1.0, (tipping_ratio(tip_over, radius, force) - tip_over.moment_fraction) / _FULL_ACTION_RANGE)
    if not danger > 0.0:
        return
    for axis in range(6):
        row = numbers.axis[axis]
        worse = -math.copysign(1.0, force) * row[SIGN]  # this direction increases the tip force
        if row[COORDINATE] == 2.0 and worse * handle[axis] > 0.0:
            push = tip_over.stiffness * handle[axis] + tip_over.damping * speed[axis]
            extra[axis] = -danger * push
