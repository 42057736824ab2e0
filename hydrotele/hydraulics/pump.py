"""A pump as drive: a motor turns a pump in one direction, a switched valve picks the side.

The pump draws from the other chamber, whose line also leads to a gas accumulator: it takes up what
the two sides of the piston differ by. The command is the duty of the motor's bridge with the sign
of the side, or, without a motor, the speed over the rated one. At command 0 the valve shuts both
chambers, and the pump stands. A load cylinder on the same joint may push against the drive: its
oil leaves over a relief valve, and on the way back the chamber draws without pressure.

Of an actuator's four activations the first is here the pump's speed [rad/s] with the sign of the
side, exactly 0 where the valve is shut (a stalled pump keeps `STALLED`), and the second the
pressure in the load cylinder [Pa]. The numbers stand in one block, placed as `PumpSlot` says. All
pressures are above the atmosphere's.
"""

import math

from hydrotele.core.compiled import allocation_free
from hydrotele.hydraulics.laws import ATMOSPHERE
from hydrotele.hydraulics.parameters import PumpSlot

STALLED = 1.0e-9  # rad/s, of a pump that stands while its valve is open
_THINNEST = 0.1 * ATMOSPHERE  # Pa absolute: below it the air is not let grow any further

_D, _LEAK, _RATED = PumpSlot.DISPLACEMENT.value, PumpSlot.LEAKAGE.value, PumpSlot.RATED_SPEED.value
_BETA, _GAS = PumpSlot.BULK_MODULUS.value, PumpSlot.GAS_VOLUME.value
_SOFT_HEAD, _SOFT_ROD = PumpSlot.COMPLIANCE_HEAD.value, PumpSlot.COMPLIANCE_ROD.value
_AIR_HEAD, _AIR_ROD = PumpSlot.AIR_HEAD.value, PumpSlot.AIR_ROD.value
_ACCUMULATOR = PumpSlot.ACCUMULATOR_PRESSURE.value
_LINE_OUT, _LINE_IN = PumpSlot.LINE_EXTENDING.value, PumpSlot.LINE_RETRACTING.value
_VOLTAGE, _OHM, _EMF = PumpSlot.VOLTAGE.value, PumpSlot.RESISTANCE.value, PumpSlot.EMF.value
_INERTIA, _DRAG = PumpSlot.INERTIA.value, PumpSlot.DRAG.value
_BREAK, _BREAK_SPEED = PumpSlot.BREAKAWAY.value, PumpSlot.BREAKAWAY_SPEED.value
_VISCOUS, _LOSS = PumpSlot.VISCOUS_DRAG.value, PumpSlot.TORQUE_LOSS.value
_MASS, _AREA = PumpSlot.MOVING_MASS.value, PumpSlot.LOAD_AREA.value
_TOP, _OVERRIDE = PumpSlot.LOAD_RELIEF.value, PumpSlot.LOAD_OVERRIDE.value
_STIFF, _VOID = PumpSlot.LOAD_STIFFNESS.value, PumpSlot.LOAD_VOID.value
_VOID_P = PumpSlot.LOAD_VOID_PRESSURE.value
_RUB, _RETURN = PumpSlot.LOAD_FRICTION.value, PumpSlot.LOAD_RETURN.value


@allocation_free
def pump_speed_step(user, p, speed, command, p_head, p_rod, dt):
    """Speed of the pump after a step, with the sign of the side that the valve picks.

    `J w' = k (u U - k w) / R - D dp (1 + l) - T_c - T_s exp(-(w/w_s)^2) - b w`, never backwards,
    with the current at rest (`L/R` is shorter than any change of the speed) and `b w`, `k^2 w / R`
    taken at the end of the step. Without a motor the speed is the command times the rated speed.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        p: place of the axis' pump block in `user`.
        speed: signed speed at the start, scalar [rad/s].
        command: u with the sign of the side, scalar [1].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        dt: step, scalar [s].

    Returns:
        Signed speed, scalar [rad/s]; 0 at command 0.

    Source: DC motor and gear pump with torque losses in textbook form (Merritt 1967, ch. 4).

    >>> import numpy as np
    >>> user = np.zeros(len(PumpSlot))
    >>> user[PumpSlot.RATED_SPEED] = 200.0
    >>> pump_speed_step(user, 0, 0.0, -0.5, 1.0e6, 1.0e6, 1.0e-3)
    -100.0
    """
    if command == 0.0:
        return 0.0
    side = math.copysign(1.0, command)
    if user[p + _INERTIA] == 0.0:
        return side * max(abs(command) * user[p + _RATED], STALLED)
    w = abs(speed)
    brake = user[p + _EMF] * user[p + _EMF] / user[p + _OHM] + user[p + _VISCOUS]
    ratio = w / user[p + _BREAK_SPEED]
    oil = user[p + _D] * side * (p_head - p_rod)
    torque = user[p + _EMF] * abs(command) * user[p + _VOLTAGE] / user[p + _OHM]
    torque -= oil + user[p + _LOSS] * abs(oil)
    torque -= user[p + _DRAG] + user[p + _BREAK] * math.exp(-ratio * ratio)
    gain = dt / user[p + _INERTIA]
    return side * max((w + gain * torque) / (1.0 + gain * brake), STALLED)


@allocation_free
def switched_speed(speed, after):
    """Speed of a pump at the start of a step, with the side that the valve has over the step.

    The relays switch at the start, the pump keeps turning: only the sign changes, and a pump whose
    valve is shut over the step moves no oil.

    Args:
        speed: at the start, with the sign of the side until then, scalar [rad/s].
        after: at the end, as `pump_speed_step` returns it, scalar [rad/s].

    Returns:
        Signed speed, scalar [rad/s].

    Source: switched valve without travel of its own.

    >>> switched_speed(40.0, -39.0), switched_speed(40.0, 0.0)
    (-40.0, 0.0)
    """
    if after == 0.0:
        return 0.0
    return math.copysign(max(abs(speed), STALLED), after)


@allocation_free
def accumulator_pressure(pressure, gas_volume, taken):
    """Pressure of the accumulator after oil has left it, with the gas at constant temperature.

    `p = (p_0 + p_atm) V_0 / (V_0 + dV) - p_atm`.

    Args:
        pressure: p_0, with nothing taken, scalar [Pa].
        gas_volume: V_0 then, scalar [m^3].
        taken: dV, oil that has left, scalar [m^3].

    Returns:
        p, scalar [Pa].

    Source: Boyle's law.

    >>> round(accumulator_pressure(5.0e5, 1.4e-4, 1.4e-5))
    445334
    """
    return (pressure + ATMOSPHERE) * gas_volume / (gas_volume + taken) - ATMOSPHERE


@allocation_free
def pump_flows(user, p, speed, p_head, p_rod, taken):
    """Flows of pump and accumulator line into both chambers and their slopes.

    The pump moves `D w - k dp` from one line to the other, the accumulator adds
    `(p_a - p) / R` to the line that the pump draws from.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        p: place of the axis' pump block in `user`.
        speed: signed speed, scalar [rad/s]; 0: valve shut.
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        taken: oil that the piston has taken from the accumulator, scalar [m^3].

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]).

    Source: volume balance of the lines.
    """
    if speed == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gas = accumulator_pressure(user[p + _ACCUMULATOR], user[p + _GAS], taken)
    leak = user[p + _LEAK]
    pumped = user[p + _D] * speed - leak * (p_head - p_rod)  # towards the head side
    if speed > 0.0:
        line = 1.0 / user[p + _LINE_OUT]
        return pumped, line * (gas - p_rod) - pumped, -leak, -leak - line
    line = 1.0 / user[p + _LINE_IN]
    return pumped + line * (gas - p_head), -pumped, -leak - line, -leak


@allocation_free
def oil_compliance(volume, bulk_modulus, compliance, air, pressure):
    """Compliance of a chamber: oil, walls, and air that follows Boyle's law.

    `C = V / beta + C_w + V_air p_atm / (p + p_atm)^2`.

    Args:
        volume: V, scalar [m^3].
        bulk_modulus: beta of oil without air, scalar [Pa].
        compliance: C_w of hose and walls, scalar [m^3/Pa].
        air: V_air, at the atmosphere's pressure, scalar [m^3].
        pressure: p, scalar [Pa].

    Returns:
        C, scalar [m^3/Pa].

    Source: Merritt 1967, sec. 1-4, with the air's stiffness at its pressure.

    >>> round(1e12 * oil_compliance(1.0e-3, 1.0e9, 0.0, 1.0e-5, 101325.0), 2)
    25.67
    """
    absolute = max(pressure + ATMOSPHERE, _THINNEST)
    return volume / bulk_modulus + compliance + air * ATMOSPHERE / (absolute * absolute)


@allocation_free
def pump_pressure_rates(user, p, speed, p_head, p_rod, volumes, swept, leakage, added):
    """Pressure rates of both chambers of a pump drive and their slopes with their own pressure.

    `C_A p_A' = q_A - A_h v - q_l + a_A`, `C_B p_B' = q_B + A_r v + q_l + a_B`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        p: place of the axis' pump block in `user`.
        speed: signed pump speed, scalar [rad/s].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        volumes: (V_A, V_B, oil taken from the accumulator) [m^3].
        swept: (A_h v, A_r v) [m^3/s].
        leakage: of the piston, scalar [m^3/(s Pa)].
        added: flows a_A, a_B of the machine's terms [m^3/s] and their slopes with these chambers'
            pressures [m^3/(s Pa)], see `terms.table.added_flows`.

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]).

    Source: volume balance of the chambers.
    """
    q_head, q_rod, slope_head, slope_rod = pump_flows(user, p, speed, p_head, p_rod, volumes[2])
    leak = leakage * (p_head - p_rod)
    beta = user[p + _BETA]
    head = oil_compliance(volumes[0], beta, user[p + _SOFT_HEAD], user[p + _AIR_HEAD], p_head)
    rod = oil_compliance(volumes[1], beta, user[p + _SOFT_ROD], user[p + _AIR_ROD], p_rod)
    return (
        (q_head - swept[0] - leak + added[0]) / head,
        (q_rod + swept[1] + leak + added[1]) / rod,
        (slope_head - leakage + added[2]) / head,
        (slope_rod - leakage + added[3]) / rod,
    )


@allocation_free
def load_pressure_step(user, p, pressure, velocity, dt):
    """Pressure in the load cylinder after a step.

    The chamber gives way by `s = d p / (p_v + p) + A p / k`: a void of width d with air at p_v in
    it, then oil of stiffness k. The piston adds `v dt` to s; s does not fall below 0, as the
    chamber draws oil without pressure, nor p rise above the relief's `p_s + r A max(0, v)`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        p: place of the axis' pump block in `user`.
        pressure: p at the start, scalar [Pa].
        velocity: v, positive against the load, scalar [m/s].
        dt: step, scalar [s].

    Returns:
        p at the end, scalar [Pa]; 0 without load cylinder.

    Source: Boyle's law and Hooke's; relief valve with linear override.
    """
    area = user[p + _AREA]
    if area == 0.0:
        return 0.0
    per_pressure, void, air = area / user[p + _STIFF], user[p + _VOID], user[p + _VOID_P]
    pressed = void * pressure / (air + pressure) + per_pressure * pressure + dt * velocity
    if pressed <= 0.0:
        return 0.0
    half = 0.5 * (void + per_pressure * air - pressed)
    root = math.sqrt(half * half + per_pressure * pressed * air)
    # the root of the quadratic that has no difference of like numbers
    risen = (root - half) / per_pressure if half < 0.0 else pressed * air / (root + half)
    return min(risen, user[p + _TOP] + user[p + _OVERRIDE] * area * max(0.0, velocity))


@allocation_free
def load_force(user, p, pressure):
    """Force of the load cylinder against extension, without its friction, scalar [N].

    Source: pressure times area.
    """
    return user[p + _AREA] * pressure


@allocation_free
def pump_piston_friction(user, p, seal, velocity, push, load_pressure, dt):
    """Friction at the end of a step that holds a piston fast until it is overcome.

    Dry friction `F_c + F_s exp(-(v/v_s)^2) + m A p_load`, and `F_r` more where the load cylinder
    moves back, resists; the velocity after the step `v' = v + dt/M (F - F_f)` is 0 where that can
    be. With dt = 0 friction is that of the velocity now, or at rest what holds F.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        p: place of the axis' pump block in `user`.
        seal: (F_c, F_s [N], v_s [m/s], b [N s/m], asymmetry of F_c + F_s, asymmetry of b [1]).
        velocity: v, scalar [m/s].
        push: F, all other force, scalar [N].
        load_pressure: scalar [Pa].
        dt: step, scalar [s].

    Returns:
        F_f, scalar [N].

    Source: implicit Euler rule with set-valued dry friction (Acary and Brogliato 2008, ch. 10).
    """
    ratio = velocity / seal[2]
    seals = seal[0] + seal[1] * math.exp(-ratio * ratio)
    load = user[p + _RUB] * load_force(user, p, load_pressure)
    forward = seals * (1.0 + seal[4]) + load
    backward = seals * (1.0 - seal[4]) + load + user[p + _RETURN]
    if dt == 0.0:
        if velocity > 0.0:
            return forward + seal[3] * (1.0 + seal[5]) * velocity
        if velocity < 0.0:
            return seal[3] * (1.0 - seal[5]) * velocity - backward
        return min(forward, max(-backward, push))
    momentum = user[p + _MASS] / dt
    stopping = momentum * velocity + push
    if stopping > forward:
        after = (stopping - forward) / (momentum + seal[3] * (1.0 + seal[5]))
    elif stopping < -backward:
        after = (stopping + backward) / (momentum + seal[3] * (1.0 - seal[5]))
    else:
        return stopping
    return stopping - momentum * after
