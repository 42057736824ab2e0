"""Tip-over protection: a machine about to tip pushes the hand back into the dead band."""

import math

import numpy as np

from hydrotele.scenario.teleoperation import TipOver
from hydrotele.teleop.axis_table import COORDINATE, SIGN
from hydrotele.teleop.master import FORCE, PLACE, Master

_GRAVITY = 9.81
_FULL = 0.1  # of the tipping moment, beyond the allowed share, over which the spring builds up


def tipping_share(facts: TipOver, radius: float, force: float) -> float:
    """Share of the tipping moment that a vertical force at the tip makes up.

    Args:
        facts: of the machine.
        radius: of the tip from the swing axis [m].
        force: of the environment on the tip, positive up [N].

    Returns:
        1 where the machine tips: backwards about its rear edge if pushed up, forwards about the
        front one if pulled down.

    >>> machine = TipOver(mass=20000.0, behind=0.4, edge=1.6)
    >>> round(tipping_share(machine, 6.4, 29430.0), 3)
    1.0
    """
    weight = facts.mass * _GRAVITY
    if force > 0.0:
        return force * (radius + facts.edge) / (weight * (facts.edge - facts.behind))
    return -force * max(radius - facts.edge, 0.0) / (weight * (facts.edge + facts.behind))


def push_back(
    facts: TipOver, numbers: Master, packet: np.ndarray, start: np.ndarray, handle: np.ndarray,
    speed: np.ndarray, extra: np.ndarray,
) -> None:  # fmt: skip
    """Force on the handle's vertical axis that keeps the machine from tipping.

    A further spring to the centre, with a damper that 200 Hz needs to hold it, on the side that
    would make it worse: the hand is back inside the dead band, and no motion is ever commanded.

    Args:
        facts: of the machine.
        numbers: of the master.
        packet: (7, k) what came from the machine.
        start: (5,) pose at the start.
        handle: (6,) measured displacement [m], [rad].
        speed: (6,) its rate [m/s], [rad/s].
        extra: (6,) written [N], [N m].

    Source: Zhu 1994, chapter 6 (tip-over of an excavator that presses too hard).
    """
    extra[:] = 0.0
    force, radius = float(packet[FORCE, 2]), float(packet[PLACE, 0] + start[0])
    danger = min(1.0, (tipping_share(facts, radius, force) - facts.share) / _FULL)
    if not danger > 0.0:
        return
    for axis in range(6):
        row = numbers.axis[axis]
        worse = -math.copysign(1.0, force) * row[SIGN]  # pressing on makes what pushes up larger
        if row[COORDINATE] == 2.0 and worse * handle[axis] > 0.0:
            push = facts.stiffness * handle[axis] + facts.damping * speed[axis]
            extra[axis] = -danger * push
