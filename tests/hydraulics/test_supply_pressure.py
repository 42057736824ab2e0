"""The shared supply: the valves draw what the pump gives, or the relief holds the pressure."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hydrotele.hydraulics.circuit import (
    SLOT_COUNT,
    Slot,
    axis_flows_and_force,
    circuit_scratch,
    compute_inlet_conditions,
    solve_supply_pressure,
)

RELIEF, SMOOTHING = 28.0e6, 5.0e4
GAINS = st.one_of(st.just(0.0), st.floats(1e-9, 1e-5))  # [m^3/(s sqrt(Pa))], rated 2.3e-6
LOADS = st.floats(-1e6, 36e6)  # [Pa], from cavitation to above the port relief
VALVES = st.lists(st.tuples(GAINS, LOADS), min_size=1, max_size=8)
PUMPS = st.floats(1e-5, 2e-2)  # [m^3/s], nominal 5e-3


def solve(valves, pump_flow):
    ports = np.zeros(4 * len(valves))
    for i, (gain, load) in enumerate(valves):
        ports[4 * i : 4 * i + 2] = gain, load
    return solve_supply_pressure(ports, len(valves), SMOOTHING, RELIEF, pump_flow)


def demand(valves, pressure):
    """Flow through all open load checks, [m^3/s], written anew from the nominal model."""
    total = 0.0
    for gain, load in valves:
        drop = max(0.0, pressure - load)
        total += gain * drop / (drop**2 + SMOOTHING**2) ** 0.25
    return total


@given(VALVES, PUMPS)
def test_demand_is_the_pump_flow_or_the_relief_holds(valves, pump_flow):
    pressure = solve(valves, pump_flow)
    assert pressure <= RELIEF
    if demand(valves, RELIEF) <= pump_flow:
        assert pressure == RELIEF
    else:
        # a pressure is known to 1e-16 of 28 MPa, which is 4e-9 Pa; near zero drop the flow of the
        # largest valves follows it with the slope k / sqrt(d)
        rounding = 1e-15 * RELIEF * sum(gain for gain, _ in valves) / SMOOTHING**0.5
        assert demand(valves, pressure) == pytest.approx(pump_flow, rel=1e-9, abs=rounding)


@given(VALVES, PUMPS, st.floats(1.0, 3.0), st.integers(0, 7))
def test_pressure_falls_with_opening_and_rises_with_pump_flow(valves, pump_flow, more, which):
    pressure = solve(valves, pump_flow)
    slack = 1e-9 * RELIEF  # the flow balance of 1e-12 met with the flattest slope above
    assert solve(valves, pump_flow * more) >= pressure - slack
    gain, load = valves[which % len(valves)]
    wider = [*valves]
    wider[which % len(valves)] = (gain * more, load)
    assert solve(wider, pump_flow) <= pressure + slack
    wider[which % len(valves)] = (gain, load * more if load > 0 else load)
    assert solve(wider, pump_flow) >= pressure - slack


@given(st.lists(st.tuples(GAINS, st.floats(RELIEF, 36e6)), min_size=1, max_size=8), PUMPS)
def test_relief_pressure_with_all_load_checks_closed(valves, pump_flow):
    assert solve(valves, pump_flow) == RELIEF


def test_relief_pressure_with_all_valves_closed():
    assert solve([(0.0, 0.0), (0.0, 30e6)], 5e-3) == RELIEF


def test_closed_valve_draws_nothing():
    assert solve([(2e-6, 5e6), (0.0, -1e6)], 5e-3) == solve([(2e-6, 5e6)], 5e-3)


def test_one_valve_has_the_pressure_of_the_square_root_law():
    pressure = solve([(2.0e-6, 5.0e6)], 5.0e-3)
    # (Q / k)^2 = 6.25 MPa above the load; smoothing adds d^2 / (2 dp) = 200 Pa
    assert pressure == pytest.approx(5.0e6 + 6.25e6 + 200.0, abs=1.0)


def user_of(*gains):
    user = np.zeros(SLOT_COUNT * len(gains))
    for i, gain in enumerate(gains):
        numbers = user[SLOT_COUNT * i : SLOT_COUNT * (i + 1)]
        numbers[Slot.FLOW_GAIN], numbers[Slot.ORIFICE_SMOOTHING] = gain, SMOOTHING
        numbers[Slot.STRIBECK_VELOCITY] = numbers[Slot.COULOMB_VELOCITY] = 1.0
        numbers[Slot.TANK_PRESSURE] = 0.3e6
        numbers[Slot.METERING_PA : Slot.METERING_AT + 1] = 1.0
    return user


@pytest.mark.parametrize("opening", [(1.0, 1.0), (1.0, -1.0), (-0.8, -0.8)])
def test_two_open_valves_share_the_pump_flow(opening):
    user, ports = user_of(2.3e-6, 2.3e-6), circuit_scratch()
    act = np.array([opening[0], 0, 8e6, 3e6, opening[1], 0, 6e6, 4e6])
    compute_inlet_conditions(user, act, act, ports, 0, 2, 0.0, np.zeros(8))
    pressure = solve_supply_pressure(ports, 2, SMOOTHING, RELIEF, 5e-3)
    assert pressure < RELIEF
    drawn, loads = [], []
    for i in range(2):
        head, rod, _ = axis_flows_and_force(user, i, pressure, act[4 * i : 4 * i + 4], 0.0, 0.0)
        fed, drained = (head, rod) if opening[i] > 0 else (rod, head)
        loads.append(act[4 * i + (2 if opening[i] > 0 else 3)])
        drawn.append(fed)
        assert drained < 0
    assert sum(drawn) == pytest.approx(5e-3, rel=1e-9)
    assert (drawn[0] > drawn[1]) == (loads[0] < loads[1]), "the lower pressure takes more"
    assert min(drawn) > 0


def test_load_check_keeps_a_heavy_load_from_feeding_a_light_one():
    user, ports = user_of(2.3e-6, 6e-6), circuit_scratch()
    act = np.array([1.0, 0, 25e6, 3e6, 1.0, 0, 1e6, 2e6])
    compute_inlet_conditions(user, act, act, ports, 0, 2, 0.0, np.zeros(8))
    pressure = solve_supply_pressure(ports, 2, SMOOTHING, RELIEF, 5e-3)
    assert pressure < 25e6
    assert axis_flows_and_force(user, 0, pressure, act[:4], 0.0, 0.0)[0] == 0.0
    assert axis_flows_and_force(user, 1, pressure, act[4:], 0.0, 0.0)[0] == pytest.approx(5e-3, rel=1e-9)


def test_pressure_is_found_where_plain_newton_cycles():
    # a wide and a narrow valve with a pump that hardly moves either: all within the smoothing zone
    valves = [(8.558e-06, 0.0), (3.566e-07, -2.0)]
    assert demand(valves, solve(valves, 1e-5)) == pytest.approx(1e-5, rel=1e-9)
