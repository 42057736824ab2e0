"""Forces of an actuator: friction, presliding friction, end stops, and an axis with its own pump.

The parameters of an actuator are at `user[u + Slot]`, and those of its pump at
`user[u + PUMP_OFFSET + PumpSlot]`, where u is the index of the actuator's first parameter.

Presliding friction is the bristle model of Canudas de Wit et al. (LuGre):
`F = sigma_0 z + sigma_1 z'` with the deflection rate `z' = v - sigma_0 |v| z / g(v)` and the
sliding friction g of Coulomb and Stribeck. Without Stribeck friction and bristle damping it is
Dahl's model. In steady sliding it equals `laws.friction_force` without the smoothing of the sign. The
state of a drive is the fraction of its breakaway force that the bristles carry,
`r = sigma_0 z / (F_c + F_s)` [1] with Coulomb friction F_c and Stribeck friction F_s. It is of
order one in any machine.

The bristle stiffness is limited so that an explicit step can resolve the resulting vibration.

Source: Canudas de Wit, Olsson, Astrom and Lischinsky 1995, "A new model for control of systems with
friction", IEEE Trans. Automatic Control 40(3), Eqs 1-4; Dahl 1968, Aerospace Corp. TOR-0158(3107).
"""

import math

from hydrotele.core.compiled import compile_inlined, compile_without_allocation
from hydrotele.hydraulics.actuator_layout import PUMP_OFFSET, ActuatorKind, Slot
from hydrotele.hydraulics.laws import end_stop_force, friction_force, friction_slope
from hydrotele.hydraulics.pump_drive import load_cylinder_force, pump_piston_friction, pump_pressure_rates

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_VH, _VR = int(Slot.VOLUME_HEAD), int(Slot.VOLUME_ROD)
_STROKE, _LEAK = int(Slot.STROKE), int(Slot.LEAKAGE)
_FC, _FS = int(Slot.COULOMB), int(Slot.STRIBECK)
_VS, _B = int(Slot.STRIBECK_VELOCITY), int(Slot.VISCOUS)
_V0, _AC = int(Slot.COULOMB_VELOCITY), int(Slot.COULOMB_ASYMMETRY)
_AV, _KIND = int(Slot.VISCOUS_ASYMMETRY), int(Slot.KIND)
_STOP_LOW, _STOP_HIGH = int(Slot.STOP_LOW), int(Slot.STOP_HIGH)
_STOP_STIFFNESS, _STOP_DAMPING = int(Slot.STOP_STIFFNESS), int(Slot.STOP_DAMPING)
_PUMPED = float(ActuatorKind.PUMP_DRIVE)


@compile_inlined
def actuator_friction(user, u, velocity):
    """Return the Coulomb, Stribeck and viscous friction force of an actuator at a velocity.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        Friction force, scalar [N] or [N m], with the sign of the velocity.

    Source: models/cat215/README.md, "Force"; formula of `laws.friction_force`.
    """
    return friction_force(
        velocity,
        user[u + _FC],
        user[u + _FS],
        user[u + _VS],
        user[u + _B],
        user[u + _V0],
        user[u + _AC],
        user[u + _AV],
    )


@compile_without_allocation
def actuator_friction_slope(user, u, velocity):
    """Return the derivative of an actuator's friction force with respect to its velocity.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        dF_f/dv, scalar [N s/m] or [N m s/rad].

    Source: derivative of "Force" in models/cat215/README.md.
    """
    return friction_slope(
        velocity, user[u + _FC], user[u + _FS], user[u + _VS], user[u + _B], user[u + _V0],
        user[u + _AC], user[u + _AV],
    )  # fmt: skip


@compile_without_allocation
def actuator_end_stop_force(user, u, position, velocity):
    """Return the force, stiffness and damping of an actuator's end stop at a position.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        position: position of the load side, scalar [m] or [rad].
        velocity: velocity of the load side, scalar [m/s] or [rad/s].

    Returns:
        (force, which points towards the inside of the travel [N] or [N m], its stiffness [N/m] or
        [N m/rad], its damping [N s/m] or [N m s/rad]); all 0 between the stops.

    Source: `laws.end_stop_force`.
    """
    if user[u + _STOP_STIFFNESS] == 0.0:
        return 0.0, 0.0, 0.0
    return end_stop_force(
        position,
        velocity,
        user[u + _STOP_LOW],
        user[u + _STOP_HIGH],
        user[u + _STOP_STIFFNESS],
        user[u + _STOP_DAMPING],
    )


@compile_without_allocation
def pump_drive_volumes(user, u, x):
    """Return, for an axis with its own pump, both chamber volumes and the oil taken from the accumulator.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        x: piston displacement, scalar [m].

    Returns:
        (head-side volume, rod-side volume, oil volume that the accumulator has given off since the
        piston was fully retracted) [m^3].

    Source: geometry of the cylinder.
    """
    inside = min(max(x, 0.0), user[u + _STROKE])
    area_head, area_rod = user[u + _AH], user[u + _AR]
    return (
        user[u + _VH] + area_head * inside,
        user[u + _VR] + area_rod * (user[u + _STROKE] - inside),
        (area_head - area_rod) * inside,
    )


@compile_without_allocation
def pump_drive_pressure_rates(user, u, speed, p_head, p_rod, x, v, added):
    """Compute the pressure rates of both chambers of an axis with its own pump, and derivatives.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this axis in `user`.
        speed: speed of its pump, positive if it feeds the head side, scalar [rad/s].
        p_head: head-side pressure, scalar [Pa].
        p_rod: rod-side pressure, scalar [Pa].
        x: piston displacement, scalar [m].
        v: piston velocity, scalar [m/s].
        added: (4,) flows that terms add to the head and the rod side [m^3/s], and their slopes with
            respect to the pressures [m^3/(s Pa)].

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]), where ' is d/dt.

    Source: `pump_drive.pump_pressure_rates`.
    """
    volumes, area_head, area_rod = pump_drive_volumes(user, u, x), user[u + _AH], user[u + _AR]
    return pump_pressure_rates(
        user, u + PUMP_OFFSET, speed, p_head, p_rod, volumes, (area_head * v, area_rod * v),
        user[u + _LEAK], added,
    )  # fmt: skip


@compile_without_allocation
def pump_drive_force(user, u, p_load, p_head, p_rod, v, other_force, dt):
    """Return the net force of an axis with its own pump, after load cylinder and friction.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        p_load: pressure in the load cylinder, scalar [Pa].
        p_head: head-side pressure, scalar [Pa].
        p_rod: rod-side pressure, scalar [Pa].
        v: piston velocity, scalar [m/s].
        other_force: all other force on the piston, scalar [N]; it is not part of the result, but
            static friction resists it.
        dt: time step over which the friction acts, scalar [s]; 0 for the friction at velocity v.

    Returns:
        Force, scalar [N].

    Source: models/cat215/README.md, "Force", with the friction of `pump_piston_friction`.
    """
    force = user[u + _AH] * p_head - user[u + _AR] * p_rod - load_cylinder_force(user, u + PUMP_OFFSET, p_load)
    seal = (
        user[u + _FC], user[u + _FS], user[u + _VS], user[u + _B], user[u + _AC], user[u + _AV],
    )  # fmt: skip
    return force - pump_piston_friction(user, u + PUMP_OFFSET, seal, v, force + other_force, p_load, dt)


@compile_without_allocation
def force_after_friction(user, u, drive_force, other_force, act, velocity, dt):
    """Return the force of an actuator minus its friction, and the friction's derivative by velocity.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        drive_force: force before friction, scalar [N] or [N m]; not used for an axis with its own
            pump.
        other_force: all other force on the drive, scalar [N] or [N m]. It is not part of the
            result; the static friction of an axis with its own pump resists it.
        act: activations, of which the first is that of this actuator: pump speed [rad/s], load
            pressure, head-side and rod-side pressure [Pa]. Used only for an axis with its own pump.
        velocity: velocity of the drive, scalar [m/s] or [rad/s].
        dt: time step of the friction, scalar [s].

    Returns:
        (force [N] or [N m], derivative dF_f/dv of the friction [N s/m] or [N m s/rad]). For an axis
        with its own pump the friction is that at the end of the step, and the derivative is 0.

    Source: models/cat215/README.md, "Force".
    """
    if user[u + _KIND] == _PUMPED:
        return pump_drive_force(user, u, act[1], act[2], act[3], velocity, other_force, dt), 0.0
    slope = actuator_friction_slope(user, u, velocity)
    return drive_force - actuator_friction(user, u, velocity), slope


_BRISTLE_STIFFNESS, _BRISTLE_DAMPING = int(Slot.BRISTLE_STIFFNESS), int(Slot.BRISTLE_DAMPING)

_MAX_PHASE_SQUARED = 0.5  # largest (w dt)^2 of a drive on its bristles; the stability limit is 4


@compile_without_allocation
def sliding_friction(velocity, coulomb, stribeck, stribeck_velocity, asymmetry):
    """Return the dry (Coulomb and Stribeck) friction of a sliding drive, with a discontinuous sign.

    `g = (F_c + F_s exp(-(v/v_s)^2)) s (1 + a s)` with `s = sgn v`.

    Args:
        velocity: v, scalar [m/s] or [rad/s].
        coulomb: F_c, scalar [N] or [N m].
        stribeck: F_s, scalar [N] or [N m].
        stribeck_velocity: v_s, scalar [m/s] or [rad/s], > 0.
        asymmetry: a, scalar [1], -1 < a < 1.

    Returns:
        g, scalar [N] or [N m], with the sign of the velocity; positive at rest.

    Source: models/cat215/README.md, "Force".

    >>> sliding_friction(-1.0, 3000.0, 1500.0, 0.02, 0.0)
    -3000.0
    """
    ratio = velocity / stribeck_velocity
    sign = -1.0 if velocity < 0.0 else 1.0
    return (coulomb + stribeck * math.exp(-ratio * ratio)) * (sign + asymmetry)


@compile_without_allocation
def advance_bristle_force(force, velocity, sliding_friction_force, stiffness, dt):
    """Return the elastic bristle force (presliding friction) after a duration at constant velocity.

    The exact solution is `F' = g + (F - g) exp(-sigma_0 |v| dt / |g|)`.

    Args:
        force: F, elastic bristle force at the start, scalar [N] or [N m].
        velocity: v, scalar [m/s] or [rad/s].
        sliding_friction_force: g, friction in steady sliding (`sliding_friction`), scalar [N] or
            [N m].
        stiffness: sigma_0, scalar [N/m] or [N m/rad].
        dt: duration, scalar [s].

    Returns:
        F', elastic bristle force at the end, scalar [N] or [N m].

    Source: Canudas de Wit et al. 1995, Eq. 1, solved for constant velocity.

    >>> round(advance_bristle_force(0.0, 1.0e-3, 1.0e9, 1.0e8, 1.0e-3), 3)
    100.0
    >>> advance_bristle_force(0.0, -1.0, -5.0, 1.0e9, 1.0)
    -5.0
    """
    if velocity == 0.0:
        return force
    if sliding_friction_force == 0.0:
        return 0.0
    return sliding_friction_force + (force - sliding_friction_force) * math.exp(
        -stiffness * abs(velocity) * dt / abs(sliding_friction_force)
    )


@compile_without_allocation
def _actuator_sliding_friction(user, u, velocity):
    """Return the dry friction of a sliding actuator (`sliding_friction`) from its parameters in `user`.

    u is the index of the actuator's first parameter in `user`.
    """
    return sliding_friction(velocity, user[u + _FC], user[u + _FS], user[u + _VS], user[u + _AC])


@compile_without_allocation
def _limited_bristle_stiffness(user, u, inertia, dt):
    """Return the bristle stiffness of an actuator, limited for a stable explicit step [N/m] or [N m/rad].

    The limit is 0.5 inertia / dt^2, with the inertia that the drive moves and the time step dt. An
    inertia or time step of 0 means no limit.
    """
    stiffness = user[u + _BRISTLE_STIFFNESS]
    if inertia > 0.0 and dt > 0.0:
        stiffness = min(stiffness, _MAX_PHASE_SQUARED * inertia / (dt * dt))
    return stiffness


@compile_without_allocation
def bristle_rate(user, u, fraction, velocity, inertia, dt):
    """Return the mean rate, over a time step, of the bristle state of an actuator (presliding friction).

    The state r is the elastic bristle force divided by the breakaway force.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        fraction: r at the start of the step, scalar [1].
        velocity: velocity of the drive over the step, scalar [m/s] or [rad/s].
        inertia: inertia J moved by the drive, scalar [kg] or [kg m^2]. The bristle stiffness is
            limited to 0.5 J / dt^2; 0 means no limit.
        dt: time step, scalar [s].

    Returns:
        Rate, scalar [1/s].

    Source: `advance_bristle_force`.
    """
    breakaway = user[u + _FC] + user[u + _FS]
    level, stiffness = (
        _actuator_sliding_friction(user, u, velocity),
        _limited_bristle_stiffness(user, u, inertia, dt),
    )
    after = advance_bristle_force(fraction * breakaway, velocity, level, stiffness, dt) / breakaway
    return (after - fraction) / dt


@compile_without_allocation
def bristle_friction(user, u, fraction, velocity, inertia, dt):
    """Return the friction of an actuator with presliding (bristle) friction, and its derivatives.

    `F = r (F_c + F_s) + sigma_1 z' + b v (1 + a_v t)` with the breakaway force F_c + F_s, bristle
    damping sigma_1, bristle deflection z, viscous friction b, its asymmetry a_v and
    `t = tanh(v/v_0)`.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        fraction: r, elastic bristle force relative to the breakaway friction, scalar [1].
        velocity: v, scalar [m/s] or [rad/s].
        inertia: inertia J moved by the drive, scalar [kg] or [kg m^2]. The bristle stiffness is
            limited to 0.5 J / dt^2 and the bristle damping to 0.5 J / dt; 0 means no limit.
        dt: time step, scalar [s]; 0 means no limit of stiffness and damping.

    Returns:
        (F [N] or [N m], dF/dv [N s/m] or [N m s/rad], dF/dx through the bristles [N/m] or
        [N m/rad]).

    Source: Canudas de Wit et al. 1995, Eqs 1-4.
    """
    bent = 1.0  # d (deflection) / d (travel), 0 in steady sliding
    if velocity != 0.0:
        level = _actuator_sliding_friction(user, u, velocity)
        bent = 1.0 - fraction * (user[u + _FC] + user[u + _FS]) / level if level != 0.0 else 0.0
    damping = user[u + _BRISTLE_DAMPING]
    if inertia > 0.0 and dt > 0.0:
        damping = min(damping, _MAX_PHASE_SQUARED * inertia / dt)
    viscous, asymmetry = user[u + _B], user[u + _AV]
    force = fraction * (user[u + _FC] + user[u + _FS]) + damping * bent * velocity
    force += friction_force(velocity, 0.0, 0.0, 1.0, viscous, user[u + _V0], 0.0, asymmetry)
    slope = friction_slope(velocity, 0.0, 0.0, 1.0, viscous, user[u + _V0], 0.0, asymmetry)
    bent = max(0.0, bent)
    return force, damping * bent + slope, _limited_bristle_stiffness(user, u, inertia, dt) * bent


@compile_without_allocation
def implicit_bristle_friction(user, u, fraction, velocity, other_force, inertia, dt):
    """Return the presliding (bristle) friction on a body at the end of an implicit time step.

    Only this friction, taken at the new velocity, and `other_force` act on the body.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        u: index of the first parameter of this actuator in `user`.
        fraction: r, elastic bristle force relative to the breakaway friction, scalar [1].
        velocity: at the start of the step, scalar [m/s] or [rad/s].
        other_force: all other force, scalar [N] or [N m].
        inertia: inertia of the body, scalar [kg] or [kg m^2], > 0.
        dt: time step, scalar [s], > 0.

    Returns:
        F, friction at the end of the step, scalar [N] or [N m].

    Source: linearly implicit Euler rule.
    """
    force, slope, _ = bristle_friction(user, u, fraction, velocity, inertia, dt)
    part = slope * dt / inertia
    return (force + part * other_force) / (1.0 + part)
