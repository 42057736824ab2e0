"""How much damping a sampled joystick can hold: the handle as a body, its springs in a computer.

The computer reads the handle once per period, takes the difference of two readings for its speed,
and holds the coils' force until the next reading. Between readings the body moves freely, under
the hand's own spring and damper if a hand is on it. The loop is linear, so its largest eigenvalue
tells whether it comes to rest; `Zhu 1994, Tables 6.7 and 6.9` give the springs and dampers.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from hydrotele.core.errors import InputError

_MOST = 1e6  # beyond it a damping or inertia counts as without bound
_FINE = 1e-9  # of the bisection, relative


class Body(NamedTuple):
    """What a handle is, in n coordinates, and what holds it without a computer.

    Attributes:
        mass: (n, n) [kg], [kg m], [kg m^2].
        stiffness: (n, n) of the hand [N/m], [N m/rad].
        damping: (n, n) of the hand [N s/m], [N m s/rad].
    """

    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


def tilting_body(
    mass: float, arm: float, inertia: float, hand: tuple[float, ...] = (0.0,) * 5
) -> Body:
    """A handle that shifts and tilts in a vertical plane, x and ry.

    Args:
        mass: of the flotor [kg].
        arm: its centre of mass above the handle's point, negative below [m].
        inertia: of the flotor about its centre of mass [kg m^2].
        hand: its mass on the handle's point [kg], damping [N s/m], stiffness [N/m], rotational
            damping [N m s/rad] and stiffness [N m/rad].

    Returns:
        The body, in displacement and turning of the handle's point.
    """
    m, b, k, rub, spring = hand
    own = np.array([[mass + m, mass * arm], [mass * arm, inertia + mass * arm * arm]])
    return Body(own, np.diag([k, spring]), np.diag([b, rub]))


def spinning_body(inertia: float, damping: float = 0.0, stiffness: float = 0.0) -> Body:
    """A handle that only turns, about its own axis.

    Args:
        inertia: [kg m^2].
        damping: of the hand [N m s/rad].
        stiffness: of the hand [N m/rad].

    Returns:
        The body.
    """
    return Body(np.array([[inertia]]), np.array([[stiffness]]), np.array([[damping]]))


def slowest_decay(body: Body, stiffness: np.ndarray, damping: np.ndarray, period: float) -> float:
    """Largest eigenvalue of one period of the sampled loop; below 1 the handle comes to rest.

    Args:
        body: handle and hand.
        stiffness: (n,) of the joystick's springs [N/m], [N m/rad].
        damping: (n,) of its dampers [N s/m], [N m s/rad].
        period: of the control [s].

    Returns:
        Magnitude of the largest eigenvalue [1].

    Raises:
        InputError: the body has no positive mass.

    Source: zero-order hold by the matrix exponential; speed as the difference of two readings.

    >>> held = slowest_decay(spinning_body(1.5e-3), np.array([6.0]), np.array([0.25]), 5e-3)
    >>> shaken = slowest_decay(spinning_body(1.5e-3), np.array([6.0]), np.array([3.0]), 5e-3)
    >>> held < 1.0 < shaken
    True
    """
    n = len(body.mass)
    if not (np.linalg.eigvalsh(body.mass) > 0.0).all():
        raise InputError("sampled handle", "its mass must be positive in every direction")
    inverse, none = np.linalg.inv(body.mass), np.zeros((n, n))
    free = np.block([[none, np.eye(n)], [-inverse @ body.stiffness, -inverse @ body.damping]])
    pushed = np.vstack([none, inverse])
    moved = expm(period * np.block([[free, pushed], [np.zeros((n, 3 * n))]]))
    spring, damper = np.diag(stiffness), np.diag(damping) / period
    law = np.hstack([-(spring + damper), none, damper])  # of place, speed and the place before
    loop = np.zeros((3 * n, 3 * n))
    loop[: 2 * n, : 2 * n], loop[2 * n :, :n] = moved[: 2 * n, : 2 * n], np.eye(n)
    loop[: 2 * n] += moved[: 2 * n, 2 * n :] @ law
    return float(np.abs(np.linalg.eigvals(loop)).max())


def largest_damping(inertia: float, stiffness: float, period: float) -> float:
    """Largest damping that a spinning handle holds.

    Args:
        inertia: [kg m^2].
        stiffness: of the joystick's spring [N m/rad].
        period: [s].

    Returns:
        [N m s/rad]; 0 if none holds this spring.

    Source: `slowest_decay`; without a spring it is 2 inertia / period.

    >>> round(largest_damping(1.5e-3, 0.0, 5e-3), 6)
    0.6
    """
    body = spinning_body(inertia)

    def holds(damping: float) -> bool:
        decay = slowest_decay(body, np.array([stiffness]), np.array([damping]), period)
        return decay < 1.0 + 1e-12

    tried = np.geomspace(1e-3, 1.0, 400) * 2.0 * inertia / period
    good = [d for d in tried if holds(d)]
    if not good:
        return 0.0
    low, high = good[-1], good[-1] * 1.05
    while high - low > _FINE * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(middle) else (low, middle)
    return float(low)


def least_inertia(damping: float, stiffness: float, period: float) -> float:
    """Least inertia with which a spinning handle holds a damping.

    Args:
        damping: [N m s/rad].
        stiffness: of the joystick's spring [N m/rad].
        period: [s].

    Returns:
        [kg m^2]; infinite if there is none below 1e6.

    Source: `slowest_decay`; without a spring it is damping period / 2.

    >>> round(least_inertia(3.0, 0.0, 5e-3), 6)
    0.0075
    """

    def holds(inertia: float) -> bool:
        body = spinning_body(inertia)
        decay = slowest_decay(body, np.array([stiffness]), np.array([damping]), period)
        return decay < 1.0 + 1e-12

    low = high = 0.5 * damping * period
    while not holds(high):
        low, high = high, 2.0 * high
        if high > _MOST:
            return float("inf")
    low = low if high > low else 0.5 * low
    while high - low > _FINE * high:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if holds(middle) else (middle, high)
    return float(high)
