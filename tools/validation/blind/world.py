"""Simulate an independent machine: own equations of motion, hydraulics, sensors and integrator.

Nothing of hydrotele's laws, circuit, multibody code or MuJoCo acts here, so that a search that
finds effects in these logs cannot owe it to shared code. With neutral `Forms` the equations are
those of the nominal model (`models/cat215/README.md`); each law can be exchanged for another form.

Mechanism: rig, a slide; arm, a swing with a planar boom and stick whose bodies are points of the
complex plane x + i z, by Kane's method. Integrator: Runge-Kutta of fourth order, fixed step.
Everything compiled stands in this one file, since numba's cache looks at one file only.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

STATES = 10
"""Per axis: joint position, joint velocity, spool, spool rate, head and rod pressure (below 0 that
of oil without air, see `felt`), bristle deflection, lagged command, drive position and drive
velocity behind a transmission."""
Q, W, S, R, PA, PB, Z, U, QD, WD = range(STATES)
_BRISTLE_DAMPING = 0.002  # s, sigma_1 over sigma_0
_ATMOSPHERE = 1.01325e5  # Pa

_jit = njit(cache=True, error_model="numpy", nogil=True)


class Mechanism(NamedTuple):
    """Geometry and masses; points of the arm's plane are complex numbers x + i z [m].

    Attributes:
        rig: whether it is one slide of `slide_mass` [kg].
        slide_mass: [kg].
        boom_pin: in the swing's frame.
        stick_pin: in the boom's frame.
        plane: y of the arm's plane in the swing's frame [m].
        base_pin: (2,) cylinder base pins of boom (swing's frame) and stick (boom's frame).
        rod_pin: (2,) of boom (boom's frame) and stick (stick's frame).
        closed: (n,) length of a cylinder at x = 0 [m]; for the rig its offset, x = q - closed.
        frame: (k,) frame of each rigid part: 0 boom, 1 stick.
        mass: (k,) [kg].
        com: (k,) in that frame.
        inertia: (k, 3) about its centre of mass, along, across and upright [kg m^2].
        bar_mass: (2, 2) cylinder x (tube, rod) [kg].
        bar_com: (2, 2) distance from the own pin [m].
        bar_inertia: (2, 2, 3) [kg m^2].
        swing_inertia: of the upper structure about the swing axis [kg m^2].
        swing_moment: (2,) mass times x and y of its centre of mass [kg m].
        gravity: (3,) at the base [m/s^2].
    """

    rig: bool
    slide_mass: float
    boom_pin: complex
    stick_pin: complex
    plane: float
    base_pin: np.ndarray
    rod_pin: np.ndarray
    closed: np.ndarray
    frame: np.ndarray
    mass: np.ndarray
    com: np.ndarray
    inertia: np.ndarray
    bar_mass: np.ndarray
    bar_com: np.ndarray
    bar_inertia: np.ndarray
    swing_inertia: float
    swing_moment: np.ndarray
    gravity: np.ndarray


class Drives(NamedTuple):
    """Numbers of valves, chambers and friction, all (n,), and of the shared supply, SI."""

    cylinder: np.ndarray
    area_head: np.ndarray
    area_rod: np.ndarray
    dead_volume: np.ndarray
    stroke: np.ndarray
    leakage: np.ndarray
    hose: np.ndarray
    bandwidth: np.ndarray
    damping: np.ndarray
    deadband: np.ndarray
    flow_gain: np.ndarray
    smoothing: np.ndarray
    port_relief: np.ndarray
    relief_gain: np.ndarray
    makeup_gain: np.ndarray
    coulomb: np.ndarray
    stribeck: np.ndarray
    stribeck_velocity: np.ndarray
    viscous: np.ndarray
    sign_velocity: np.ndarray
    coulomb_asymmetry: np.ndarray
    viscous_asymmetry: np.ndarray
    delay: np.ndarray
    bulk_modulus: float
    dissolved_air: float
    tank: float
    relief: float
    pump: float


class Forms(NamedTuple):
    """What laws of other forms need, all (n,) unless said; every zero (or one) switches one off.

    Attributes:
        soft_edge: width over which a dead band's edge is rounded [1].
        gain_extend: flow gain of positive openings over the stated one [1].
        gain_retract: the same of negative ones [1].
        shape: exponent of opening over spool travel beyond the dead band [1].
        slew: largest spool speed [1/s], 0 for none.
        command_lag: time constant of the command [s].
        hose_soft: compliance of a hose at no pressure beyond that at full pressure [m^3/Pa].
        hose_pressure: pressure over which it stiffens [Pa].
        air: volume fraction of air at atmosphere, scalar [1].
        leak_orifice: leakage of a turbulent gap [m^3/(s sqrt(Pa))].
        exponential: 1 where extra friction at rest falls as exp(-|v|/v_s), not with the square.
        presliding: bristle deflection of a LuGre friction [m] or [rad], 0 for none.
        load_friction: share of the pressure force that rubs [1].
        quadratic: friction per speed squared [N s^2/m^2] or [N m s^2/rad^2].
        drive_inertia: of a drive side behind a transmission [kg] or [kg m^2], 0 for a rigid one.
        gap: play of that transmission, from end to end [m] or [rad].
        contact: stiffness of its teeth or shaft [N/m] or [N m/rad].
        contact_damping: damping force per stiffness force and speed (Hunt and Crossley) [s/rad].
        shaft_damping: linear damping of a shaft without play [N m s/rad].
        hardening: rise of the stiffness per deflection squared [1/rad^2].
        relief_droop: rise of the relief valve's pressure per flow, scalar [Pa s/m^3].
        pump_leak: pump flow lost per pressure, scalar [m^3/(s Pa)].
    """

    soft_edge: np.ndarray
    gain_extend: np.ndarray
    gain_retract: np.ndarray
    shape: np.ndarray
    slew: np.ndarray
    command_lag: np.ndarray
    hose_soft: np.ndarray
    hose_pressure: np.ndarray
    air: float
    leak_orifice: np.ndarray
    exponential: np.ndarray
    presliding: np.ndarray
    load_friction: np.ndarray
    quadratic: np.ndarray
    drive_inertia: np.ndarray
    gap: np.ndarray
    contact: np.ndarray
    contact_damping: np.ndarray
    shaft_damping: np.ndarray
    hardening: np.ndarray
    relief_droop: float
    pump_leak: float


class Added(NamedTuple):
    """An unknown term: a random smooth function of two physical variables that acts somewhere.

    Attributes:
        target: `TARGETS` index; -1 for none.
        axis: where it acts.
        variables: (2,) `VARIABLES` indices.
        of: (2,) axis of each variable.
        centre: (2,) and
        width: (2,) that make the variables dimensionless.
        weight: (m,) of the waves, of unit root mean square together.
        wave: (m, 2) wave numbers.
        phase: (m,) [rad].
        size: of the term, in the target's unit.
        gate: 0 always, 1 while a variable is high (with hysteresis), 2 through a play of the first
            variable, 3 in a window of time.
        low: lower end of the hysteresis, half width of the play, or start [s].
        high: upper end of the hysteresis, or end [s].
    """

    target: int
    axis: int
    variables: np.ndarray
    of: np.ndarray
    centre: np.ndarray
    width: np.ndarray
    weight: np.ndarray
    wave: np.ndarray
    phase: np.ndarray
    size: float
    gate: int
    low: float
    high: float


TARGETS = ("force", "flow_head", "flow_rod", "command", "spool_rate", "pump_flow")
VARIABLES = (
    "position", "velocity", "pressure_head", "pressure_rod", "spool", "command", "load_pressure",
    "supply", "time",
)  # fmt: skip


class Sensors(NamedTuple):
    """How the c channels read, all (c,): a true value is lagged, delayed, scaled, shifted.

    Channels: joint positions, lengths of the cylinders, head pressures, rod pressures, supply.
    """

    scale: np.ndarray
    offset: np.ndarray
    drift: np.ndarray
    delay: np.ndarray
    lag: np.ndarray
    step: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Machine(NamedTuple):
    """All of an independent machine."""

    mechanism: Mechanism
    drives: Drives
    forms: Forms
    added: Added
    sensors: Sensors


@_jit
def linkage(mechanism, i, q):
    """Drive displacement of an axis and its slope over the joint.

    A boom's or stick's cylinder: x = c - l_c with c = |rod pin - base pin|, slope c'.

    Args:
        mechanism: a `Mechanism`.
        i: axis.
        q: joint position, scalar [rad] or [m].

    Returns:
        (x [m] or [rad], dx/dq).
    """
    if mechanism.rig:
        return q - mechanism.closed[0], 1.0
    if i == 0:
        return q, 1.0
    start = mechanism.boom_pin if i == 1 else mechanism.stick_pin
    turned = (math.cos(q) + 1j * math.sin(q)) * mechanism.rod_pin[i - 1]
    d = start + turned - mechanism.base_pin[i - 1]
    c = abs(d)
    return c - mechanism.closed[i], (np.conj(d) * 1j * turned).real / c


@_jit
def _add_part(m, inertia, p, p1, p2, p11, p12, p22, angle, f1, f2, f22, mechanism, w, M, h):
    """Add a planar body: p over the two arm angles with its derivatives, f of its own angle."""
    y, x = mechanism.plane, p.real
    along, across, upright = inertia
    s, c = math.sin(angle), math.cos(angle)
    rate = p1 * w[1] + p2 * w[2]
    bias = p11 * w[1] ** 2 + 2.0 * p12 * w[1] * w[2] + p22 * w[2] ** 2
    bias_x = bias.real - w[0] ** 2 * x
    bias_y = 2.0 * w[0] * rate.real - w[0] ** 2 * y
    M[0, 0] += m * (x * x + y * y) + along * s * s + upright * c * c
    M[0, 1] -= m * y * p1.real
    M[0, 2] -= m * y * p2.real
    M[1, 1] += m * abs(p1) ** 2 + across * f1 * f1
    M[1, 2] += m * (p1 * np.conj(p2)).real + across * f1 * f2
    M[2, 2] += m * abs(p2) ** 2 + across * f2 * f2
    twist = (along - upright) * s * c
    turn = f1 * w[1] + f2 * w[2]
    h[0] += m * (x * bias_y - y * bias_x) + 2.0 * twist * turn * w[0]
    bend = across * f22 * w[2] ** 2 - w[0] ** 2 * twist
    h[1] += m * (bias_x * p1.real + bias.imag * p1.imag) + f1 * bend
    h[2] += m * (bias_x * p2.real + bias.imag * p2.imag) + f2 * bend
    g = mechanism.gravity
    # gravity is in the swing's frame already, see `accelerations`
    h[0] -= m * (g[1] * x - g[0] * y)
    h[1] -= m * (g[0] * p1.real + g[2] * p1.imag)
    h[2] -= m * (g[0] * p2.real + g[2] * p2.imag)


@_jit
def arm_equations(mechanism, q, w, M, h):
    """Mass matrix and the forces of motion and gravity: M q'' + h = Q.

    Args:
        mechanism: a `Mechanism` whose gravity stands in the swing's frame.
        q: (3,) swing, boom, stick [rad].
        w: (3,) their rates [rad/s].
        M: (3, 3) written, upper half [kg m^2].
        h: (3,) written [N m].

    Source: Kane and Levinson, Dynamics (1985), section 6; bodies symmetric about the arm's plane.
    """
    M[:] = 0.0
    h[:] = 0.0
    M[0, 0] = mechanism.swing_inertia
    g, moment = mechanism.gravity, mechanism.swing_moment
    h[0] = -(moment[0] * g[1] - moment[1] * g[0])
    e1 = math.cos(q[1]) + 1j * math.sin(q[1])
    e2 = math.cos(q[2]) + 1j * math.sin(q[2])
    pin = mechanism.boom_pin
    for k in range(mechanism.mass.shape[0]):
        m, inertia = mechanism.mass[k], mechanism.inertia[k]
        if mechanism.frame[k] == 0:
            r = e1 * mechanism.com[k]
            _add_part(m, inertia, pin + r, 1j * r, 0j, -r, 0j, 0j, q[1], 1.0, 0.0, 0.0,
                      mechanism, w, M, h)  # fmt: skip
        else:
            far = e1 * e2 * mechanism.com[k]
            r = e1 * mechanism.stick_pin + far
            _add_part(m, inertia, pin + r, 1j * r, 1j * far, -r, -far, -far, q[1] + q[2], 1.0,
                      1.0, 0.0, mechanism, w, M, h)  # fmt: skip
    for k in range(2):
        start = pin if k == 0 else mechanism.stick_pin
        turned = (e1 if k == 0 else e2) * mechanism.rod_pin[k]
        d = start + turned - mechanism.base_pin[k]
        first = 1j * turned / d  # c'/c + i gamma'
        second = -turned / d - first * first
        u = d / abs(d)
        u1 = 1j * first.imag * u
        u2 = 1j * second.imag * u - first.imag**2 * u
        for end in range(2):
            reach, m = mechanism.bar_com[k, end], mechanism.bar_mass[k, end]
            if end == 0:
                f, f1, f2 = mechanism.base_pin[k] + reach * u, reach * u1, reach * u2
            else:
                f, f1 = start + turned - reach * u, 1j * turned - reach * u1
                f2 = -turned - reach * u2
            inertia = mechanism.bar_inertia[k, end]
            angle = math.atan2(u.imag, u.real)
            if k == 0:
                _add_part(m, inertia, f, f1, 0j, f2, 0j, 0j, angle, first.imag, 0.0, 0.0,
                          mechanism, w, M, h)  # fmt: skip
                # its own angle bends with the boom's angle, not with the stick's
                h[1] += inertia[1] * first.imag * second.imag * w[1] ** 2
            else:
                r = e1 * f
                _add_part(m, inertia, pin + r, 1j * r, e1 * f1, -r, 1j * e1 * f1, e1 * f2,
                          q[1] + angle, 1.0, first.imag, second.imag,
                          mechanism, w, M, h)  # fmt: skip


@_jit
def _solve3(M, b, out):
    """Solve the symmetric 3 x 3 system whose upper half is M, by Cramer's rule."""
    a, d, e, f, c, g = M[0, 0], M[1, 1], M[2, 2], M[0, 1], M[0, 2], M[1, 2]
    k0, k1, k2 = d * e - g * g, c * g - f * e, f * g - c * d
    det = a * k0 + f * k1 + c * k2
    k4, k5, k8 = a * e - c * c, c * f - a * g, a * d - f * f
    out[0] = (k0 * b[0] + k1 * b[1] + k2 * b[2]) / det
    out[1] = (k1 * b[0] + k4 * b[1] + k5 * b[2]) / det
    out[2] = (k2 * b[0] + k5 * b[1] + k8 * b[2]) / det


@_jit
def opening(spool, deadband, soft, shape):
    """Opening of a valve: dead band with a sharp or a rounded edge, linear or progressive beyond.

    Sharp `(|s| - db)/(1 - db)`; rounded the softplus of it over `soft`, less its value at rest.

    >>> round(opening(0.52, 0.04, 0.0, 1.0), 9)
    0.5
    >>> 0.0 < opening(0.04, 0.04, 0.02, 1.0) < 0.02
    True
    """
    size = abs(spool)
    if soft > 0.0:
        edge = (size - deadband) / soft
        rest = soft * math.log1p(math.exp(-deadband / soft))
        above = size - deadband if edge > 30.0 else soft * math.log1p(math.exp(edge))
        part = (above - rest) / (1.0 - deadband)
    else:
        part = (size - deadband) / (1.0 - deadband)
    if part <= 0.0:
        return 0.0
    return math.copysign(part if shape == 1.0 else part**shape, spool)


@_jit
def throttle(drop, gain, smoothing):
    """Turbulent flow over an edge, laminar near no drop: `k dp / (dp^2 + d^2)^(1/4)`, and slope."""
    root = math.sqrt(math.sqrt(drop * drop + smoothing * smoothing))
    flow = gain * drop / root
    return flow, gain / root * (1.0 - 0.5 * drop * drop / root**4)


@_jit
def supply_pressure(open_gain, port, n, drives, forms, pump):
    """Pressure at which valves, relief valve and pump leakage take what the pump gives.

    `sum q_i(p) + max(0, p - p_open)/R + k p = Q`; without droop (R = 0) p ends at the setting.

    Args:
        open_gain: (n,) flow gain of each feeding edge [m^3/(s sqrt(Pa))].
        port: (n,) pressure behind it [Pa].
        n: number of axes.
        drives: `Drives`.
        forms: `Forms`.
        pump: pump flow [m^3/s].

    Returns:
        p_s, scalar [Pa].
    """
    droop = forms.relief_droop
    crack = drives.relief - droop * pump
    low, high = 0.0, drives.relief
    p = high
    for step in range(80):
        excess, slope = forms.pump_leak * p - pump, forms.pump_leak
        for i in range(n):
            if open_gain[i] > 0.0 and p > port[i]:
                flow, gain = throttle(p - port[i], open_gain[i], drives.smoothing[i])
                excess += flow
                slope += gain
        if droop > 0.0 and p > crack:
            excess += (p - crack) / droop
            slope += 1.0 / droop
        if step == 0 and excess <= 0.0:
            return p
        if abs(excess) < 1.0e-11 * pump or high - low < 1.0e-6:
            return p
        if excess > 0.0:
            high = p
        else:
            low = p
        guess = p - excess / slope if slope > 0.0 else -1.0
        p = guess if low < guess < high else 0.5 * (low + high)
    return p


@_jit
def friction(i, v, z, load, drives, forms):
    """Friction of a drive and the rate of its bristles.

    Nominal: `(F_c + F_s exp(-(v/v_s)^2)) t (1 + a_c t) + b v (1 + a_v t)`, t = tanh(v/v_0).
    Other forms: exp(-|v|/v_s) (Tustin; Armstrong-Helouvry 1994), a share of the load, a part that
    grows with speed squared, and LuGre's bristles (Canudas de Wit et al. 1995)
    `z' = v - |v| z / z_0(v)`, `F = sigma_0 z + sigma_1 z' + b v` with sigma_0 z_0 = dry friction.

    Args:
        i: axis.
        v: drive velocity, scalar [m/s] or [rad/s].
        z: bristle deflection, scalar [m] or [rad].
        load: pressure force, scalar [N] or [N m].
        drives: `Drives`.
        forms: `Forms`.

    Returns:
        (force with the sign of the velocity [N] or [N m], z').
    """
    ratio = abs(v) / drives.stribeck_velocity[i]
    fall = math.exp(-ratio) if forms.exponential[i] > 0.0 else math.exp(-ratio * ratio)
    dry = drives.coulomb[i] + drives.stribeck[i] * fall + forms.load_friction[i] * abs(load)
    way = math.tanh(v / drives.sign_velocity[i])
    wet = drives.viscous[i] * v * (1.0 + drives.viscous_asymmetry[i] * way)
    wet += forms.quadratic[i] * v * abs(v)
    dry *= 1.0 + drives.coulomb_asymmetry[i] * way
    if forms.presliding[i] <= 0.0:
        return dry * way + wet, 0.0
    stiffness = drives.coulomb[i] / forms.presliding[i]
    rate = v - abs(v) * z * stiffness / dry
    return stiffness * (z + _BRISTLE_DAMPING * rate) + wet, rate


@_jit
def _compliance(p, volume, i, drives, forms):
    """Volume per pressure of a chamber: oil, air in it and hose [m^3/Pa]."""
    bar = max(p, 1.0e4)
    total = volume / drives.bulk_modulus + drives.hose[i]
    if forms.air > 0.0:
        part = forms.air * (1.013e5 / bar) ** (1.0 / 1.2)
        total += volume * part / (1.2 * bar)
    if forms.hose_soft[i] > 0.0:
        total += forms.hose_soft[i] * math.exp(-bar / forms.hose_pressure[i])
    return total


@_jit
def felt(p, drives):
    """Pressure above atmosphere of a chamber whose oil alone would be at p [Pa].

    Below atmosphere the air that comes out of V of oil fills `V a (-x) / (x + p_atm)` of what is
    missing, `-V p / beta = -V x / beta + that`: Newton's method from 0, where it descends only.
    """
    if p >= 0.0:
        return p
    x, air = 0.0, drives.dissolved_air * drives.bulk_modulus
    for _ in range(60):
        slope = (x + _ATMOSPHERE) + (x - p) + air
        step = ((x - p) * (x + _ATMOSPHERE) + air * x) / slope
        x -= step
        if step <= 1e-9 * _ATMOSPHERE:
            break
    return x


@_jit
def _port(p, i, drives):
    """Flow into a chamber through port relief and make-up valve [m^3/s]."""
    if p > drives.port_relief[i]:
        return -drives.relief_gain[i] * (p - drives.port_relief[i])
    if p < drives.tank:
        return drives.makeup_gain[i] * (drives.tank - p)
    return 0.0


@_jit
def _transmitted(i, y, forms):
    """Force that teeth or a shaft carry from the drive side to the load [N m]."""
    wound, rate = y[i, QD] - y[i, Q], y[i, WD] - y[i, W]
    half = 0.5 * forms.gap[i]
    deep = wound - half if wound > half else (wound + half if wound < -half else 0.0)
    force = forms.contact[i] * deep * (1.0 + forms.hardening[i] * deep * deep)
    if half > 0.0:
        force *= 1.0 + forms.contact_damping[i] * rate * (1.0 if deep > 0.0 else -1.0)
        return force if force * deep > 0.0 else 0.0  # teeth push, they never pull
    return force + forms.shaft_damping[i] * rate


@_jit
def rates(machine, y, u, terms, dy, work):
    """Time derivative of all states.

    Args:
        machine: `Machine`.
        y: (n, STATES) states.
        u: (n,) delayed commands [1].
        terms: (6, n) what an unknown term adds, by target.
        dy: (n, STATES) written.
        work: (6, 3) and more, work space (12, 3).

    Returns:
        Supply pressure, scalar [Pa].
    """
    mechanism, drives, forms = machine.mechanism, machine.drives, machine.forms
    n = y.shape[0]
    gain_open, port, drive_force, accel = work[0], work[1], work[2], work[3]
    for i in range(n):
        o = opening(y[i, S], drives.deadband[i], forms.soft_edge[i], forms.shape[i])
        work[4, i] = o
        gain = drives.flow_gain[i] * abs(o)
        gain_open[i] = gain * (forms.gain_extend[i] if o > 0.0 else forms.gain_retract[i])
        port[i] = felt(y[i, PA] if o > 0.0 else y[i, PB], drives)
    pump = drives.pump + terms[5, 0]
    supply = supply_pressure(gain_open, port, n, drives, forms, pump)
    for i in range(n):
        geared = forms.drive_inertia[i] > 0.0
        x, slope = linkage(mechanism, i, y[i, Q])
        v = slope * y[i, W]
        if geared:
            v = y[i, WD]
        p_head, p_rod, o = felt(y[i, PA], drives), felt(y[i, PB], drives), work[4, i]
        q_head, q_rod = terms[1, i], terms[2, i]
        if o > 0.0:
            if supply > p_head:
                q_head += throttle(supply - p_head, gain_open[i], drives.smoothing[i])[0]
            q_rod -= throttle(p_rod - drives.tank, gain_open[i], drives.smoothing[i])[0]
        elif o < 0.0:
            if supply > p_rod:
                q_rod += throttle(supply - p_rod, gain_open[i], drives.smoothing[i])[0]
            q_head -= throttle(p_head - drives.tank, gain_open[i], drives.smoothing[i])[0]
        leak = drives.leakage[i] * (p_head - p_rod)
        if forms.leak_orifice[i] > 0.0:
            leak += throttle(p_head - p_rod, forms.leak_orifice[i], drives.smoothing[i])[0]
        volume_head = drives.dead_volume[i]
        volume_rod = volume_head
        if drives.cylinder[i]:
            volume_head += drives.area_head[i] * x
            volume_rod += drives.area_rod[i] * (drives.stroke[i] - x)
        q_head += _port(p_head, i, drives) - leak - drives.area_head[i] * v
        q_rod += _port(p_rod, i, drives) + leak + drives.area_rod[i] * v
        dy[i, PA] = q_head / _compliance(p_head, volume_head, i, drives, forms)
        dy[i, PB] = q_rod / _compliance(p_rod, volume_rod, i, drives, forms)
        push = drives.area_head[i] * p_head - drives.area_rod[i] * p_rod
        rub, dy[i, Z] = friction(i, v, y[i, Z], push, drives, forms)
        drive_force[i] = slope * (push - rub + terms[0, i])
        dy[i, QD] = 0.0
        dy[i, WD] = 0.0
        if geared:
            carried = _transmitted(i, y, forms)
            dy[i, QD] = y[i, WD]
            dy[i, WD] = (push - rub + terms[0, i] - carried) / forms.drive_inertia[i]
            drive_force[i] = carried
        dy[i, Q] = y[i, W]
        lag = forms.command_lag[i]
        dy[i, U] = (u[i] - y[i, U]) / lag if lag > 0.0 else 0.0
        target = min(1.0, max(-1.0, (y[i, U] if lag > 0.0 else u[i]) + terms[3, i]))
        rate = y[i, R] + terms[4, i]
        if forms.slew[i] > 0.0:
            rate = min(forms.slew[i], max(-forms.slew[i], rate))
        dy[i, S] = rate
        band = drives.bandwidth[i]
        dy[i, R] = band * band * (target - y[i, S]) - 2.0 * drives.damping[i] * band * y[i, R]
    if mechanism.rig:
        dy[0, W] = drive_force[0] / mechanism.slide_mass + mechanism.gravity[0]
        return supply
    M, h, q, w = work[5:8], work[8], work[9], work[10]
    for i in range(3):
        q[i], w[i] = y[i, Q], y[i, W]
    arm_equations(_in_swing_frame(mechanism, q[0]), q, w, M, h)
    for i in range(3):
        h[i] = drive_force[i] - h[i]
    _solve3(M, h, accel)
    for i in range(3):
        dy[i, W] = accel[i]
    return supply


@_jit
def _in_swing_frame(m, swing):
    """The mechanism with gravity turned into the swing's frame."""
    if m.gravity[0] == 0.0 and m.gravity[1] == 0.0:
        return m
    c, s = math.cos(swing), math.sin(swing)
    g = np.array([c * m.gravity[0] + s * m.gravity[1], c * m.gravity[1] - s * m.gravity[0],
                  m.gravity[2]])  # fmt: skip
    return Mechanism(m.rig, m.slide_mass, m.boom_pin, m.stick_pin, m.plane, m.base_pin, m.rod_pin,
                     m.closed, m.frame, m.mass, m.com, m.inertia, m.bar_mass, m.bar_com,
                     m.bar_inertia, m.swing_inertia, m.swing_moment, g)  # fmt: skip


@_jit
def _variable(kind, i, machine, y, u, supply, time):
    """A physical variable by its place in `VARIABLES`."""
    drives = machine.drives
    if kind == 0:
        return linkage(machine.mechanism, i, y[i, Q])[0]
    if kind == 1:
        return linkage(machine.mechanism, i, y[i, Q])[1] * y[i, W]
    if kind == 2:
        return felt(y[i, PA], drives)
    if kind == 3:
        return felt(y[i, PB], drives)
    if kind == 4:
        return y[i, S]
    if kind == 5:
        return u[i]
    if kind == 6:
        rod = felt(y[i, PB], drives)
        return felt(y[i, PA], drives) - rod * drives.area_rod[i] / drives.area_head[i]
    if kind == 7:
        return supply
    return time


@_jit
def unknown_term(machine, y, u, supply, time, memory, terms):
    """Write what the unknown term adds now; `memory` (2,) holds its gate and its play."""
    added = machine.added
    terms[:] = 0.0
    if added.target < 0:
        return
    a = _variable(added.variables[0], added.of[0], machine, y, u, supply, time)
    b = _variable(added.variables[1], added.of[1], machine, y, u, supply, time)
    a = (a - added.centre[0]) / added.width[0]
    b = (b - added.centre[1]) / added.width[1]
    strength = 1.0
    if added.gate == 1:
        if a > added.high:
            memory[0] = 1.0
        elif a < added.low:
            memory[0] = 0.0
        strength = memory[0]
    elif added.gate == 2:
        memory[1] = min(a + added.low, max(a - added.low, memory[1]))
        a = memory[1]
    elif added.gate == 3:
        rise = min((time - added.low) / 0.1, (added.high - time) / 0.1)
        strength = min(1.0, max(0.0, rise))
    value = 0.0
    for k in range(added.weight.shape[0]):
        value += added.weight[k] * math.cos(added.wave[k, 0] * a + added.wave[k, 1] * b
                                            + added.phase[k])  # fmt: skip
    terms[added.target, added.axis] = strength * added.size * value


@_jit
def _true_channels(machine, y, supply, out):
    """The c true channels of a state."""
    n, at = y.shape[0], 0
    drives = machine.drives
    for i in range(n):
        out[at] = y[i, Q]
        at += 1
    for i in range(n):
        if drives.cylinder[i]:
            out[at] = linkage(machine.mechanism, i, y[i, Q])[0]
            at += 1
    for i in range(n):
        out[at] = felt(y[i, PA], drives)
        out[at + n] = felt(y[i, PB], drives)
        at += 1
    out[at + n] = supply


@_jit
def _rk4(machine, y, u, terms, dt, k, trial, work):
    """One step of the classical Runge-Kutta method."""
    rates(machine, y, u, terms, k[0], work)
    trial[:] = y + 0.5 * dt * k[0]
    rates(machine, trial, u, terms, k[1], work)
    trial[:] = y + 0.5 * dt * k[1]
    rates(machine, trial, u, terms, k[2], work)
    trial[:] = y + dt * k[2]
    rates(machine, trial, u, terms, k[3], work)
    y += dt / 6.0 * (k[0] + 2.0 * k[1] + 2.0 * k[2] + k[3])


@_jit
def _arrived(command, late, closed):
    """Command that holds at a time, in rows: before the first one that, or none."""
    index = int(math.floor(late + 1.0e-9))
    sent = 0.0 if index < 0 and closed else command[max(0, index)]
    return min(1.0, max(-1.0, sent))


@_jit
def simulate(machine, start, commands, closed, reference, ahead, arm, gains, noise, period, steps,
             restart, states):  # fmt: skip
    """Run the machine along given commands, or under a controller that sees its sensors.

    The controller opens each valve for the flow that the reference asks for, plus the position
    error times a gain, less what damps: `o = A (x_r' + K (x_r - x) - G (F - F_slow)) / Q_rated`
    with the pressure force F, over the dead band, in steps of 1/2048. A row's command leaves at
    once and holds until the next row.

    Args:
        machine: `Machine`.
        start: (n, STATES).
        commands: (rows, n), read or, if closed, written [1].
        closed: whether the controller acts.
        reference: (rows, n) joint references [rad] or [m].
        ahead: (rows, n) their rates, ahead of time by the lead [rad/s] or [m/s].
        arm: (rows, n) dx/dq at the references.
        gains: (7, n) K [1/s], stated rated flow [m^3/s], dead band [1], area of head and of rod
            [m^2], G [m/(s N)], share of a row in the slow mean [1].
        noise: (rows, c) error of each reading before the converter [channel's unit].
        period: of a row [s].
        steps: of the integrator in a row.
        restart: rows after which the state is set to `states`, 0 for never.
        states: (rows, n, STATES) read at a restart, else written.

    Returns:
        (readings (rows, c), what the sensors would read without noise and converter (rows, c)).
    """
    n, rows, c = start.shape[0], commands.shape[0], noise.shape[1]
    dt, sensors = period / steps, machine.sensors
    y, trial = start.copy(), np.zeros_like(start)
    k, work = np.zeros((4, n, STATES)), np.zeros((12, 3))
    u, terms, memory = np.zeros(n), np.zeros((6, n)), np.zeros(2)
    readings, clean = np.zeros((rows, c)), np.zeros((rows, c))
    history = np.zeros((rows * steps + 1, c))
    now, before, lagged, load = np.zeros(c), np.zeros(c), np.zeros(c), np.zeros(n)
    first_head = c - 1 - 2 * n
    for row in range(rows):
        if restart > 0 and row % restart == 0:
            y[:] = states[row]
        for step in range(steps):
            at = row * steps + step
            renewed = restart > 0 and step == 0 and row % restart == 0
            supply = rates(machine, y, u, terms, k[0], work)
            _true_channels(machine, y, supply, now)
            for j in range(c):
                if at == 0 or sensors.lag[j] == 0.0 or renewed:
                    lagged[j] = now[j]
                else:  # exact where the true value runs straight from step to step
                    behind = sensors.lag[j] * (now[j] - before[j]) / dt
                    fade = math.exp(-dt / sensors.lag[j])
                    lagged[j] = now[j] - behind + (lagged[j] - before[j] + behind) * fade
                before[j] = now[j]
                history[at, j] = lagged[j]
            if step == 0:
                for j in range(c):
                    back = max(0.0, at - sensors.delay[j] / dt)
                    first = int(back)
                    part = back - first
                    value = history[first, j]
                    if part > 0.0:
                        value += part * (history[first + 1, j] - value)
                    value = sensors.scale[j] * value + sensors.offset[j]
                    clean[row, j] = value + sensors.drift[j] * row * period
                    value = clean[row, j] + noise[row, j]
                    if sensors.step[j] > 0.0:
                        value = sensors.step[j] * math.floor(value / sensors.step[j] + 0.5)
                    readings[row, j] = min(sensors.high[j], max(sensors.low[j], value))
                if restart == 0:
                    states[row] = y
                if closed:
                    for i in range(n):
                        force = gains[3, i] * readings[row, first_head + i]
                        force -= gains[4, i] * readings[row, first_head + n + i]
                        load[i] += (force - load[i]) * (gains[6, i] if row > 0 else 1.0)
                        speed = ahead[row, i] + gains[0, i] * (reference[row, i] - readings[row, i])
                        speed = arm[row, i] * speed - gains[5, i] * (force - load[i])
                        o = gains[3, i] * speed / gains[1, i]
                        o = o * (1.0 - gains[2, i]) + gains[2, i] * math.tanh(o / 0.01)
                        o = min(1.0, max(-1.0, o))
                        commands[row, i] = math.floor(o * 2048.0 + 0.5) / 2048.0
            for i in range(n):
                late = (at * dt - machine.drives.delay[i]) / period
                u[i] = _arrived(commands[:, i], late, closed)
                end = late + dt / period
                begun = end - math.floor(end - 1.0e-9)  # of a row, by this step's end
                if begun * period < dt:  # the command changes inside the step: its mean counts
                    after = _arrived(commands[:, i], end - 2.0e-9, closed)
                    u[i] += (after - u[i]) * begun * period / dt
            unknown_term(machine, y, u, supply, at * dt, memory, terms)
            _rk4(machine, y, u, terms, dt, k, trial, work)
    return readings, clean
