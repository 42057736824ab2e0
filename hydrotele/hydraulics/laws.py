"""Laws of valve opening, orifice, chamber, friction, end stop and spool, in SI units.

Small compiled functions (Merritt, *Hydraulic Control Systems*, 1967; `models/cat215/README.md`).
"""

import math

from hydrotele.core.compiled import compile_inlined, compile_without_allocation

ATMOSPHERE = 101325.0  # Pa
_POLYTROPIC_EXPONENT = 1.4  # polytropic exponent of bubbles: adiabatic compression
_MIN_ABSOLUTE_PRESSURE = 0.01  # Pa absolute, lower bound of a pressure


@compile_inlined
def valve_opening(spool, deadband):
    """Return the opening of a valve with overlap: 0 inside the dead band, then linear up to 1.

    Args:
        spool: spool position s, scalar [1], not clamped.
        deadband: half width of the overlap, scalar [1], 0 <= deadband < 1.

    Returns:
        Opening o, scalar [1]: `sgn(s) (|s| - db) / (1 - db)` outside the dead band, else 0.

    Source: models/cat215/README.md, "Spool".

    >>> valve_opening(1.0, 0.04)
    1.0
    >>> valve_opening(-0.03, 0.04)
    0.0
    """
    beyond = abs(spool) - deadband
    if beyond <= 0.0:
        return 0.0
    return math.copysign(beyond / (1.0 - deadband), spool)


@compile_inlined
def orifice_flow(pressure_drop, flow_gain, smoothing):
    """Return the turbulent flow through an orifice, smooth at zero pressure drop, and its derivative.

    `q = k dp / (dp^2 + d^2)^(1/4)`, which is `k sgn(dp) sqrt(|dp|)` away from zero.

    Args:
        pressure_drop: dp, scalar [Pa].
        flow_gain: k = Q_rated |o| / sqrt(dp_rated) with the relative valve opening o, scalar
            [m^3/(s sqrt(Pa))].
        smoothing: d, pressure drop below which the root is smoothed, scalar [Pa], > 0.

    Returns:
        (flow q [m^3/s] with the sign of the pressure drop, slope dq/d(dp) [m^3/(s Pa)] > 0).

    Source: models/cat215/README.md, "Orifice".

    >>> flow, slope = orifice_flow(7.0e6, 6.0e-3 / 7.0e6**0.5, 5.0e4)
    >>> round(flow, 7)
    0.0059999
    >>> orifice_flow(0.0, 1.0, 4.0)
    (0.0, 0.5)
    """
    square = pressure_drop * pressure_drop
    inverse = 1.0 / (square + smoothing * smoothing)
    scaled = flow_gain * math.sqrt(math.sqrt(inverse))
    return scaled * pressure_drop, scaled * (1.0 - 0.5 * square * inverse)


@compile_inlined
def relief_and_makeup_flow(pressure, port_relief, relief_gain, tank_pressure, makeup_gain):
    """Return the flow into a chamber through port relief and make-up valve, and its derivative.

    `r = -k_r max(0, p - p_port) + k_m max(0, p_t - p)`. The relief valve limits the pressure, and
    the make-up valve refills the chamber from the tank.

    Args:
        pressure: chamber pressure p, scalar [Pa].
        port_relief: p_port, setting of the relief valve, scalar [Pa].
        relief_gain: k_r, its flow per excess pressure, scalar [m^3/(s Pa)].
        tank_pressure: p_t, scalar [Pa].
        makeup_gain: k_m, flow of the make-up valve per pressure deficit, scalar [m^3/(s Pa)].

    Returns:
        (flow into the chamber [m^3/s], d flow / d p [m^3/(s Pa)] <= 0).

    Source: models/cat215/README.md, "Port relief and make-up".

    >>> relief_and_makeup_flow(33.0e6, 32.0e6, 1.0e-9, 0.3e6, 5.0e-9)
    (-0.001, -1e-09)
    """
    if pressure > port_relief:
        return -relief_gain * (pressure - port_relief), -relief_gain
    if pressure < tank_pressure:
        return makeup_gain * (tank_pressure - pressure), -makeup_gain
    return 0.0, 0.0


@compile_without_allocation
def pressure_with_released_air(air_free_pressure, release, onset=0.0):
    """Return the pressure in a chamber whose oil releases dissolved air below atmosphere.

    Oil below atmospheric pressure releases air in proportion to the pressure deficit (Henry's law).
    The air occupies the volume `V a |p| / (p + p_atm)` of the chamber (Boyle's law). If the
    pressure without air were P, the pressure p follows from `P = p (1 + R / (p + p_atm))` with
    `R = a beta`. It never reaches absolute zero.

    Args:
        air_free_pressure: P, pressure without released air, scalar [Pa] above atmosphere.
        release: R = a beta, with the volume a of dissolved air at atmosphere per volume of oil and
            the bulk modulus beta, scalar [Pa]; 0 for oil without air.
        onset: pressure deficit at which the release starts, scalar [Pa]; 0 in a simulation, the
            noise level of the pressure sensors in an estimator.

    Returns:
        p, scalar [Pa] above atmosphere; equal to P if P >= -onset.

    Source: Henry's and Boyle's law in equilibrium; see "Dissolved air" in models/cat215/README.md.

    >>> round(pressure_with_released_air(-1.0e8, 1.35e8))
    -43106
    >>> pressure_with_released_air(2.0e6, 1.35e8)
    2000000.0
    """
    lack = air_free_pressure + onset
    if lack >= 0.0 or release == 0.0:
        return air_free_pressure
    b = ATMOSPHERE + release - lack
    return 2.0 * lack * ATMOSPHERE / (b + math.sqrt(b * b + 4.0 * lack * ATMOSPHERE)) - onset


@compile_without_allocation
def air_compliance(pressure, fraction):
    """Return the compliance of air bubbles in the oil, per volume of oil [1/Pa].

    Bubbles with the volume fraction a at atmosphere follow `p V^n = const`. Compression is
    adiabatic (n = 1.4). The compliance `a (p_atm / p)^(1/n) / (n p)` adds to the 1 / beta of the
    oil. It is ten times as large at 1 MPa as at 4 MPa.

    Args:
        pressure: scalar [Pa] above atmosphere; limited to a tenth of the atmosphere, absolute.
        fraction: a, volume of the air at atmosphere per volume of oil, scalar [1].

    Returns:
        Compliance, scalar [1/Pa].

    Source: Nykanen, Esque and Ellman 2000, Proc. Bath Workshop on Power Transmission and Motion
    Control, two-phase model without what dissolves; its isothermal form is Merritt 1967, sec. 1-4.

    >>> round(1e9 * air_compliance(0.9e6, 0.02), 1), round(1e9 * air_compliance(9.9e6, 0.02), 2)
    (2.8, 0.05)
    """
    absolute = max(pressure + ATMOSPHERE, 0.1 * ATMOSPHERE)
    return fraction * (ATMOSPHERE / absolute) ** (1.0 / _POLYTROPIC_EXPONENT) / (_POLYTROPIC_EXPONENT * absolute)


@compile_without_allocation
def pressure_without_released_air(pressure, release, onset=0.0):
    """Return the pressure that oil would have without released air; inverts `pressure_with_released_air`.

    Args:
        pressure: p, with released air, scalar [Pa] above atmosphere; limited to slightly above vacuum.
        release: R of `pressure_with_released_air`: dissolved air fraction times bulk modulus, scalar [Pa].
        onset: pressure deficit at which the release starts, scalar [Pa].

    Returns:
        P, pressure without released air, scalar [Pa] above atmosphere; equal to p if p >= -onset.

    Source: inverse of `pressure_with_released_air`.

    >>> round(pressure_without_released_air(pressure_with_released_air(-1.0e8, 1.35e8), 1.35e8))
    -100000000
    """
    lack = pressure + onset
    if lack >= 0.0 or release == 0.0:
        return pressure
    lack = max(lack, _MIN_ABSOLUTE_PRESSURE - ATMOSPHERE)
    return lack * (1.0 + release / (lack + ATMOSPHERE)) - onset


@compile_inlined
def air_softening_factor(pressure, release, onset=0.0):
    """Return the factor by which air released below atmosphere reduces the stiffness of oil.

    The factor is the derivative of the pressure p with released air by the pressure P without it.

    Args:
        pressure: p, scalar [Pa] above atmosphere.
        release: R of `pressure_with_released_air`: dissolved air fraction times bulk modulus,
            scalar [Pa].
        onset: pressure deficit at which the release starts, scalar [Pa].

    Returns:
        dp/dP, scalar [1]; 1 if p >= -onset.

    Source: derivative of `pressure_with_released_air`.

    >>> air_softening_factor(1.0e5, 1.35e8)
    1.0
    >>> round(1.0 / air_softening_factor(-50662.5, 1.35e8))
    5330
    """
    if pressure + onset >= 0.0 or release == 0.0:
        return 1.0
    absolute = max(pressure + onset + ATMOSPHERE, _MIN_ABSOLUTE_PRESSURE)
    return 1.0 / (1.0 + release * ATMOSPHERE / (absolute * absolute))


@compile_without_allocation
def counterbalance_opening(pressure, pilot, setting, pilot_ratio, override):
    """Return the relative opening of a counterbalance valve, and its derivative by the pressure.

    `(p + R p_pilot - p_set) / p_o`, limited to 0 .. 1. The valve holds a load until the pressure of
    the opposite chamber opens it. Flow into the chamber passes the valve's
    check valve without resistance.

    Args:
        pressure: p of the held chamber, scalar [Pa].
        pilot: p_pilot of the opposite chamber, scalar [Pa].
        setting: p_set, opening pressure without pilot pressure, scalar [Pa].
        pilot_ratio: R, weight of the pilot pressure, scalar [1].
        override: p_o, pressure above the setting at which the valve is fully open, scalar [Pa],
            > 0.

    Returns:
        (relative opening [1], its derivative with respect to p [1/Pa]).

    Source: static characteristic of a pilot-assisted relief valve, as in manufacturers' data
        sheets.

    >>> counterbalance_opening(10.0e6, 5.0e6, 24.0e6, 3.0, 4.0e6)
    (0.25, 2.5e-07)
    """
    share = (pressure + pilot_ratio * pilot - setting) / override
    if share <= 0.0:
        return 0.0, 0.0
    if share >= 1.0:
        return 1.0, 0.0
    return share, 1.0 / override


@compile_without_allocation
def end_stop_force(position, velocity, low, high, stiffness, damping):
    """Return force, stiffness and damping of an end stop, a spring and a damper that only push.

    `F = max(0, k (x_low - x) - c v)` below the lower end, `-max(0, k (x - x_high) + c v)` above the
    upper one, 0 between.

    Args:
        position: x, scalar [m] or [rad].
        velocity: v, scalar [m/s] or [rad/s].
        low: x_low, lower end of the travel, scalar [m] or [rad].
        high: x_high, upper end of the travel, scalar [m] or [rad].
        stiffness: k, scalar [N/m] or [N m/rad].
        damping: c, scalar [N s/m] or [N m s/rad].

    Returns:
        (F [N] or [N m], -dF/dx [N/m] or [N m/rad], -dF/dv [N s/m] or [N m s/rad]).

    Source: Kelvin-Voigt contact without adhesion.

    >>> end_stop_force(1.001, 0.0, 0.0, 1.0, 1.0e8, 1.0e5)[1:]
    (100000000.0, 100000.0)
    """
    if low <= position <= high:
        return 0.0, 0.0, 0.0
    end = low if position < low else high
    force = -stiffness * (position - end) - damping * velocity
    if (force > 0.0) != (position < low):
        return 0.0, 0.0, 0.0
    return force, stiffness, damping


@compile_inlined
def friction_force(
    velocity, coulomb, stribeck, stribeck_velocity, viscous, coulomb_velocity,
    coulomb_asymmetry=0.0, viscous_asymmetry=0.0,
):  # fmt: skip
    """Return the sum of Coulomb, Stribeck and viscous friction at a velocity.

    `F_f = (F_c + F_s exp(-(v/v_s)^2)) t (1 + a_c t) + b v (1 + a_v t)` with `t = tanh(v/v_0)`.

    Args:
        velocity: v, scalar [m/s] or [rad/s].
        coulomb: F_c, scalar [N] or [N m].
        stribeck: F_s, additional friction at rest, scalar [N] or [N m].
        stribeck_velocity: v_s, scalar [m/s] or [rad/s], > 0.
        viscous: b, scalar [N s/m] or [N m s/rad].
        coulomb_velocity: v_0, smoothing of the sign function, scalar [m/s] or [rad/s], > 0.
        coulomb_asymmetry: a_c, relative excess of the dry friction in positive direction, scalar
            [1].
        viscous_asymmetry: a_v, the same for the viscous friction, scalar [1].

    Returns:
        Friction force, scalar [N] or [N m], with the sign of the velocity.

    Source: models/cat215/README.md, "Force" and "Swing and grapple motors".

    >>> round(friction_force(1.0, 3000.0, 1500.0, 0.02, 6000.0, 0.005), 6)
    9000.0
    """
    dry = coulomb
    if stribeck != 0.0:
        dry += stribeck * math.exp(-((velocity / stribeck_velocity) ** 2))
    way = math.tanh(velocity / coulomb_velocity)
    dry *= way * (1.0 + coulomb_asymmetry * way)
    return dry + viscous * velocity * (1.0 + viscous_asymmetry * way)


@compile_without_allocation
def friction_slope(
    velocity, coulomb, stribeck, stribeck_velocity, viscous, coulomb_velocity,
    coulomb_asymmetry=0.0, viscous_asymmetry=0.0,
):  # fmt: skip
    """Return the derivative of `friction_force` with respect to the velocity.

    Args:
        velocity: v, scalar [m/s] or [rad/s].
        coulomb: Coulomb friction, scalar [N] or [N m].
        stribeck: additional friction at rest, scalar [N] or [N m].
        stribeck_velocity: velocity at which it decays, scalar [m/s] or [rad/s], > 0.
        viscous: viscous coefficient, scalar [N s/m] or [N m s/rad].
        coulomb_velocity: smoothing of the sign function, scalar [m/s] or [rad/s], > 0.
        coulomb_asymmetry: relative excess of the dry friction in positive direction, scalar [1].
        viscous_asymmetry: the same for the viscous friction, scalar [1].

    Returns:
        Derivative, scalar [N s/m] or [N m s/rad].

    Source: derivative of "Force" in models/cat215/README.md.

    >>> friction_slope(0.0, 3000.0, 1500.0, 0.02, 6000.0, 0.005)
    906000.0
    """
    dry, steep = coulomb, 0.0
    if stribeck != 0.0:
        ratio = velocity / stribeck_velocity
        extra = stribeck * math.exp(-ratio * ratio)
        dry += extra
        steep = -2.0 * ratio / stribeck_velocity * extra
    way = math.tanh(velocity / coulomb_velocity)
    turn = (1.0 - way * way) / coulomb_velocity
    slope = steep * way * (1.0 + coulomb_asymmetry * way)
    slope += dry * turn * (1.0 + 2.0 * coulomb_asymmetry * way)
    asymmetry = viscous_asymmetry * (way + velocity * turn)
    return slope + viscous * (1.0 + asymmetry)


@compile_without_allocation
def spool_step(spool, spool_rate, command, bandwidth, damping, dt, slew_limit=0.0):
    """Return position and speed of a valve spool after one time step of its second-order dynamics.

    `s'' = w^2 (u - s) - 2 z w s'` with `|s'| <= s_max`, where ' is d/dt. The command is constant
    over the step. The exponential is truncated after the fourth power of `w dt`: for z <= 1 the
    error per step is below `(w dt)^5 / 30` of `u - s` (1.1e-8 for 8 Hz and 1 ms). For
    `w dt > 0.5` the step is subdivided.

    Args:
        spool: s, scalar [1].
        spool_rate: s', scalar [1/s].
        command: u, scalar [1].
        bandwidth: w, natural frequency, scalar [rad/s].
        damping: z, scalar [1].
        dt: time step, scalar [s].
        slew_limit: s_max, speed limit of the pilot stage, scalar [1/s]; 0 for no limit.

    Returns:
        (s, s') at the end of the step.

    Source: models/cat215/README.md, "Spool".

    >>> s, rate = spool_step(0.0, 0.0, 1.0, 50.0, 0.9, 1.0e-3)
    >>> round(s, 6)
    0.001213
    """
    parts = 1 + int(bandwidth * dt / 0.5)
    h = dt / parts
    w2 = bandwidth * bandwidth
    c = 2.0 * damping * bandwidth
    e, v = spool - command, spool_rate
    for _ in range(parts):
        e0, v0 = e, v
        e1, v1 = v, -w2 * e - c * v
        e2, v2 = v1, -w2 * e1 - c * v1
        e3, v3 = v2, -w2 * e2 - c * v2
        v4 = -w2 * e3 - c * v3
        e += h * (e1 + h * (e2 / 2 + h * (e3 / 6 + h * v3 / 24)))
        v += h * (v1 + h * (v2 / 2 + h * (v3 / 6 + h * v4 / 24)))
        if slew_limit > 0.0 and abs(v) > slew_limit:
            v = math.copysign(slew_limit, v)
            e = e0 + 0.5 * h * (min(max(v0, -slew_limit), slew_limit) + v)
    return e + command, v
