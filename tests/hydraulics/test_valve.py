"""Valves by direction and edge, compensators, counterbalance valves and supplies, each by hand."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hydrotele.hydraulics.actuator_layout import Slot, actuator_parameters
from hydrotele.hydraulics.circuit import (
    NO_EXTRA_STATES,
    SLOT_COUNT,
    circuit_scratch,
    solve_state_supplies,
    step_circuit,
)
from hydrotele.hydraulics.laws import counterbalance_opening, end_stop_force, spool_step, valve_opening
from hydrotele.hydraulics.supply import compute_supply_pressure_derivatives
from hydrotele.hydraulics.valve import axis_valve_opening, chamber_flows
from hydrotele.machine.machine import Supply
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import NO_TERMS

CAT = load_machine("cat215", "none")
CYLINDER = CAT.axes["boom"].cylinder
assert CYLINDER
TANK, SMOOTHING = 0.3e6, 5.0e4
CURVE = {"travel": (0.0, 0.2, 0.5, 1.0), "opening": (0.0, 0.02, 0.3, 0.8)}


def changed_machine(valve=None, supply=None, **axis):
    """The CAT 215 with other facts of its boom's valve and axis, and of its supply."""
    facts = CAT.model_dump()
    facts["axes"]["boom"]["valve"] |= valve or {}
    facts["axes"]["boom"] |= axis
    facts["supply"] |= supply or {}
    return type(CAT).model_validate(facts)


def record(**facts):
    """Actuator numbers of the boom alone."""
    numbers = actuator_parameters(changed_machine(**facts))["boom"].copy()
    numbers[Slot.COUNT] = 1
    return numbers


def g(drop):
    return drop / (drop**2 + SMOOTHING**2) ** 0.25


@pytest.mark.parametrize("spool", [-1.3, -0.5, -0.041, -0.04, 0.0, 0.03, 0.2, 1.0, 1.1])
def test_a_plain_valve_opens_as_the_law_says_to_the_last_bit(spool):
    assert axis_valve_opening(record(), 0, spool) == valve_opening(spool, 0.04)


def test_a_flow_curve_is_interpolated_and_goes_on_beyond_its_end():
    user = record(valve={"deadband": 0.1, "negative": {"curve": CURVE, "deadband": 0.0}})
    travel = np.linspace(0.0, 1.0, 41)
    found = [axis_valve_opening(user, 0, -t) for t in travel]
    np.testing.assert_allclose(found, -np.interp(travel, CURVE["travel"], CURVE["opening"]), rtol=1e-14, atol=1e-16)
    assert axis_valve_opening(user, 0, -1.2) == pytest.approx(-(0.8 + 0.2 * 0.5 / 0.5), rel=1e-12)
    assert axis_valve_opening(user, 0, 0.4) == valve_opening(0.4, 0.1), "the other direction is straight"


def test_eight_knots_fit_and_the_two_curves_do_not_touch():
    knots = tuple(np.linspace(0.0, 1.0, 8))
    shapes = [{"travel": knots, "opening": tuple(np.array(knots) ** p)} for p in (2, 3)]
    user = record(valve={"deadband": 0.0, "positive": {"curve": shapes[0]},
                         "negative": {"curve": shapes[1]}})  # fmt: skip
    for t in knots:
        assert axis_valve_opening(user, 0, t) == pytest.approx(t**2, abs=1e-15)
        assert axis_valve_opening(user, 0, -t) == pytest.approx(-(t**3), abs=1e-15)


@pytest.mark.parametrize("direction", [1, -1])
def test_every_edge_has_its_own_gain(direction):
    ratios = {"positive": {"inlet": 2.0, "outlet": 3.0}, "negative": {"inlet": 5.0, "outlet": 7.0}}
    user = record(valve=ratios)
    k = user[Slot.FLOW_GAIN] * 0.5
    q_head, q_rod, _, _ = chamber_flows(user, 0, 0.5 * direction, 20e6, 8e6, 5e6)
    if direction > 0:
        expected = 2.0 * k * g(12e6), -3.0 * k * g(5e6 - TANK)
    else:
        expected = -7.0 * k * g(8e6 - TANK), 5.0 * k * g(15e6)
    assert (q_head, q_rod) == pytest.approx(expected, rel=1e-12)


def test_a_compensated_valve_flows_by_its_opening_whatever_the_load():
    user = record(valve={"compensation": "pressure", "rated_pressure_drop": 1.5e6})
    flows = [chamber_flows(user, 0, 0.6, 28e6, load, 2e6)[0] for load in (1e6, 10e6, 26e6)]
    # rated flow at the rated drop; smoothing takes d^2 / (4 dp^2) = 3e-4 of it
    assert flows == pytest.approx([0.6 * 6.0e-3] * 3, rel=4e-4)
    short = chamber_flows(user, 0, 0.6, 28e6, 27.5e6, 2e6)[0]
    assert short == pytest.approx(0.6 * user[Slot.FLOW_GAIN] * g(0.5e6), rel=1e-12)


def test_a_counterbalance_valve_holds_until_the_pilot_opens_it():
    held = {"head": {"setting": 24e6, "pilot_ratio": 3.0, "override": 0.25}}
    user, plain = record(load_holding=held), record()
    free = chamber_flows(plain, 0, -1.0, 20e6, 12e6, 5e6)
    for pilot, share in ((3.0e6, 0.0), (4.0e6, 0.0), (5.0e6, 0.5), (6.0e6, 1.0), (9.0e6, 1.0)):
        out = chamber_flows(user, 0, -1.0, 20e6, 12e6, pilot)[0]
        assert out == pytest.approx(share * free[0], rel=1e-12)
    assert chamber_flows(user, 0, 1.0, 20e6, 12e6, 5e6) == chamber_flows(plain, 0, 1.0, 20e6, 12e6,
                                                                         5e6)  # fmt: skip
    assert chamber_flows(user, 0, -1.0, 20e6, 0.1e6, 5e6)[0] > 0, "its check lets oil in"


@pytest.mark.parametrize("spool", [-0.5, 0.0, 0.5])
def test_a_spool_leaks_to_tank_at_any_opening(spool):
    leak = 2.7e-14
    opening = axis_valve_opening(record(), 0, spool)
    flows = np.array(chamber_flows(record(), 0, opening, 20e6, 12e6, 5e6))
    leaky = np.array(chamber_flows(record(valve={"tank_leakage": leak}), 0, opening, 20e6, 12e6,
                                   5e6))  # fmt: skip
    expected = -leak * np.array([12e6 - TANK, 5e6 - TANK, 1.0, 1.0])
    # rounding of the flow through the open edge, 3e-3 m^3/s
    np.testing.assert_allclose(leaky - flows, expected, rtol=1e-9, atol=1e-18)


def test_a_counterbalance_valve_holds_back_what_the_spool_leaks():
    held = {"head": {"setting": 24e6, "pilot_ratio": 3.0, "override": 0.25}}
    user = record(load_holding=held, valve={"tank_leakage": 1e-13})
    assert chamber_flows(user, 0, 0.0, 20e6, 12e6, TANK)[0] == 0.0
    assert chamber_flows(user, 0, 0.0, 20e6, 12e6, 5e6)[0] == pytest.approx(-0.5e-13 * (12e6 - TANK))
    assert chamber_flows(user, 0, 0.0, 20e6, 0.1e6, TANK)[0] > 0, "its check lets oil in"


def test_slopes_of_the_flows_are_their_derivatives():
    held = {"head": {"setting": 24e6}, "rod": {"setting": 20e6}}
    drop = {"compensation": "pressure", "compensated_drop": 9e6, "tank_leakage": 1e-10}
    user = record(load_holding=held, valve=drop)
    for opening in (0.7, -0.7):
        for head, rod in ((12e6, 5e6), (9e6, 5.5e6), (4.5e6, 11e6)):
            _, _, *slopes = chamber_flows(user, 0, opening, 19e6, head, rod)
            step = 1.0  # Pa: far from the kinks, and 1e-6 of what is computed
            up = chamber_flows(user, 0, opening, 19e6, head + step, rod)[0]
            down = chamber_flows(user, 0, opening, 19e6, head - step, rod)[0]
            assert slopes[0] == pytest.approx((up - down) / 2, rel=1e-4, abs=1e-15)
            up = chamber_flows(user, 0, opening, 19e6, head, rod + step)[1]
            down = chamber_flows(user, 0, opening, 19e6, head, rod - step)[1]
            assert slopes[1] == pytest.approx((up - down) / 2, rel=1e-4, abs=1e-15)


def test_a_held_load_comes_down_as_fast_as_the_pilot_allows():
    """Steady lowering under a constant load: pressures from the flow balance, solved by hand."""
    user = record(load_holding={"head": {"setting": 20e6, "pilot_ratio": 4.0, "override": 0.2}},
                  supply={"kind": "constant_pressure", "pump_flow": 1.0e3},
                  valve={"negative": {"outlet": 3.0}})  # fmt: skip
    head, rod, load = user[Slot.AREA_HEAD], user[Slot.AREA_ROD], 250e3
    k, o = user[Slot.FLOW_GAIN], (0.5 - 0.04) / 0.96

    def speed(p_rod):  # of the oil that enters the rod side
        return k * o * g(28e6 - p_rod) / rod

    def excess(p_rod):
        p_head = (load + rod * p_rod) / head
        share = np.clip((p_head + 4.0 * p_rod - 20e6) / 4e6, 0.0, 1.0)
        return share * 3.0 * k * o * g(p_head - TANK) / head - speed(p_rod)

    p_rod = brentq(excess, 0.4e6, 27e6)
    p_head = (load + rod * p_rod) / head
    assert 0.0 < counterbalance_opening(p_head, p_rod, 20e6, 4.0, 4e6)[0] < 1.0
    user[Slot.LEAKAGE], v = 0.0, -speed(p_rod)
    act, rate = np.array([-0.5, 0.0, p_head, p_rod]), np.zeros(4)
    # both chambers must be in balance: no rate, within rounding of beta / V times the flow
    drives = Drives(1, act, np.array([0.5 + 1e-4 * v]), np.array([v]), np.array([-0.5]))
    step_circuit(user, 0, drives, 1e-4, rate, circuit_scratch(), NO_TERMS, 0.0, NO_EXTRA_STATES)
    stiff = user[Slot.BULK_MODULUS] / user[Slot.VOLUME_HEAD] * head * abs(v)
    assert np.abs(rate[2:]).max() < 1e-9 * stiff


def test_the_step_converges_with_second_order_where_everything_is_in_it():
    """Directions, edges, curve, compensator, holding and droop, against scipy."""
    facts = dict(
        valve={"compensation": "pressure", "compensated_drop": 6e6, "deadband": 0.0,
               "positive": {"inlet": 0.8, "outlet": 0.6, "curve": CURVE}},
        load_holding={"rod": {"setting": 30e6, "pilot_ratio": 2.0, "override": 0.9}},
        supply={"pump_droop": 4e-11, "pump_flow": 2.4e-3},
    )  # fmt: skip
    user = record(**facts)
    k, beta = user[Slot.FLOW_GAIN], user[Slot.BULK_MODULUS]
    head, rod, leak = user[Slot.AREA_HEAD], user[Slot.AREA_ROD], user[Slot.LEAKAGE]
    x0, v, command = 0.4, 0.05, 0.9

    def rhs(t, y):
        s, rate, p_a, p_b = y
        o = np.interp(s, CURVE["travel"], CURVE["opening"])

        def fed(p_s):
            return 0.8 * k * o * g(np.clip(p_s - p_a, 0.0, 6e6))

        def excess(p_s):
            return fed(p_s) - (2.4e-3 - 4e-11 * p_s)

        p_s = 28e6 if excess(28e6) <= 0 else brentq(excess, p_a, 28e6, xtol=1e-7)
        share = np.clip((p_b + 2.0 * p_a - 30e6) / 27e6, 0.0, 1.0)
        q_b = -share * 0.6 * k * o * g(p_b - TANK)
        x, leaked = x0 + v * t, leak * (p_a - p_b)
        return [
            rate, user[Slot.BANDWIDTH] ** 2 * (command - s) - 1.8 * user[Slot.BANDWIDTH] * rate,
            beta / (user[Slot.VOLUME_HEAD] + head * x) * (fed(p_s) - head * v - leaked),
            beta / (user[Slot.VOLUME_ROD] + rod * (1.05 - x)) * (q_b + rod * v + leaked),
        ]  # fmt: skip

    start = [0.55, 0.0, 15e6, 8e6]
    exact = solve_ivp(rhs, (0, 0.032), start, "Radau", rtol=1e-10, atol=1e-6).y[:, -1]
    errors = []
    for dt in (1e-3, 5e-4, 2.5e-4, 1.25e-4):
        act, rate, scratch = np.array(start), np.zeros(4), circuit_scratch()
        for n in range(round(0.032 / dt)):
            x = np.array([x0 + (n + 1) * dt * v])
            drives = Drives(1, act, x, np.array([v]), np.array([command]))
            step_circuit(user, 0, drives, dt, rate, scratch, NO_TERMS, 0.0, NO_EXTRA_STATES)
            act = act + dt * rate
        errors.append(np.abs(act - exact)[2:].max())
    # 2 in the limit; a kink of the curve or the compensator inside a step costs some of it
    assert np.log2(errors[0] / errors[-1]) / 3 > 1.5, errors
    assert errors[0] < 1e-3 * 28e6


@pytest.mark.nightly
@pytest.mark.parametrize(("bandwidth", "limit", "dt"), [(50.0, 3.0, 1e-3), (200.0, 10.0, 5e-3)])
def test_a_slew_limited_spool_follows_the_saturated_equation(bandwidth, limit, dt):
    """w^2 (u - s) - 2 z w s', with s' held at the limit while the equation asks for more."""

    def rhs(t, y):
        e, v = y
        pull = -(bandwidth**2) * e - 1.8 * bandwidth * v
        return [v, 0.0 if v >= limit and pull > 0.0 else pull]

    # up to the limit, then at it, then free again: each piece is smooth
    steps = {"max_step": 1e-5, "rtol": 1e-8, "method": "RK23"}  # so short that third order is exact
    there, end = 1.0 + solve_ivp(rhs, (0, 0.4), [-1.0, 0.0], t_eval=[0.1, 0.4], **steps).y[0]
    s, v, fastest = 0.0, 0.0, 0.0
    for _ in range(round(0.4 / dt)):
        s, v = spool_step(s, v, 1.0, bandwidth, 0.9, dt, limit)
        fastest = max(fastest, abs(v))
    assert fastest == limit
    assert s == pytest.approx(end, abs=2e-3)  # the limit is met within a step
    halfway = 0.0, 0.0
    for _ in range(round(0.1 / dt)):
        halfway = spool_step(*halfway, 1.0, bandwidth, 0.9, dt, limit)
    assert halfway[0] == pytest.approx(there, abs=limit * dt)  # one step at the limit


def supply_of(act, **supply):
    user = np.concatenate(list(actuator_parameters(changed_machine(supply=supply)).values()))
    ports = circuit_scratch()
    act = np.array(act, float)
    return solve_state_supplies(user, 0, 3, act, ports), user, ports


CALM = [0.0, 0, 9e6, 9e6, 0.1, 0, 8e6, 5e6, -0.08, 0, 6e6, 7e6]
STANDING = [0.0, 0, 9e6, 9e6] * 3
GREEDY = [1.0, 0, 9e6, 9e6, 1.0, 0, 8e6, 5e6, -1.0, 0, 6e6, 7e6]


def test_a_load_sensing_pump_stays_above_the_highest_load():
    given = {"kind": "load_sensing", "load_sensing_margin": 1.5e6}
    assert supply_of(CALM, **given)[0] == 9.5e6
    assert supply_of(STANDING, **given)[0] == TANK + 1.5e6
    heavy = [*CALM[:6], 27e6, *CALM[7:]]
    assert supply_of(heavy, **given)[0] == 28e6, "the relief valve limits it"
    pressure, user, ports = supply_of(GREEDY, **given)
    drawn = sum(ports[4 * i] * g(max(0.0, pressure - ports[4 * i + 1])) for i in range(3))
    assert pressure < 10.5e6 and drawn == pytest.approx(user[Slot.PUMP_FLOW], rel=1e-9)


def test_a_constant_pressure_supply_has_no_limit():
    given = {"kind": "constant_pressure", "pump_flow": 1.0e3}
    assert supply_of(GREEDY, **given)[0] == supply_of(STANDING, **given)[0] == 28e6
    assert supply_of(GREEDY)[0] < 20e6, "the pump of the machine is far from that"


def test_a_drooping_pump_gives_less_the_higher_its_pressure():
    droop = 6e-11
    pressure, user, ports = supply_of(GREEDY, pump_droop=droop)
    drawn = sum(ports[4 * i] * g(max(0.0, pressure - ports[4 * i + 1])) for i in range(3))
    assert drawn == pytest.approx(user[Slot.PUMP_FLOW] - droop * pressure, rel=1e-9)
    assert pressure < supply_of(GREEDY)[0]
    assert supply_of(STANDING, pump_droop=droop)[0] == 28e6


def test_a_relief_valve_with_an_override_holds_more_the_more_flows_over_it():
    override = 8e8
    flow = CAT.supply.pump_flow if CAT.supply else math.nan
    assert supply_of(STANDING, relief_override=override)[0] == 28e6 + override * flow
    assert supply_of(GREEDY, relief_override=override)[0] == supply_of(GREEDY)[0] < 28e6
    pressure, user, ports = supply_of(CALM, relief_override=override)
    drawn = sum(ports[4 * i] * g(max(0.0, pressure - ports[4 * i + 1])) for i in range(3))
    assert 28e6 < pressure < 28e6 + override * flow
    assert pressure == pytest.approx(28e6 + override * (user[Slot.PUMP_FLOW] - drawn), rel=1e-9)


@pytest.mark.parametrize("act", [CALM, GREEDY])
def test_the_supply_follows_the_chambers_with_an_override_as_its_coupling_says(act):
    given = {"relief_override": 8e8}
    pressure, user, ports = supply_of(act, **given)
    slopes = np.zeros(len(ports))
    assert compute_supply_pressure_derivatives(user, 0, 3, ports, pressure, 0.0, slopes)
    for i in range(3):
        side = 2 if act[4 * i] > 0.0 else 3
        moved = [list(act), list(act)]
        moved[0][4 * i + side] += 1e3
        moved[1][4 * i + side] -= 1e3
        above, below = (supply_of(other, **given)[0] for other in moved)
        found = (above - below) / 2e3
        assert slopes[4 * i + 3] == pytest.approx(found, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"kind": "load_sensing", "relief_override": 1e8}, "no flow through its relief valve"),
        ({"kind": "constant_pressure", "pump_flow": 5e-3}, "has no pump_flow"),
        ({"pump_flow": 1.0e3}, "pump_flow is missing"),
        ({"pump_droop": 2e-10}, "reduces pump_flow .* to 0 below"),
    ],
)
def test_impossible_supplies_are_refused(facts, message):
    assert CAT.supply
    with pytest.raises(ValueError, match=message):
        Supply.model_validate(CAT.supply.model_dump() | facts)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        ({"travel": [0, 1], "opening": [0, 0.5, 1]}, "2 to 8 knots"),
        ({"travel": [0.1, 1], "opening": [0, 1]}, "must increase from 0 to 1"),
        ({"travel": [0, 0.5, 1], "opening": [0, 0.6, 0.5]}, "never decrease"),
    ],
)
def test_impossible_curves_are_refused(curve, message):
    with pytest.raises(ValueError, match=message):
        changed_machine(valve={"positive": {"curve": curve}})


def test_chambers_keep_their_volume_beyond_the_ends():
    user = record()
    for x, v in ((-0.3, -0.2), (1.35, 0.2)):  # far enough to empty a chamber of 4 litres
        act, rate = np.array([0.0, 0.0, 4e6, 4e6]), np.zeros(4)
        for _ in range(200):
            drives = Drives(1, act, np.array([x]), np.array([v]), np.zeros(1))
            step_circuit(user, 0, drives, 1e-3, rate, circuit_scratch(), NO_TERMS, 0.0, NO_EXTRA_STATES)
            act = act + 1e-3 * rate
        assert np.isfinite(act).all()
        squeezed = act[2] if v < 0 else act[3]
        swept = user[Slot.AREA_HEAD if v < 0 else Slot.AREA_ROD] * abs(v)
        assert squeezed == pytest.approx(32e6 + swept / 1e-9, rel=0.01), "over the port relief"
        np.testing.assert_array_equal(
            CYLINDER.chamber_volumes(np.array([x])),
            CYLINDER.chamber_volumes(np.array([0.0 if x < 0 else 1.05])),
        )


def test_stops_push_and_never_pull():
    assert end_stop_force(0.5, 9.0, 0.0, 1.0, 1e8, 1e6) == (0.0, 0.0, 0.0)
    assert end_stop_force(-1e-3, 0.0, 0.0, 1.0, 1e8, 1e6)[0] == pytest.approx(1e5)
    assert end_stop_force(1.001, 0.05, 0.0, 1.0, 1e8, 1e6)[0] == pytest.approx(-1.5e5)
    assert end_stop_force(1.001, -0.2, 0.0, 1.0, 1e8, 1e6) == (0.0, 0.0, 0.0), "it lets go"


def test_stroke_and_joint_range_end_the_travel():
    numbers = actuator_parameters(CAT)
    assert numbers["swing"][Slot.STOP_STIFFNESS] == 0.0, "it turns without end"
    low, high = numbers["boom"][Slot.STOP_LOW], numbers["boom"][Slot.STOP_HIGH]
    assert 0.0 < low < 0.1 and 1.04 < high < 1.05, "-42 .. 58 deg lie inside the stroke"
    force = 28e6 * CYLINDER.area_head
    assert numbers["boom"][Slot.STOP_STIFFNESS] == pytest.approx(force / 1e-3)
    assert len(numbers["boom"]) == SLOT_COUNT
