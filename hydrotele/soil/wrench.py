"""Soil and load on a bucket as the wrench about its centre of mass that MuJoCo's bodies take."""

import math

from hydrotele.core.compiled import lean
from hydrotele.soil.facts import FORCE_R, FORCE_Z, GRAVITY, MASS, MASS_R, MOMENT


@lean
def bucket_wrench(out, edge, theta, centre, wrench):
    """Force and torque of the soil and of the weight that is carried on the bucket's body.

    Args:
        out: (OUT,) of `soil_step` [N], [N m], [kg], [m].
        edge: (3,) place of the edge in the world [m].
        theta: azimuth of the edge seen from the swing axis, scalar [rad].
        centre: (3,) centre of mass of the bucket's body, `xipos` [m].
        wrench: (6,) written: force and torque in the world, `xfrc_applied` [N], [N m].

    Returns:
        Nothing.

    Source: statics; the inertia of what is carried is left out.
    """
    c, s = math.cos(theta), math.sin(theta)
    weight = GRAVITY * out[MASS]
    fx, fy, fz = c * out[FORCE_R], s * out[FORCE_R], out[FORCE_Z]
    x, y, z = edge[0] - centre[0], edge[1] - centre[1], edge[2] - centre[2]
    load_x, load_y = x + c * out[MASS_R], y + s * out[MASS_R]
    wrench[0], wrench[1], wrench[2] = fx, fy, fz - weight
    wrench[3] = y * fz - z * fy - load_y * weight + s * out[MOMENT]
    wrench[4] = z * fx - x * fz + load_x * weight - c * out[MOMENT]
    wrench[5] = x * fy - y * fx
