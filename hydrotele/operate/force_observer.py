"""Observer of the forces on a machine from outside: its model runs along and is pulled to it.

The model, moved by the measured pressures, is drawn to the measured positions; what must be added
to its forces for that is the force from outside. To inertia it answers as a filter of third order
would, but friction is that of the model's own velocity, which is neither late nor as noisy as a
differentiated angle.
"""

import math

import numpy as np

from hydrotele.compiled import lean
from hydrotele.dynamics.integrate import accelerate, place
from hydrotele.dynamics.linear import solve

_POLES = np.array([-1.0, -0.5 + 0.5j * math.sqrt(3.0), -0.5 - 0.5j * math.sqrt(3.0)])


def observer_gains(bandwidth: float, period: float) -> np.ndarray:
    """Gains of position, rate and force from outside on the deviation of a reading.

    Places the poles of the error, a chain of three integrators, at Butterworth's of third order.

    Args:
        bandwidth: of the force from outside, scalar [Hz], > 0.
        period: time between two readings, scalar [s], > 0.

    Returns:
        (3,) [1], [1/s], [1/s^2].

    Source: Ackermann's formula; Franklin, Powell and Workman 1998, Digital control, 8.2.4 (current
    estimator).

    >>> observer_gains(1.0, 1e-6) / [2e-6, 2e-6, 1e-6]  # 2 w T, 2 w^2 T, w^3 T
    array([  6.28314...,  39.4782..., 248.048...])
    """
    t, w = period, 2.0 * math.pi * bandwidth
    chain = np.array([[1.0, t, 0.5 * t * t], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    wanted = np.poly(np.exp(w * t * _POLES)).real
    value = wanted[0] * chain @ chain @ chain + wanted[1] * chain @ chain
    value += wanted[2] * chain + wanted[3] * np.eye(3)
    seen = np.array([[1.0, 0.0, 0.0], chain[0], (chain @ chain)[0]])
    ahead = value @ np.linalg.solve(seen, [0.0, 0.0, 1.0])
    return np.linalg.solve(chain, ahead)


@lean
def observe(arm, gains, period, outside):
    """Move the model on by one period of the sensors and correct it by the positions read.

    Args:
        arm: Arm; z is the state: positions, rates and the pressures that acted over the period;
            read has the positions.
        gains: (3,) of `observer_gains`.
        period: T, scalar [s].
        outside: (n,) forces from outside, updated [N m] or [N].

    Returns:
        Nothing.

    Source: disturbance observer; drift, kick, drift with the friction linearly implicit.
    """
    model, sp, z = arm.model, arm.space, arm.z
    n, m = len(outside), sp.motion
    for f in range(n):
        z[f] += 0.5 * period * z[n + f]
    place(model, sp, z)
    accelerate(model, sp, z, period)
    for f in range(n):
        arm.work[f] = outside[f]
    solve(sp.mass, arm.work)
    for f in range(n):
        z[n + f] += period * (sp.force[f] + arm.work[f])
        z[f] += 0.5 * period * z[n + f]
    for f in range(n):
        arm.work[f] = arm.read[f] - z[f]
        z[f] += gains[0] * arm.work[f]
        z[n + f] += gains[1] * arm.work[f]
    for j in range(m.joint.shape[1]):
        pull = 0.0
        for k in range(m.joint.shape[1]):
            way = 0.0
            for f in range(n):
                way += m.basis[k, f] * arm.work[f]
            pull += m.mass[j, k] * way
        for f in range(n):
            outside[f] += gains[2] * m.basis[j, f] * pull
