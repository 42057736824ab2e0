"""Friction on a drive side so light that an explicit step would throw it through rest and back."""

from hydrotele.core.compiled import lean
from hydrotele.hydraulics.circuit import actuator_friction, actuator_friction_slope

_STEPS = 60  # bisections alone reach rounding in that many
_ROUNDING = 1.0e-13


@lean
def settled_friction(user, u, velocity, push, inertia, dt):
    """Friction at the end of a step of a body that nothing else holds.

    Solves `v' = v + dt / J (F - F_f(v'))` by Newton's method inside a bracket.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: v at the start of the step, scalar [m/s] or [rad/s].
        push: F, all other force, scalar [N] or [N m].
        inertia: J, scalar [kg] or [kg m^2], > 0.
        dt: step, scalar [s], > 0.

    Returns:
        F_f(v'), scalar [N] or [N m].

    Source: implicit Euler rule.
    """
    per_force = dt / inertia
    free = velocity + per_force * push  # friction pulls towards rest from here
    low, high = min(0.0, free), max(0.0, free)
    v = free
    for _ in range(_STEPS):
        resisting = actuator_friction(user, u, v)
        excess = v - free + per_force * resisting
        if excess > 0.0:
            high = v
        else:
            low = v
        if high - low <= _ROUNDING * abs(free):
            break
        slope = 1.0 + per_force * actuator_friction_slope(user, u, v)
        guess = v - excess / slope if slope > 0.0 else high
        if slope > 0.0 and abs(guess - v) <= _ROUNDING * abs(free):
            break
        v = guess if low < guess < high else 0.5 * (low + high)
    return actuator_friction(user, u, v)
