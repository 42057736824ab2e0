"""Forces of an actuator: its friction, the ends of its travel, and an axis with a pump of its own.

Actuator numbers stand at `user[u + Slot]`, those of a pump drive at `user[u + PUMP + PumpSlot]`.
"""

from hydrotele.core.compiled import inlined, lean
from hydrotele.hydraulics.laws import friction, friction_slope, stop_force
from hydrotele.hydraulics.pump import load_force, pump_piston_friction, pump_pressure_rates
from hydrotele.hydraulics.slots import PUMP, Kind, Slot

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_VH, _VR = int(Slot.VOLUME_HEAD), int(Slot.VOLUME_ROD)
_STROKE, _LEAK = int(Slot.STROKE), int(Slot.LEAKAGE)
_FC, _FS = int(Slot.COULOMB), int(Slot.STRIBECK)
_VS, _B = int(Slot.STRIBECK_VELOCITY), int(Slot.VISCOUS)
_V0, _AC = int(Slot.COULOMB_VELOCITY), int(Slot.COULOMB_ASYMMETRY)
_AV, _KIND = int(Slot.VISCOUS_ASYMMETRY), int(Slot.KIND)
_LOW, _HIGH = int(Slot.STOP_LOW), int(Slot.STOP_HIGH)
_HARD, _SOFT = int(Slot.STOP_STIFFNESS), int(Slot.STOP_DAMPING)
_PUMPED = float(Kind.PUMPED)


@inlined
def actuator_friction(user, u, velocity):
    """Friction of one actuator at a velocity.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        Friction force, scalar [N] or [N m], with the sign of the velocity.

    Source: nominal model, "Piston force".
    """
    return friction(
        velocity,
        user[u + _FC],
        user[u + _FS],
        user[u + _VS],
        user[u + _B],
        user[u + _V0],
        user[u + _AC],
        user[u + _AV],
    )


@lean
def actuator_friction_slope(user, u, velocity):
    """Slope of `actuator_friction` with respect to the velocity.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        velocity: scalar [m/s] or [rad/s].

    Returns:
        dF_f/dv, scalar [N s/m] or [N m s/rad].

    Source: derivative of the nominal model's "Piston force".
    """
    return friction_slope(
        velocity, user[u + _FC], user[u + _FS], user[u + _VS], user[u + _B], user[u + _V0],
        user[u + _AC], user[u + _AV],
    )  # fmt: skip


@lean
def actuator_stop(user, u, position, velocity):
    """Force of the ends of an actuator's travel, and its slopes.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        position: of the load side, scalar [m] or [rad].
        velocity: of the load side, scalar [m/s] or [rad/s].

    Returns:
        (force towards the inside [N] or [N m], its stiffness [N/m] or [N m/rad], its damping
        [N s/m] or [N m s/rad]); all 0 inside.

    Source: `laws.stop_force`.
    """
    if user[u + _HARD] == 0.0:
        return 0.0, 0.0, 0.0
    return stop_force(
        position, velocity, user[u + _LOW], user[u + _HIGH], user[u + _HARD], user[u + _SOFT]
    )


@lean
def pumped_volumes(user, u, x):
    """Volumes of both chambers and the oil that the piston has taken from the accumulator.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        x: piston displacement, scalar [m].

    Returns:
        (V_A, V_B, oil taken since the piston stood retracted) [m^3].

    Source: geometry of the cylinder.
    """
    inside = min(max(x, 0.0), user[u + _STROKE])
    area_head, area_rod = user[u + _AH], user[u + _AR]
    return (
        user[u + _VH] + area_head * inside,
        user[u + _VR] + area_rod * (user[u + _STROKE] - inside),
        (area_head - area_rod) * inside,
    )


@lean
def pumped_rates(user, u, speed, p_head, p_rod, x, v, added):
    """`circuit.pressure_rates` of an axis with a pump of its own.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        speed: of its pump, signed, scalar [rad/s].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        x: piston displacement, scalar [m].
        v: piston velocity, scalar [m/s].
        added: as of `pump.pump_pressure_rates` [m^3/s], [m^3/(s Pa)].

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]).

    Source: `pump.pump_pressure_rates`.
    """
    volumes, area_head, area_rod = pumped_volumes(user, u, x), user[u + _AH], user[u + _AR]
    return pump_pressure_rates(
        user, u + PUMP, speed, p_head, p_rod, volumes, (area_head * v, area_rod * v),
        user[u + _LEAK], added,
    )  # fmt: skip


@lean
def pumped_force(user, u, p_load, p_head, p_rod, v, other, dt):
    """Force of an axis with a pump of its own, after its load cylinder and friction.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        p_load: pressure in the load cylinder, scalar [Pa].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        v: piston velocity, scalar [m/s].
        other: what else acts on the piston, scalar [N].
        dt: step over which friction acts, scalar [s]; see `pump_piston_friction`.

    Returns:
        Force, scalar [N].

    Source: nominal model, "Piston force", with the friction of `pump_piston_friction`.
    """
    force = user[u + _AH] * p_head - user[u + _AR] * p_rod - load_force(user, u + PUMP, p_load)
    seal = (
        user[u + _FC], user[u + _FS], user[u + _VS], user[u + _B], user[u + _AC], user[u + _AV],
    )  # fmt: skip
    return force - pump_piston_friction(user, u + PUMP, seal, v, force + other, p_load, dt)


@lean
def force_after_friction(user, u, push, other, act, velocity, dt):
    """Force of an actuator after its friction, and the damping that this adds to an implicit step.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this actuator in `user`.
        push: force before friction, scalar [N] or [N m]; not read with a pump of its own.
        other: what else acts on the drive, which friction resists, too, where it holds, as that of
            a pump drive does, scalar [N] or [N m]; it is not in the result.
        act: activations from those of this actuator on; read only with a pump of its own.
        velocity: of the drive, scalar [m/s] or [rad/s].
        dt: step over which friction acts, scalar [s].

    Returns:
        (force [N] or [N m], dF_f/dv [N s/m] or [N m s/rad]); the friction of a pump drive is that
        at the end of the step already, and has no slope to add.

    Source: nominal model, "Piston force".
    """
    if user[u + _KIND] == _PUMPED:
        return pumped_force(user, u, act[1], act[2], act[3], velocity, other, dt), 0.0
    slope = actuator_friction_slope(user, u, velocity)
    return push - actuator_friction(user, u, velocity), slope
