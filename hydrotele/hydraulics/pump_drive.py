"""Pump drive: a motor turns a pump in one direction, and a switched valve selects the chamber.

The pump draws from the other chamber, whose line also connects to a gas accumulator. The
accumulator takes up the difference between the two piston areas. The command is the duty cycle of
the motor's bridge, signed by the selected side; without a motor it is the speed relative to the
rated speed. At command 0 the valve closes both chambers, and the pump is at rest. A load cylinder
on the same joint can push against the drive: its oil leaves through a relief valve, and in the
return direction the chamber refills without pressure.

The first of the actuator's four activations is the pump speed [rad/s], signed by the selected side;
it is exactly 0 if the valve is closed (a stalled pump has the speed `STALLED_SPEED`). The second is the
pressure in the load cylinder [Pa]. `PumpSlot` defines the order of the parameters. All pressures
are relative to the atmosphere.
"""

import math

from hydrotele.core.compiled import compile_without_allocation
from hydrotele.hydraulics.actuator_layout import PumpSlot
from hydrotele.hydraulics.laws import ATMOSPHERE

STALLED_SPEED = 1.0e-9  # rad/s, speed of a pump at rest while its valve is open
_MIN_AIR_PRESSURE = 0.1 * ATMOSPHERE  # Pa absolute, lower bound of the pressure for the air's compliance

_D, _LEAK, _RATED = PumpSlot.DISPLACEMENT.value, PumpSlot.LEAKAGE.value, PumpSlot.RATED_SPEED.value
_BETA, _GAS = PumpSlot.BULK_MODULUS.value, PumpSlot.GAS_VOLUME.value
_SOFT_HEAD, _SOFT_ROD = PumpSlot.COMPLIANCE_HEAD.value, PumpSlot.COMPLIANCE_ROD.value
_AIR_HEAD, _AIR_ROD = PumpSlot.AIR_HEAD.value, PumpSlot.AIR_ROD.value
_ACCUMULATOR = PumpSlot.ACCUMULATOR_PRESSURE.value
_LINE_OUT, _LINE_IN = PumpSlot.LINE_EXTENDING.value, PumpSlot.LINE_RETRACTING.value
_VOLTAGE, _OHM, _EMF = PumpSlot.VOLTAGE.value, PumpSlot.RESISTANCE.value, PumpSlot.EMF.value
_INERTIA, _DRAG = PumpSlot.INERTIA.value, PumpSlot.DRAG.value
_BREAKAWAY, _BREAKAWAY_SPEED = PumpSlot.BREAKAWAY.value, PumpSlot.BREAKAWAY_SPEED.value
_VISCOUS, _LOSS = PumpSlot.VISCOUS_DRAG.value, PumpSlot.TORQUE_LOSS.value
_MASS, _AREA = PumpSlot.MOVING_MASS.value, PumpSlot.LOAD_AREA.value
_LOAD_RELIEF, _OVERRIDE = PumpSlot.LOAD_RELIEF.value, PumpSlot.LOAD_OVERRIDE.value
_LOAD_STIFFNESS, _VOID = PumpSlot.LOAD_STIFFNESS.value, PumpSlot.LOAD_VOID.value
_VOID_PRESSURE = PumpSlot.LOAD_VOID_PRESSURE.value
_LOAD_FRICTION, _LOAD_RETURN = PumpSlot.LOAD_FRICTION.value, PumpSlot.LOAD_RETURN.value


@compile_without_allocation
def pump_speed_step(user, p, speed, command, p_head, p_rod, dt):
    """Return the pump speed after a time step, signed by the side that the valve selects.

    A positive command and speed feed the head side.

    `J w' = k (u U - k w) / R - D dp - l |D dp| - T_c - T_s exp(-(w/w_s)^2) - b w`, with the
    unsigned speed w, inertia J, torque constant k, duty cycle u, voltage U, resistance R,
    displacement D, pressure rise dp, torque loss l, drag T_c, breakaway torque T_s that decays at
    w_s, and viscous drag b. The current is quasi-static, because `L/R` is shorter than the time
    scale of the speed. `b w` and `k^2 w / R` are taken at the end of the step. Without a motor the
    speed is the command times the rated speed.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        p: index of the pump parameters of this axis in `user`.
        speed: signed speed at the start, scalar [rad/s].
        command: u, signed by the side, scalar [1].
        p_head: head-side pressure, scalar [Pa].
        p_rod: rod-side pressure, scalar [Pa].
        dt: time step, scalar [s].

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
        return side * max(abs(command) * user[p + _RATED], STALLED_SPEED)
    w = abs(speed)
    brake = user[p + _EMF] * user[p + _EMF] / user[p + _OHM] + user[p + _VISCOUS]
    ratio = w / user[p + _BREAKAWAY_SPEED]
    oil = user[p + _D] * side * (p_head - p_rod)
    torque = user[p + _EMF] * abs(command) * user[p + _VOLTAGE] / user[p + _OHM]
    torque -= oil + user[p + _LOSS] * abs(oil)
    torque -= user[p + _DRAG] + user[p + _BREAKAWAY] * math.exp(-ratio * ratio)
    gain = dt / user[p + _INERTIA]
    return side * max((w + gain * torque) / (1.0 + gain * brake), STALLED_SPEED)


@compile_without_allocation
def pump_speed_after_switching(speed, end_speed):
    """Return the pump speed at the start of a step, signed by the valve's side during the step.

    The valve switches at the start of the step while the pump keeps turning: only the sign changes.
    If the valve is closed during the step, the pump moves no oil and the result is 0.

    Args:
        speed: speed at the start, signed by the side before switching, scalar [rad/s].
        end_speed: speed at the end, as returned by `pump_speed_step`, scalar [rad/s].

    Returns:
        Signed speed, scalar [rad/s].

    Source: ideal switching valve without spool dynamics.

    >>> pump_speed_after_switching(40.0, -39.0), pump_speed_after_switching(40.0, 0.0)
    (-40.0, 0.0)
    """
    if end_speed == 0.0:
        return 0.0
    return math.copysign(max(abs(speed), STALLED_SPEED), end_speed)


@compile_without_allocation
def accumulator_pressure(pressure, gas_volume, removed_volume):
    """Return the accumulator pressure after oil has left it, with isothermal gas.

    `p = (p_0 + p_atm) V_0 / (V_0 + dV) - p_atm`.

    Args:
        pressure: p_0, pressure before any oil has left, scalar [Pa].
        gas_volume: V_0, gas volume at p_0, scalar [m^3].
        removed_volume: dV, oil volume that has left, scalar [m^3].

    Returns:
        p, scalar [Pa].

    Source: Boyle's law.

    >>> round(accumulator_pressure(5.0e5, 1.4e-4, 1.4e-5))
    445334
    """
    return (pressure + ATMOSPHERE) * gas_volume / (gas_volume + removed_volume) - ATMOSPHERE


@compile_without_allocation
def pump_flows(user, p, speed, p_head, p_rod, removed_volume):
    """Return the flows of pump and accumulator line into both chambers, and their derivatives.

    The pump moves `D w - k dp` from one line to the other, with displacement D, speed w, leakage k
    and pressure rise dp. The accumulator at pressure p_a adds `(p_a - p) / R` through the
    resistance R to the line at pressure p that the pump draws from.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        p: index of the pump parameters of this axis in `user`.
        speed: pump speed, positive if it feeds the head side, scalar [rad/s]; 0: valve closed.
        p_head: head-side pressure, scalar [Pa].
        p_rod: rod-side pressure, scalar [Pa].
        removed_volume: oil volume that the piston has taken from the accumulator, scalar [m^3].

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]).

    Source: volume balance of the lines.
    """
    if speed == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gas = accumulator_pressure(user[p + _ACCUMULATOR], user[p + _GAS], removed_volume)
    leak = user[p + _LEAK]
    pumped = user[p + _D] * speed - leak * (p_head - p_rod)  # towards the head side
    if speed > 0.0:
        line = 1.0 / user[p + _LINE_OUT]
        return pumped, line * (gas - p_rod) - pumped, -leak, -leak - line
    line = 1.0 / user[p + _LINE_IN]
    return pumped + line * (gas - p_head), -pumped, -leak - line, -leak


@compile_without_allocation
def chamber_compliance(volume, bulk_modulus, compliance, air, pressure):
    """Return the compliance (volume per pressure) of a chamber: oil, walls, and air by Boyle's law.

    `C = V / beta + C_w + V_air p_atm / (p + p_atm)^2`.

    Args:
        volume: V, scalar [m^3].
        bulk_modulus: beta of oil without air, scalar [Pa].
        compliance: C_w of hose and walls, scalar [m^3/Pa].
        air: V_air, volume of the air at atmospheric pressure, scalar [m^3].
        pressure: p, scalar [Pa].

    Returns:
        C, scalar [m^3/Pa].

    Source: Merritt 1967, sec. 1-4, with the air's stiffness at its pressure.

    >>> round(1e12 * chamber_compliance(1.0e-3, 1.0e9, 0.0, 1.0e-5, 101325.0), 2)
    25.67
    """
    absolute = max(pressure + ATMOSPHERE, _MIN_AIR_PRESSURE)
    return volume / bulk_modulus + compliance + air * ATMOSPHERE / (absolute * absolute)


@compile_without_allocation
def pump_pressure_rates(user, p, speed, p_head, p_rod, volumes, swept, leakage, added):
    """Return the pressure rates of both chambers of a pump drive, and their derivatives.

    `C_A p_A' = q_A - A_h v - q_l + a_A`, `C_B p_B' = q_B + A_r v + q_l + a_B` with compliances C,
    flows q of pump and accumulator, areas A, piston velocity v, piston leakage q_l, and flows a of
    terms.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        p: index of the pump parameters of this axis in `user`.
        speed: pump speed, positive if it feeds the head side, scalar [rad/s].
        p_head: head-side pressure p_A, scalar [Pa].
        p_rod: rod-side pressure p_B, scalar [Pa].
        volumes: (V_A, V_B, oil volume taken from the accumulator) [m^3].
        swept: (A_h v, A_r v) [m^3/s].
        leakage: leakage of the piston, scalar [m^3/(s Pa)].
        added: flows a_A, a_B of the machine's terms [m^3/s] and their slopes with respect to the
            pressures of these chambers [m^3/(s Pa)], see `terms.table.sum_flow_terms`.

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]), where ' is d/dt.

    Source: volume balance of the chambers.
    """
    q_head, q_rod, slope_head, slope_rod = pump_flows(user, p, speed, p_head, p_rod, volumes[2])
    leak = leakage * (p_head - p_rod)
    beta = user[p + _BETA]
    head = chamber_compliance(volumes[0], beta, user[p + _SOFT_HEAD], user[p + _AIR_HEAD], p_head)
    rod = chamber_compliance(volumes[1], beta, user[p + _SOFT_ROD], user[p + _AIR_ROD], p_rod)
    return (
        (q_head - swept[0] - leak + added[0]) / head,
        (q_rod + swept[1] + leak + added[1]) / rod,
        (slope_head - leakage + added[2]) / head,
        (slope_rod - leakage + added[3]) / rod,
    )


@compile_without_allocation
def load_pressure_step(user, p, pressure, velocity, dt):
    """Return the pressure in the load cylinder, which pushes against a pump drive, after a time step.

    The chamber is compressed by `s = d p / (p_v + p) + A p / k`: a void of width d that contains
    air at pressure p_v, in series with oil of stiffness k. The piston adds `v dt` to s. s does not
    fall below 0, because the chamber refills without pressure. p does not exceed the relief
    pressure `p_s + r A max(0, v)`, with setting p_s, override r and piston area A.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        p: index of the pump parameters of this axis in `user`.
        pressure: p at the start, scalar [Pa].
        velocity: v, positive against the load, scalar [m/s].
        dt: time step, scalar [s].

    Returns:
        p at the end of the step, scalar [Pa]; 0 without load cylinder.

    Source: Boyle's law and Hooke's; relief valve with linear override.
    """
    area = user[p + _AREA]
    if area == 0.0:
        return 0.0
    per_pressure, void, air = (
        area / user[p + _LOAD_STIFFNESS],
        user[p + _VOID],
        user[p + _VOID_PRESSURE],
    )
    pressed = void * pressure / (air + pressure) + per_pressure * pressure + dt * velocity
    if pressed <= 0.0:
        return 0.0
    half = 0.5 * (void + per_pressure * air - pressed)
    root = math.sqrt(half * half + per_pressure * pressed * air)
    # the form of the quadratic's root that avoids cancellation
    risen = (root - half) / per_pressure if half < 0.0 else pressed * air / (root + half)
    return min(risen, user[p + _LOAD_RELIEF] + user[p + _OVERRIDE] * area * max(0.0, velocity))


@compile_without_allocation
def load_cylinder_force(user, p, pressure):
    """Return the force of the load cylinder against extension of a pump drive, without friction [N].

    `p` is the index of the pump parameters in `user`, and `pressure` that in the load cylinder [Pa].

    Source: pressure times area.
    """
    return user[p + _AREA] * pressure


@compile_without_allocation
def pump_piston_friction(user, p, seal, velocity, push, load_pressure, dt):
    """Return the friction of a pump drive's piston at the end of a step, including sticking.

    Dry friction adds to viscous friction with the coefficient b. The dry friction is
    `F_c + F_s exp(-(v/v_s)^2) + m A p_load`, plus `F_r` while the load cylinder retracts. The load
    cylinder pushes against the piston: m is its friction coefficient, A its area and F_r its return
    force. M is the mass moved by the drive. These four are in `user`. If the dry friction can make
    the velocity after the step, `v + dt/M (F - F_f)`, zero, it does. With dt = 0 the friction is
    that at the current velocity; at rest it balances F as far as possible.

    Args:
        user: (nu * SLOT_COUNT,) parameters of all actuators, see `actuator_layout.Slot`.
        p: index of the pump parameters of this axis in `user`.
        seal: seal friction (F_c, F_s [N], v_s [m/s], b [N s/m], asymmetry of F_c + F_s, asymmetry
            of b [1]).
        velocity: v, scalar [m/s].
        push: F, all other force, scalar [N].
        load_pressure: pressure in the load cylinder, scalar [Pa].
        dt: time step, scalar [s].

    Returns:
        F_f, scalar [N].

    Source: implicit Euler rule with set-valued dry friction (Acary and Brogliato 2008, ch. 10).
    """
    ratio = velocity / seal[2]
    seals = seal[0] + seal[1] * math.exp(-ratio * ratio)
    load = user[p + _LOAD_FRICTION] * load_cylinder_force(user, p, load_pressure)
    forward = seals * (1.0 + seal[4]) + load
    backward = seals * (1.0 - seal[4]) + load + user[p + _LOAD_RETURN]
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
