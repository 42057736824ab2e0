"""Pump drive: motor, flows, accumulator, load cylinder and friction against closed forms."""

import math

import numpy as np
import pytest

from hydrotele.hydraulics.actuator_layout import PumpSlot
from hydrotele.hydraulics.laws import ATMOSPHERE
from hydrotele.hydraulics.pump_drive import (
    accumulator_pressure,
    chamber_compliance,
    load_pressure_step,
    pump_flows,
    pump_piston_friction,
    pump_speed_step,
)

ROUNDING = 1e-12
SEAL = (200.0, 300.0, 4.0e-3, 1.0e5, 0.0, 0.0)  # N, N, m/s, N s/m


@pytest.fixture
def block():
    """Numbers of a small drive, near those of `models/eha`."""
    numbers = np.zeros(len(PumpSlot))
    numbers[PumpSlot.DISPLACEMENT], numbers[PumpSlot.LEAKAGE] = 2.5e-7, 2.0e-13
    numbers[PumpSlot.RATED_SPEED], numbers[PumpSlot.TORQUE_LOSS] = 200.0, 0.5
    numbers[PumpSlot.BULK_MODULUS] = 1.0e9
    numbers[PumpSlot.ACCUMULATOR_PRESSURE], numbers[PumpSlot.GAS_VOLUME] = 5.0e5, 1.4e-4
    numbers[PumpSlot.LINE_EXTENDING] = numbers[PumpSlot.LINE_RETRACTING] = 1.0e10
    numbers[PumpSlot.VOLTAGE], numbers[PumpSlot.RESISTANCE] = 24.0, 0.32
    numbers[PumpSlot.EMF], numbers[PumpSlot.INERTIA] = 0.06, 1.0e-3
    numbers[PumpSlot.DRAG], numbers[PumpSlot.BREAKAWAY] = 0.3, 0.6
    numbers[PumpSlot.BREAKAWAY_SPEED], numbers[PumpSlot.VISCOUS_DRAG] = 4.0, 5.0e-3
    numbers[PumpSlot.MOVING_MASS] = 50.0
    numbers[PumpSlot.LOAD_AREA], numbers[PumpSlot.LOAD_RELIEF] = 2.0e-3, 2.0e6
    numbers[PumpSlot.LOAD_STIFFNESS] = 3.0e7
    numbers[PumpSlot.LOAD_VOID], numbers[PumpSlot.LOAD_VOID_PRESSURE] = 3.0e-3, 2.0e4
    return numbers


def test_motor_settles_where_its_torques_balance(block):
    """`k (u U - k w) / R = D dp (1 + l) + T_c + b w`, and the way there is an exponential.

    The implicit step of first order misses the time constant by dt / 2 tau, here 3 %.
    """
    k, r, j, b = 0.06, 0.32, 1.0e-3, 5.0e-3
    rest = k * 0.8 * 24.0 / r - 1.5 * 2.5e-7 * 2.0e6 - 0.3
    settled, tau = rest / (k * k / r + b), j / (k * k / r + b)
    speed, dt, tenth = settled - 20.0, 1.0e-4, []
    for _ in range(20_000):
        speed = pump_speed_step(block, 0, speed, 0.8, 2.5e6, 0.5e6, dt)
        tenth.append(settled - speed)
    assert speed == pytest.approx(settled, rel=1e-9)
    assert tenth[round(tau / dt) - 1] == pytest.approx(20.0 / math.e, rel=dt / tau)


def test_motor_stalls_under_pressure_and_remembers_its_side(block):
    """Below its breakaway torque the pump stands, and does not turn back under the oil."""
    for side in (1.0, -1.0):
        speed = pump_speed_step(block, 0, 0.0, 0.1 * side, 3.0e6, 3.0e6, 1.0e-3)
        assert 0.0 < side * speed < 1.0e-6
    assert pump_speed_step(block, 0, 0.0, 0.3, 8.0e6, 0.0, 1.0e-3) < 1.0e-6
    assert pump_speed_step(block, 0, 90.0, 0.0, 1.0e6, 1.0e6, 1.0e-3) == 0.0


@pytest.mark.parametrize("speed", [80.0, -80.0])
def test_oil_that_leaves_one_line_enters_the_other(block, speed):
    """Flows of both sides add up to what the accumulator gives; slopes are derivatives."""
    p_head, p_rod, taken = 1.3e6, 0.4e6, 1.0e-5
    q_head, q_rod, slope_head, slope_rod = pump_flows(block, 0, speed, p_head, p_rod, taken)
    gas = accumulator_pressure(5.0e5, 1.4e-4, taken)
    drawn = p_rod if speed > 0 else p_head
    assert q_head + q_rod == pytest.approx((gas - drawn) / 1.0e10, rel=1e-9)
    assert (q_head if speed > 0 else q_rod) == pytest.approx(
        80.0 * 2.5e-7 - math.copysign(2.0e-13, speed) * (p_head - p_rod), rel=1e-9
    )
    step = 1.0e3  # Pa; the law is linear in the pressures
    more_head = pump_flows(block, 0, speed, p_head + step, p_rod, taken)[0]
    more_rod = pump_flows(block, 0, speed, p_head, p_rod + step, taken)[1]
    assert (more_head - q_head) / step == pytest.approx(slope_head, rel=1e-6)
    assert (more_rod - q_rod) / step == pytest.approx(slope_rod, rel=1e-6)


def test_shut_valve_lets_nothing_through(block):
    """No flow at speed 0."""
    assert pump_flows(block, 0, 0.0, 5.0e6, 0.1e6, 0.0) == (0.0, 0.0, 0.0, 0.0)


def test_compliance_of_air_is_the_slope_of_boyles_law():
    """`dV/dp` of air alone, by a central difference whose error is of second order."""
    air, p, step = 1.0e-5, 7.0e5, 10.0

    def volume(pressure):
        return air * ATMOSPHERE / (pressure + ATMOSPHERE)

    slope = (volume(p - step) - volume(p + step)) / (2.0 * step)
    assert chamber_compliance(0.0, 1.0e9, 0.0, air, p) == pytest.approx(slope, rel=1e-8)


def test_load_follows_its_void_and_its_oil_then_its_relief(block):
    """Pressed in by s: `s = d p / (p_v + p) + A p / k`, whatever the steps; then the relief."""
    for count in (1, 7, 400):
        pressure, way = 0.0, 2.9e-3
        for _ in range(count):
            pressure = load_pressure_step(block, 0, pressure, way / (count * 1.0e-3), 1.0e-3)
        given = 3.0e-3 * pressure / (2.0e4 + pressure) + 2.0e-3 * pressure / 3.0e7
        assert given == pytest.approx(way, rel=1e-9)
    assert load_pressure_step(block, 0, pressure, 1.0, 1.0e-3) == 2.0e6
    assert load_pressure_step(block, 0, 2.0e6, -5.0, 1.0e-3) == 0.0


def test_friction_holds_what_is_below_it_and_stops_without_reversing():
    """A standing piston stands; a moving one comes to exactly 0, not beyond."""
    block = np.zeros(len(PumpSlot))
    block[PumpSlot.MOVING_MASS] = 50.0
    dt = 1.0e-3
    assert pump_piston_friction(block, 0, SEAL, 0.0, 450.0, 0.0, dt) == 450.0
    assert pump_piston_friction(block, 0, SEAL, 0.0, 450.0, 0.0, 0.0) == 450.0
    velocity = 0.02
    for _ in range(200):
        force = pump_piston_friction(block, 0, SEAL, velocity, 0.0, 0.0, dt)
        velocity += dt / 50.0 * (0.0 - force)
        assert velocity >= -ROUNDING
    assert abs(velocity) < ROUNDING


def test_friction_settles_at_the_speed_that_it_allows():
    """Far above the Stribeck velocity: `F = F_c + b v`."""
    block = np.zeros(len(PumpSlot))
    block[PumpSlot.MOVING_MASS] = 50.0
    for push in (5000.0, -5000.0):
        velocity = 0.0
        for _ in range(500):
            friction = pump_piston_friction(block, 0, SEAL, velocity, push, 0.0, 1.0e-3)
            velocity += 1.0e-3 / 50.0 * (push - friction)
        assert velocity == pytest.approx(math.copysign((5000.0 - 200.0) / 1.0e5, push), rel=1e-6)
