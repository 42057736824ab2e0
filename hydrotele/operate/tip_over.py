"""Tip-over protection: a machine about to tip pushes the hand back into the dead band."""

import numpy as np

from hydrotele.operate.master import COORDINATE, DEADBAND, FORCE, PLACE, SIGN, Master
from hydrotele.teleoperation import TipOver

_GRAVITY = 9.81
_SOFT = 5e-4  # m beyond the dead band in which the push builds up: a wall that does not chatter
_PUSH = 40.0  # N at full tipping moment: more than a hand wants to hold against


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
    extra: np.ndarray,
) -> None:  # fmt: skip
    """Force on the handle's vertical axis that keeps the machine from tipping.

    It acts only on a handle beyond its dead band in the direction that would make it worse, so that
    it never commands a motion by itself.

    Args:
        facts: of the machine.
        numbers: of the master.
        packet: (7, k) what came from the machine.
        start: (5,) pose at the start.
        handle: (6,) measured displacement [m], [rad].
        extra: (6,) written [N], [N m].

    Source: Zhu 1994, chapter 6 (tip-over of an excavator that presses too hard).
    """
    extra[:] = 0.0
    force, radius = float(packet[FORCE, 2]), float(packet[PLACE, 0] + start[0])
    share = tipping_share(facts, radius, force)
    if not share > facts.share:
        return
    for axis in range(6):
        row = numbers.axis[axis]
        if row[COORDINATE] != 2.0:
            continue
        worse = -np.sign(force) * row[SIGN]  # pressing on makes the force that pushes up larger
        beyond = worse * handle[axis] - row[DEADBAND]
        if beyond > 0.0:
            size = _PUSH * min(1.0, (share - facts.share) / (1.0 - facts.share) + 0.3)
            extra[axis] = -worse * size * min(1.0, beyond / _SOFT)
