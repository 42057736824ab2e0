"""Presliding friction: bristles that bend like a spring until the drive breaks away.

The bristle model of Canudas de Wit et al. (LuGre): `F = sigma_0 z + sigma_1 z'` with the deflection
`z' = v - sigma_0 |v| z / g(v)` and the sliding level g of Coulomb and Stribeck friction. Without
Stribeck friction and damping it is Dahl's; sliding steadily it is `laws.friction`, without its
smoothing of the sign. The state of a drive is the bristles' share of its breakaway force,
`r = sigma_0 z / (F_c + F_s)` [1], which is of size one in any machine.

Bristles with which a drive would swing faster than a step can follow count as softer.

Source: Canudas de Wit, Olsson, Astrom and Lischinsky 1995, "A new model for control of systems with
friction", IEEE Trans. Automatic Control 40(3), Eqs 1-4; Dahl 1968, Aerospace Corp. TOR-0158(3107).
"""

import math

from hydrotele.core.compiled import lean
from hydrotele.hydraulics.laws import friction, friction_slope
from hydrotele.hydraulics.slots import Slot

_FC, _FS = int(Slot.COULOMB), int(Slot.STRIBECK)
_VS, _B = int(Slot.STRIBECK_VELOCITY), int(Slot.VISCOUS)
_V0, _AC = int(Slot.COULOMB_VELOCITY), int(Slot.COULOMB_ASYMMETRY)
_AV = int(Slot.VISCOUS_ASYMMETRY)
_STIFF, _DAMP = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE_DAMPING)

_RESOLVED = 0.5  # (w dt)^2 of a drive on its bristles; an explicit step is stable up to 4


@lean
def sliding_level(velocity, coulomb, stribeck, stribeck_velocity, asymmetry):
    """Dry friction of a drive that slides, without smoothing of its sign.

    `g = (F_c + F_s exp(-(v/v_s)^2)) s (1 + a s)` with `s = sgn v`.

    Args:
        velocity: v, scalar [m/s] or [rad/s].
        coulomb: F_c, scalar [N] or [N m].
        stribeck: F_s, scalar [N] or [N m].
        stribeck_velocity: v_s, scalar [m/s] or [rad/s], > 0.
        asymmetry: a, scalar [1], -1 < a < 1.

    Returns:
        g, scalar [N] or [N m], with the sign of the velocity; that of a positive one at rest.

    Source: nominal model, "Piston force".

    >>> sliding_level(-1.0, 3000.0, 1500.0, 0.02, 0.0)
    -3000.0
    """
    ratio = velocity / stribeck_velocity
    sign = -1.0 if velocity < 0.0 else 1.0
    return (coulomb + stribeck * math.exp(-ratio * ratio)) * (sign + asymmetry)


@lean
def bristle_step(force, velocity, level, stiffness, dt):
    """Force of the bristles after a time at a held velocity, by the exact exponential.

    `F' = g + (F - g) exp(-sigma_0 |v| dt / |g|)`.

    Args:
        force: F, scalar [N] or [N m].
        velocity: v, scalar [m/s] or [rad/s].
        level: g, as of `sliding_level`, scalar [N] or [N m].
        stiffness: sigma_0, scalar [N/m] or [N m/rad].
        dt: scalar [s].

    Returns:
        F', scalar [N] or [N m].

    Source: Canudas de Wit et al. 1995, Eq. 1, solved for a held velocity.

    >>> round(bristle_step(0.0, 1.0e-3, 1.0e9, 1.0e8, 1.0e-3), 3)
    100.0
    >>> bristle_step(0.0, -1.0, -5.0, 1.0e9, 1.0)
    -5.0
    """
    if velocity == 0.0:
        return force
    if level == 0.0:
        return 0.0
    return level + (force - level) * math.exp(-stiffness * abs(velocity) * dt / abs(level))


@lean
def _level(user, u, velocity):
    """`sliding_level` of an actuator."""
    return sliding_level(velocity, user[u + _FC], user[u + _FS], user[u + _VS], user[u + _AC])


@lean
def _followed(user, u, inertia, dt):
    """Stiffness of an actuator's bristles that a step can follow, see `bristle_rate`."""
    stiffness = user[u + _STIFF]
    if inertia > 0.0 and dt > 0.0:
        stiffness = min(stiffness, _RESOLVED * inertia / (dt * dt))
    return stiffness


@lean
def bristle_rate(user, u, share, velocity, inertia, dt):
    """Mean rate over a step of the bristles' share of the breakaway force.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        share: r at the start of the step, scalar [1].
        velocity: of the drive over the step, scalar [m/s] or [rad/s].
        inertia: that the drive moves, scalar [kg] or [kg m^2]; bristles stiffer than half of it
            over dt^2 count as that stiff. 0 limits nothing.
        dt: step, scalar [s].

    Returns:
        Rate, scalar [1/s].

    Source: `bristle_step`.
    """
    breakaway = user[u + _FC] + user[u + _FS]
    level, stiffness = _level(user, u, velocity), _followed(user, u, inertia, dt)
    after = bristle_step(share * breakaway, velocity, level, stiffness, dt) / breakaway
    return (after - share) / dt


@lean
def bristle_friction(user, u, share, velocity, inertia, dt):
    """Friction of a drive with bristles, and its slopes.

    `F = r (F_c + F_s) + sigma_1 z' + b v (1 + a_v t)`, the viscous part as of `laws.friction`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        share: r, scalar [1].
        velocity: v, scalar [m/s] or [rad/s].
        inertia: that the drive moves, as of `bristle_rate`.
        dt: step, scalar [s]; 0 limits nothing.

    Returns:
        (F [N] or [N m], dF/dv [N s/m] or [N m s/rad], dF/dx through the bristles [N/m] or
        [N m/rad]).

    Source: Canudas de Wit et al. 1995, Eqs 1-4.
    """
    bent = 1.0  # d (deflection) / d (way), 0 where it slides
    if velocity != 0.0:
        level = _level(user, u, velocity)
        bent = 1.0 - share * (user[u + _FC] + user[u + _FS]) / level if level != 0.0 else 0.0
    damping = user[u + _DAMP]
    if inertia > 0.0 and dt > 0.0:
        damping = min(damping, _RESOLVED * inertia / dt)
    viscous, asymmetry = user[u + _B], user[u + _AV]
    force = share * (user[u + _FC] + user[u + _FS]) + damping * bent * velocity
    force += friction(velocity, 0.0, 0.0, 1.0, viscous, user[u + _V0], 0.0, asymmetry)
    slope = friction_slope(velocity, 0.0, 0.0, 1.0, viscous, user[u + _V0], 0.0, asymmetry)
    bent = max(0.0, bent)
    return force, damping * bent + slope, _followed(user, u, inertia, dt) * bent


@lean
def settled_bristle_friction(user, u, share, velocity, push, inertia, dt):
    """`bristle_friction` at the end of a step of a body that nothing else holds.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        share: r, scalar [1].
        velocity: at the start of the step, scalar [m/s] or [rad/s].
        push: all other force, scalar [N] or [N m].
        inertia: of the body, scalar [kg] or [kg m^2], > 0.
        dt: step, scalar [s], > 0.

    Returns:
        F, scalar [N] or [N m].

    Source: linearly implicit Euler rule.
    """
    force, slope, _ = bristle_friction(user, u, share, velocity, inertia, dt)
    part = slope * dt / inertia
    return (force + part * push) / (1.0 + part)
