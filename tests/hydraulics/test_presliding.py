"""Presliding friction against an independent integration, and a pump that follows late."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hydrotele.effects import EFFECTS, apply_effect, with_value
from hydrotele.hydraulics.actuator import (
    actuator_friction,
    advance_bristle_force,
    bristle_friction,
    bristle_rate,
    implicit_bristle_friction,
    sliding_friction,
)
from hydrotele.hydraulics.actuator_layout import actuator_parameters, extra_state_names
from hydrotele.hydraulics.circuit import (
    SCRATCH_SIZE,
    Slot,
    circuit_supply_pressure,
    compute_inlet_conditions,
    step_circuit,
    write_demanded_fractions,
)
from hydrotele.hydraulics.supply import DEMAND
from hydrotele.machine.drives import Axis, Friction
from hydrotele.machine.machine import Supply
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import NO_TERMS

COULOMB, STRIBECK, SLOW, UNEQUAL = 150.0, 50.0, 0.02, 0.2
STIFFNESS = 4.0e6  # N/m: 200 N break away after some 50 um


def friction(**more):
    """The test rig with bristles, asymmetric friction and a damper on them."""
    facts = {"presliding_stiffness": STIFFNESS, "presliding_damping": 300.0,
             "coulomb_asymmetry": UNEQUAL, "viscous_asymmetry": 0.1, **more}  # fmt: skip
    machine = load_machine("rig")
    for name, value in facts.items():
        machine = with_value(machine, f"axes.slide.cylinder.friction.{name}", value)
    return actuator_parameters(machine)["slide"]


def integrated(way, speed, end, points):
    """Force of the bristles over a prescribed motion by scipy, at some times."""

    def rate(t, force):
        v = speed(t)
        dry = COULOMB + STRIBECK * np.exp(-((v / SLOW) ** 2))
        level = dry * (1.0 + UNEQUAL * np.sign(v))
        return STIFFNESS * (v - abs(v) * force / level)

    return solve_ivp(rate, (0.0, end), [0.0], t_eval=points, rtol=1e-10, atol=1e-9, max_step=1e-3)


@pytest.mark.parametrize("size", [2e-5, 1.5e-4], ids=["below breakaway", "beyond"])
def test_hysteresis_is_that_of_an_independent_integration(size):
    """Force over displacement of a slow sine: a narrow loop below breakaway, a full one beyond."""
    w, dt = 2.0 * np.pi, 1.0e-3
    time = dt * np.arange(2001)
    way = size * np.sin(w * time)
    force = np.zeros(len(time))
    for k, v in enumerate(np.diff(way) / dt):
        level = sliding_friction(v, COULOMB, STRIBECK, SLOW, UNEQUAL)
        force[k + 1] = advance_bristle_force(force[k], v, level, STIFFNESS, dt)
    truth = integrated(way, lambda t: size * w * np.cos(w * t), 2.0, time).y[0]
    # velocities are held over a step: 1e-3 of the breakaway force is second order in 6e-3 rad
    assert np.abs(force - truth).max() < 1e-3 * (COULOMB + STRIBECK)
    loop = np.s_[1000:]  # the second period
    lost = -np.trapezoid(way[loop], force[loop])
    whole = np.ptp(force) * np.ptp(way)  # of the rectangle that dry friction alone runs around
    assert lost > 0.0, "friction takes energy"
    if size < 5e-5:
        assert np.ptp(force) / np.ptp(way) == pytest.approx(STIFFNESS, rel=0.35)  # nearly a spring
        assert lost < 0.25 * whole
    else:  # slides both ways at the Stribeck level of its speed, between F_c and F_c + F_s
        assert force.max() == pytest.approx((COULOMB + STRIBECK) * (1 + UNEQUAL), rel=0.03)
        assert force.min() == pytest.approx(-(COULOMB + STRIBECK) * (1 - UNEQUAL), rel=0.03)


def test_without_stribeck_friction_it_is_dahls_curve():
    """`F = F_c (1 - exp(-sigma x / F_c))`, whatever the speed and the steps; 63 % at F_c/sigma."""
    way = COULOMB / STIFFNESS
    for speed, parts in ((1e-3, 1), (0.3, 1), (1e-3, 7)):
        force, dt = 0.0, way / speed / parts
        for _ in range(parts):
            force = advance_bristle_force(force, speed, COULOMB, STIFFNESS, dt)
        assert force == pytest.approx(COULOMB * (1.0 - np.exp(-1.0)), rel=1e-12)  # rounding


def test_sliding_steadily_it_is_the_friction_without_bristles():
    user = friction()
    for v in (-0.4, -0.03, 0.03, 0.1):
        share = 0.0
        for _ in range(200):
            share += 1e-3 * bristle_rate(user, 0, share, v, 0.0, 1e-3)
        force, _, stiffness = bristle_friction(user, 0, share, v, 0.0, 0.0)
        # six times the smoothing velocity: tanh(6) is 1.2e-5 short of 1
        assert force == pytest.approx(actuator_friction(user, 0, v), rel=3e-5)
        assert abs(stiffness) < 1e-6 * STIFFNESS, "bristles that slide are no spring"


def test_at_rest_it_holds_without_creep():
    user = friction()
    assert bristle_rate(user, 0, 0.7, 0.0, 0.0, 1e-3) == 0.0
    force, damping, stiffness = bristle_friction(user, 0, 0.7, 0.0, 0.0, 0.0)
    assert force == pytest.approx(0.7 * (COULOMB + STRIBECK))
    assert stiffness == STIFFNESS and damping == pytest.approx(300.0 + 600.0)


def test_slopes_are_those_of_the_force():
    user, share, dt = friction(), 0.4, 1e-7
    for v in (-2e-3, 2e-3):
        _, damping, stiffness = bristle_friction(user, 0, share, v, 0.0, 0.0)
        faster, slower = (bristle_friction(user, 0, share, v + d, 0.0, 0.0)[0] for d in (1e-6, -1e-6))
        # the level's own slope, which an implicit step does without, is 1 % here
        assert damping == pytest.approx((faster - slower) / 2e-6, rel=0.02)
        rate = bristle_rate(user, 0, share, v, 0.0, dt)
        assert stiffness * v == pytest.approx(rate * (COULOMB + STRIBECK), rel=1e-3)  # a short step


def test_stiff_bristles_count_as_soft_as_a_step_can_follow():
    """A mass on bristles of 1e9 N/m, explicitly stepped at 2 ms, comes to rest and stays there."""
    user, mass, dt = friction(presliding_stiffness=1e9, presliding_damping=0.0), 95.0, 2e-3
    v, share, way = 0.5, 0.0, []
    for _ in range(2000):
        share += dt * bristle_rate(user, 0, share, v, mass, dt)
        v -= dt / mass * bristle_friction(user, 0, share, v, mass, dt)[0]
        way.append(dt * v)
    # swings on its bristles, hardly damped, by less than their breakaway deflection at this step
    assert np.abs(way[-500:]).max() < (COULOMB + STRIBECK) * (1 + UNEQUAL) * dt**2 / (0.5 * mass)
    assert abs(np.sum(way[-500:])) < 1e-4


def test_a_light_drive_side_is_stepped_implicitly():
    user = friction(viscous=1e5)
    v, mass, dt = 0.1, 3.0, 1e-3  # an explicit step would turn it round: b dt / m = 33
    after = v - dt / mass * implicit_bristle_friction(user, 0, 0.0, v, 0.0, mass, dt)
    assert 0.0 < after < v


def test_without_the_numbers_nothing_is_remembered():
    for name in ("rig", "emps", "cat215"):
        machine = load_machine(name)
        assert extra_state_names(machine) == []
        for numbers in actuator_parameters(machine).values():
            assert not numbers[Slot.BRISTLE_STIFFNESS : Slot.GROUP_SIZE].any()


def test_what_is_remembered_stands_behind_the_activations():
    machine = load_machine("cat325")
    for pump in ("front", "rear"):
        machine = apply_effect(machine, "pump_lag", f"supply.{pump}", {"time_constant": 0.2})
    order = [n for n, a in machine.axes.items() if not a.pump]
    for name in order:
        usual = EFFECTS["presliding"].parameters(machine, name)["compliance"].prior_std
        machine = apply_effect(machine, "presliding", name, {"compliance": usual})
    names, valves = extra_state_names(machine), list(machine.hydraulic_axes)
    drives = [n for n, a in machine.axes.items() if a.force]
    assert names == [*(f"bristle.{n}" for n in valves), "delivery.front", "delivery.rear",
                     *(f"bristle.{n}" for n in drives)]  # fmt: skip
    numbers = actuator_parameters(machine)
    assert numbers[valves[0]][Slot.BRISTLE] == 4 * len(valves)
    assert all(numbers[n][Slot.EXTRA_STATES] == len(valves) + 2 for n in valves)
    places = {"front": 5 * len(valves), "rear": 5 * len(valves) + 1}
    assert all(numbers[n][Slot.DELIVERY] == places[machine.pump_of(n)] for n in valves)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="presliding_damping needs a presliding_stiffness"):
        Friction(coulomb=1.0, presliding_damping=1.0)
    with pytest.raises(ValueError, match="has no lag: remove time_constant"):
        Supply(kind="constant_pressure", relief_pressure=1e7, tank_pressure=1e5, bulk_modulus=1e9,
               time_constant=0.1)  # fmt: skip
    axis = load_machine("eha", "load_30_bar").axes["piston"].model_dump()
    axis["cylinder"]["friction"]["presliding_stiffness"] = 1e7
    with pytest.raises(ValueError, match="has friction without presliding: remove"):
        Axis.model_validate(axis)


def slow_pump(time_constant):
    """Numbers of the rig, valve open, with piston and pressures held."""
    supply = {"time_constant": time_constant}
    machine = load_machine("rig")
    for name, value in supply.items():
        machine = with_value(machine, f"supply.{name}", value)
    return actuator_parameters(machine)["slide"]


def test_the_pump_follows_by_its_exponential_and_arrives_at_todays_pressure():
    """What is drawn is 0.5 of what the pump gives; 63 % of it after the time constant."""
    user, dt, lag = slow_pump(0.1), 2.5e-4, 0.1
    now, scratch, rates = slow_pump(0.0), np.zeros(SCRATCH_SIZE), np.zeros(5)
    act = np.array([0.6, 0.0, 2e6, 2e6, 0.0])
    compute_inlet_conditions(user, act, act, scratch, 0, 1, 0.0, act)
    write_demanded_fractions(user, 0, 1, scratch)
    wanted, flow = scratch[DEMAND], user[Slot.PUMP_FLOW]
    without = circuit_supply_pressure(now, 0, 1, scratch, flow, 0.0)
    assert 0.2 < wanted < 1.0
    low = circuit_supply_pressure(user, 0, 1, scratch, 0.5 * wanted * flow, 0.0)
    assert low < without, "a pump that is not there yet falls short"
    assert circuit_supply_pressure(user, 0, 1, scratch, wanted * flow, 0.0) == pytest.approx(without, rel=1e-9)
    shares = []
    for _ in range(400):
        act[:4] = 0.6, 0.0, 2e6, 2e6
        drives = Drives(1, act, np.zeros(1), np.zeros(1), np.array([0.62]))
        step_circuit(user, 0, drives, dt, rates, scratch, NO_TERMS, 0.0, 1)
        act[4] += dt * rates[4]
        shares.append(act[4])
    # the pressures move a little within every step, and the wanted flow with them
    assert shares[-1] == pytest.approx(wanted * (1.0 - np.exp(-1.0)), rel=0.03)
    assert shares[199] == pytest.approx(wanted * (1.0 - np.exp(-0.05 / lag)), rel=0.03)
