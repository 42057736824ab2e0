"""The hydraulic circuit: several valves, chambers and one shared supply, advanced by one step.

Pure functions on flat arrays laid out as MuJoCo keeps them, so that the native callbacks, the
tests and an estimator run the same code. Axis `i` reads its numbers at `user[i * SLOTS + Slot]` and
its activations `spool, spool_rate, p_head, p_rod` at `act[4 i ...]`, counted from the first
hydraulic axis.
"""

import enum
import math

import numpy as np

from hydrotele.compiled import compiled
from hydrotele.hydraulics.laws import (
    friction,
    friction_slope,
    orifice,
    port_flow,
    spool_step,
    valve_opening,
)

CURVE_KNOTS = 8  # of a valve's flow curve, per direction


class Slot(enum.IntEnum):
    """Places of an actuator's numbers in `actuator_user`, all SI; a new number is a new line.

    CURVES, the last, begins two flow curves, of the positive and of the negative direction: number
    of knots (0: straight), CURVE_KNOTS travels and CURVE_KNOTS openings each.
    """

    @staticmethod
    def _generate_next_value_(name, start, count, last_values):
        return count

    MARKER = enum.auto()
    KIND = enum.auto()
    FIRST = enum.auto()
    COUNT = enum.auto()
    AREA_HEAD = enum.auto()
    AREA_ROD = enum.auto()
    VOLUME_HEAD = enum.auto()
    VOLUME_ROD = enum.auto()
    STROKE = enum.auto()
    LEAKAGE = enum.auto()
    BANDWIDTH = enum.auto()
    DAMPING = enum.auto()
    DEADBAND = enum.auto()
    FLOW_GAIN = enum.auto()
    ORIFICE_SMOOTHING = enum.auto()
    PORT_RELIEF = enum.auto()
    RELIEF_GAIN = enum.auto()
    MAKEUP_GAIN = enum.auto()
    BULK_MODULUS = enum.auto()
    TANK_PRESSURE = enum.auto()
    RELIEF_PRESSURE = enum.auto()
    PUMP_FLOW = enum.auto()
    COULOMB = enum.auto()
    STRIBECK = enum.auto()
    STRIBECK_VELOCITY = enum.auto()
    VISCOUS = enum.auto()
    COULOMB_VELOCITY = enum.auto()
    OFFSET = enum.auto()
    COULOMB_ASYMMETRY = enum.auto()
    VISCOUS_ASYMMETRY = enum.auto()
    HOSE_COMPLIANCE = enum.auto()
    DRIVE_INERTIA = enum.auto()
    DEADBAND_NEGATIVE = enum.auto()
    SLEW_LIMIT = enum.auto()
    METERING_PA = enum.auto()
    METERING_BT = enum.auto()
    METERING_PB = enum.auto()
    METERING_AT = enum.auto()
    COMPENSATED_DROP = enum.auto()
    HOLDING_HEAD = enum.auto()
    HOLDING_HEAD_RATIO = enum.auto()
    HOLDING_HEAD_RANGE = enum.auto()
    HOLDING_ROD = enum.auto()
    HOLDING_ROD_RATIO = enum.auto()
    HOLDING_ROD_RANGE = enum.auto()
    LOAD_SENSING_MARGIN = enum.auto()
    PUMP_DROOP = enum.auto()
    STOP_LOW = enum.auto()
    STOP_HIGH = enum.auto()
    STOP_STIFFNESS = enum.auto()
    STOP_DAMPING = enum.auto()
    CURVES = enum.auto()


CURVE = 1 + 2 * CURVE_KNOTS  # numbers of one flow curve
SLOTS = Slot.CURVES + 2 * CURVE
ACTIVATIONS = 4
MAX_AXES = 8
SCRATCH = 4 * MAX_AXES


class Kind(enum.IntEnum):
    """What an actuator is: a cylinder, a rotary motor or a plain force drive with friction."""

    CYLINDER = 1
    MOTOR = 2
    FORCE = 3


_ROS2 = 1.0 + 1.0 / math.sqrt(2.0)  # L-stable, of second order with any approximate Jacobian
_NEWTON_STEPS = 60
_FLOW_TOLERANCE = 1.0e-12  # of the pump flow: far below the flow balance of 1e-6 that is promised

_AH, _AR = int(Slot.AREA_HEAD), int(Slot.AREA_ROD)
_VH, _VR = int(Slot.VOLUME_HEAD), int(Slot.VOLUME_ROD)
_STROKE, _LEAK = int(Slot.STROKE), int(Slot.LEAKAGE)
_W, _Z = int(Slot.BANDWIDTH), int(Slot.DAMPING)
_DB, _K = int(Slot.DEADBAND), int(Slot.FLOW_GAIN)
_D, _PORT = int(Slot.ORIFICE_SMOOTHING), int(Slot.PORT_RELIEF)
_KR, _KM = int(Slot.RELIEF_GAIN), int(Slot.MAKEUP_GAIN)
_BETA, _TANK = int(Slot.BULK_MODULUS), int(Slot.TANK_PRESSURE)
_RELIEF, _PUMP = int(Slot.RELIEF_PRESSURE), int(Slot.PUMP_FLOW)
_FC, _FS = int(Slot.COULOMB), int(Slot.STRIBECK)
_VS, _B = int(Slot.STRIBECK_VELOCITY), int(Slot.VISCOUS)
_V0, _AC = int(Slot.COULOMB_VELOCITY), int(Slot.COULOMB_ASYMMETRY)
_AV, _HOSE = int(Slot.VISCOUS_ASYMMETRY), int(Slot.HOSE_COMPLIANCE)


@compiled
def supply_pressure(ports, count, smoothing, relief, pump_flow):
    """Largest pressure up to the relief setting at which the valves draw no more than the pump.

    Solves `sum_i k_i g(p_s - p_i) = Q_pump` over the valves whose load check is open, by Newton's
    method in `sqrt(p_s - min p_i)` inside a bracket, which is halved where Newton fails.

    Args:
        ports: (>= 4 count,) per axis `k_i` [m^3/(s sqrt(Pa))], `p_i` [Pa] and two unused places.
        count: number of axes.
        smoothing: orifice smoothing d, scalar [Pa].
        relief: relief setting, scalar [Pa].
        pump_flow: Q_pump, scalar [m^3/s].

    Returns:
        p_s, scalar [Pa].

    Source: nominal model, "Supply".

    >>> import numpy as np
    >>> one_valve = np.array([2.0e-6, 5.0e6, 0.0, 0.0])
    >>> round(supply_pressure(one_valve, 1, 5.0e4, 28.0e6, 5.0e-3) / 1e6, 3)
    11.25
    """
    low, high, p, last = relief, relief, relief, math.inf
    for i in range(count):
        if ports[4 * i] > 0.0:
            low = min(low, ports[4 * i + 1])
    floor = low
    for _ in range(_NEWTON_STEPS):
        demand, slope = 0.0, 0.0
        for i in range(count):
            drop = p - ports[4 * i + 1]
            if drop > 0.0 and ports[4 * i] > 0.0:
                flow, gain = orifice(drop, ports[4 * i], smoothing)
                demand += flow
                slope += gain
        excess = demand - pump_flow
        if excess > 0.0:
            high = p
        elif p == relief:
            return relief
        else:
            low = p
        if abs(excess) <= _FLOW_TOLERANCE * pump_flow or high - low <= 1.0e-15 * relief:
            return p
        root = math.sqrt(p - floor) if p > floor else 0.0
        guess = -1.0
        if slope > 0.0 and root > 0.0 and abs(excess) < 0.5 * last:  # else Newton may cycle
            root -= excess / (2.0 * slope * root)
            if root > 0.0:
                guess = floor + root * root
        last = abs(excess)
        p = guess if low < guess < high else 0.5 * (low + high)
    return p


@compiled
def open_ports(user, act, spool, ports, first, count, ahead, rate):
    """Flow gain and supply-side pressure of every axis, for `supply_pressure`.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        act: (4 count,) activations; pressures [Pa].
        spool: (4 count,) array whose every fourth entry is the spool position to use [1].
        ports: (>= 4 count,) written: `k_i` [m^3/(s sqrt(Pa))], `p_i` [Pa].
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators.
        ahead: time to look ahead with `rate`, scalar [s].
        rate: (4 count,) array with pressure rates at places 2 and 3 of every axis [Pa/s].

    Returns:
        Nothing; `ports` is filled.

    Source: nominal model, "Orifice".
    """
    for i in range(count):
        u = (first + i) * SLOTS
        opening = valve_opening(spool[4 * i], user[u + _DB])
        ports[4 * i] = user[u + _K] * abs(opening)
        side = 2 if opening > 0.0 else 3
        ports[4 * i + 1] = act[4 * i + side]
        if ahead != 0.0:
            ports[4 * i + 1] += ahead * rate[4 * i + side]


@compiled
def chamber_flows(user, u, opening, p_supply, p_head, p_rod):
    """Valve flows into both chambers of an axis and their slopes.

    With o > 0 the head side is fed through its load check and the rod side drains to tank; with
    o < 0 the other way round.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        opening: o, scalar [1].
        p_supply: scalar [Pa].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].

    Returns:
        (q_head, q_rod [m^3/s], d q_head/d p_head, d q_rod/d p_rod [m^3/(s Pa)]).

    Source: nominal model, "Orifice".
    """
    if opening == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    gain, smoothing = user[u + _K] * abs(opening), user[u + _D]
    tank = user[u + _TANK]
    q_in, slope_in = 0.0, 0.0
    if opening > 0.0:
        if p_supply > p_head:
            q_in, slope_in = orifice(p_supply - p_head, gain, smoothing)
        q_out, slope_out = orifice(p_rod - tank, gain, smoothing)
        return q_in, -q_out, -slope_in, -slope_out
    if p_supply > p_rod:
        q_in, slope_in = orifice(p_supply - p_rod, gain, smoothing)
    q_out, slope_out = orifice(p_head - tank, gain, smoothing)
    return -q_out, q_in, -slope_out, -slope_in


@compiled
def pressure_rates(user, u, opening, p_supply, p_head, p_rod, x, v, ahead):
    """Pressure rates of both chambers and their slopes with respect to their own pressure.

    `p_A' = (beta / V_A)(q_A - A_h v - q_l + r_A)`, `p_B' = (beta / V_B)(q_B + A_r v + q_l + r_B)`,
    where a hose of compliance C_h counts as `beta C_h` of volume.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        u: place of this axis in `user`.
        opening: o, scalar [1].
        p_supply: scalar [Pa].
        p_head: scalar [Pa].
        p_rod: scalar [Pa].
        x: piston displacement, scalar [m] (0 for a motor, whose volumes are constant).
        v: piston velocity, scalar [m/s] or [rad/s].
        ahead: time over which the slopes must hold, scalar [s]: a relief or make-up valve that
            would open within it counts as open in the slope (not in the rate).

    Returns:
        (p_head', p_rod' [Pa/s], d p_head'/d p_head, d p_rod'/d p_rod [1/s]).

    Source: nominal model, "Chambers".
    """
    q_head, q_rod, slope_head, slope_rod = chamber_flows(user, u, opening, p_supply, p_head, p_rod)
    leak = user[u + _LEAK] * (p_head - p_rod)
    port, relief_gain = user[u + _PORT], user[u + _KR]
    tank, makeup_gain = user[u + _TANK], user[u + _KM]
    r_head, k_head = port_flow(p_head, port, relief_gain, tank, makeup_gain)
    r_rod, k_rod = port_flow(p_rod, port, relief_gain, tank, makeup_gain)
    beta = user[u + _BETA]
    swept_head, swept_rod = user[u + _AH], user[u + _AR]
    volume_head, volume_rod = user[u + _VH], user[u + _VR]
    if user[u + 1] == 1.0:  # Kind.CYLINDER
        volume_head += swept_head * x
        volume_rod += swept_rod * (user[u + _STROKE] - x)
    hose = beta * user[u + _HOSE]
    head, rod = beta / (volume_head + hose), beta / (volume_rod + hose)
    rate_head = head * (q_head - swept_head * v - leak + r_head)
    rate_rod = rod * (q_rod + swept_rod * v + leak + r_rod)
    if k_head == 0.0:
        _, k_head = port_flow(p_head + ahead * rate_head, port, relief_gain, tank, makeup_gain)
    if k_rod == 0.0:
        _, k_rod = port_flow(p_rod + ahead * rate_rod, port, relief_gain, tank, makeup_gain)
    return (
        rate_head,
        rate_rod,
        head * (slope_head + k_head - user[u + _LEAK]),
        rod * (slope_rod + k_rod - user[u + _LEAK]),
    )


@compiled
def step_circuit(user, first, count, act, command, length, velocity, dt, act_dot, scratch):
    """Advance spools and chamber pressures of all axes that share a supply by one step.

    Spools follow their exact exponential; pressures take one step of the L-stable second-order
    Rosenbrock method ROS2 with a diagonal Jacobian, with piston velocities held over the step. The
    supply pressure is solved in both stages.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        first: index of the first hydraulic actuator.
        count: number of hydraulic actuators, <= MAX_AXES.
        act: (4 count,) spool [1], spool rate [1/s] and pressures [Pa] at the start of the step.
        command: (nu,) valve commands, clipped here to [-1, 1] [1].
        length: (nu,) piston displacements x at the end of the step, where MuJoCo's leapfrog has
            them [m] (joint angle for a motor).
        velocity: (nu,) piston velocities [m/s] or [rad/s].
        dt: step, scalar [s].
        act_dot: (4 count,) written: mean rates over the step, in the unit of `act` per [s].
        scratch: (SCRATCH,) work space.

    Returns:
        (supply pressure at the start of the step [Pa], at its end [Pa]).

    Source: nominal model; ROS2: Verwer et al. 1999, SIAM J. Sci. Comput. 20(4), Eq. 2.6.
    """
    gamma_h = _ROS2 * dt
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        bounded = min(1.0, max(-1.0, command[first + i]))
        act_dot[a], act_dot[a + 1] = spool_step(
            act[a], act[a + 1], bounded, user[u + _W], user[u + _Z], dt
        )
    shared = first * SLOTS
    relief, pump, smoothing = user[shared + _RELIEF], user[shared + _PUMP], user[shared + _D]
    open_ports(user, act, act, scratch, first, count, 0.0, act_dot)
    p_start = supply_pressure(scratch, count, smoothing, relief, pump)
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        head, rod, j_head, j_rod = pressure_rates(
            user, u, valve_opening(act[a], user[u + _DB]), p_start, act[a + 2], act[a + 3],
            length[first + i] - dt * velocity[first + i], velocity[first + i], dt,
        )  # fmt: skip
        scratch[a + 2] = 1.0 / (1.0 - gamma_h * j_head)
        scratch[a + 3] = 1.0 / (1.0 - gamma_h * j_rod)
        act_dot[a + 2] = head * scratch[a + 2]
        act_dot[a + 3] = rod * scratch[a + 3]
    open_ports(user, act, act_dot, scratch, first, count, dt, act_dot)
    p_end = supply_pressure(scratch, count, smoothing, relief, pump)
    for i in range(count):
        u, a = (first + i) * SLOTS, 4 * i
        k_head, k_rod = act_dot[a + 2], act_dot[a + 3]
        head, rod, _, _ = pressure_rates(
            user, u, valve_opening(act_dot[a], user[u + _DB]), p_end,
            act[a + 2] + dt * k_head, act[a + 3] + dt * k_rod,
            length[first + i], velocity[first + i], 0.0,
        )  # fmt: skip
        act_dot[a + 2] = 1.5 * k_head + 0.5 * scratch[a + 2] * (head - 2.0 * k_head)
        act_dot[a + 3] = 1.5 * k_rod + 0.5 * scratch[a + 3] * (rod - 2.0 * k_rod)
        act_dot[a] = (act_dot[a] - act[a]) / dt
        act_dot[a + 1] = (act_dot[a + 1] - act[a + 1]) / dt
    return p_start, p_end


@compiled
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


@compiled
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


@compiled
def axis_state(user, i, supply, act, x, v):
    """Flows and force of one axis in a state, for logs and balances.

    Args:
        user: (nu * SLOTS,) actuator numbers.
        i: index of the actuator.
        supply: supply pressure, scalar [Pa].
        act: (4,) spool [1], spool rate [1/s], p_head, p_rod [Pa].
        x: piston displacement, scalar [m].
        v: piston velocity, scalar [m/s] or [rad/s].

    Returns:
        (q_head, q_rod [m^3/s], force or torque after friction [N] or [N m]).

    Source: nominal model, "Orifice" and "Piston force".
    """
    u = i * SLOTS
    opening = valve_opening(act[0], user[u + _DB])
    q_head, q_rod, _, _ = chamber_flows(user, u, opening, supply, act[2], act[3])
    force = user[u + _AH] * act[2] - user[u + _AR] * act[3] - actuator_friction(user, u, v)
    return q_head, q_rod, force


def circuit_scratch() -> np.ndarray:
    """Work space for `step_circuit`, shape (SCRATCH,)."""
    return np.zeros(SCRATCH)
