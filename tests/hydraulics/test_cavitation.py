"""Chambers that are drawn below atmosphere: the air that oil gives off, and what comes after."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hydrotele.gap.balances import chamber_residuals
from hydrotele.hydraulics.actuator_layout import actuator_parameters
from hydrotele.hydraulics.circuit import (
    NO_EXTRA_STATES,
    SLOT_COUNT,
    Slot,
    axis_valve_opening,
    chamber_pressure_rates,
    circuit_scratch,
    step_circuit,
)
from hydrotele.hydraulics.laws import (
    ATMOSPHERE,
    air_softening_factor,
    pressure_with_released_air,
    pressure_without_released_air,
)
from hydrotele.machine.machine_file import load_machine
from hydrotele.terms.drive_state import Drives
from hydrotele.terms.table import NO_TERMS

BOOM = 1
CLOSED = np.zeros(1)


@pytest.fixture
def boom():
    """Actuator numbers of the CAT 215's boom, as the only axis."""
    numbers = actuator_parameters(load_machine("cat215", "none"))["boom"].copy()
    numbers[Slot.COUNT] = 1
    return numbers


def run(user, motion, dt, seconds, command=CLOSED, start=(1.0e6, 1.0e6)):
    """Pressures (steps + 1, 2) of one axis whose piston moves as `motion(time)` -> (x, v) says."""
    act, rate, scratch = np.array([0.0, 0.0, *start]), np.zeros(4), circuit_scratch()
    states = [act[2:].copy()]
    for k in range(round(seconds / dt)):
        before, after = motion(k * dt)[0], motion((k + 1) * dt)[0]
        x, v = np.array([after]), np.array([(after - before) / dt])
        drives = Drives(1, act, x, v, command)
        step_circuit(user, 0, drives, dt, rate, scratch, NO_TERMS, 0.0, NO_EXTRA_STATES)
        act += dt * rate
        states.append(act[2:].copy())
    return np.array(states)


def drawn_and_let_go(time):
    """Piston out at 0.3 m/s for half a second, then at rest."""
    return 0.5 + 0.3 * min(time, 0.5), 0.3 if time < 0.5 else 0.0


def test_without_a_way_in_the_missing_volume_is_filled_by_oil_that_stretches_and_air(boom):
    """A closed chamber against the volumes that Henry's and Boyle's law give, written anew."""
    boom[[Slot.MAKEUP_GAIN, Slot.LEAKAGE]] = 0.0
    beta, area, dead = boom[Slot.BULK_MODULUS], boom[Slot.AREA_HEAD], boom[Slot.VOLUME_HEAD]
    air = boom[Slot.AIR_RELEASE] / beta
    assert 0.05 < air < 0.15
    got = run(boom, drawn_and_let_go, 1e-4, 0.5)[-1, 0]
    volume = np.array([dead + area * 0.5, dead + area * 0.65])
    # The chamber's volume grows while it is drawn: beta / V integrates to a logarithm.
    stretch = 1.0e6 / beta - np.log(volume[1] / volume[0])

    def lack(p):  # of the volume, as shares of it: oil that stretches, air that comes out
        return p / beta + air * (p / ATMOSPHERE) * ATMOSPHERE / (p + ATMOSPHERE) - stretch

    expected = brentq(lack, -ATMOSPHERE * (1 - 1e-12), 0.0, xtol=1e-6)
    assert -ATMOSPHERE < expected < -0.5 * ATMOSPHERE
    assert got == pytest.approx(expected, abs=10.0)  # 1e-4 of what the step misses in the volume


@pytest.mark.daily("0.001")
@pytest.mark.parametrize("dt", [1e-3, 2.5e-4])
def test_drawing_and_refilling_as_an_independent_integration_has_them(boom, dt):
    """Chambers as compliances that depend on their pressure, integrated by scipy's Radau."""
    user, seconds = boom, 3.0
    beta, leak, tank = user[Slot.BULK_MODULUS], user[Slot.LEAKAGE], user[Slot.TANK_PRESSURE]
    make, port, top = user[Slot.MAKEUP_GAIN], user[Slot.PORT_RELIEF], user[Slot.RELIEF_GAIN]
    areas, dead, stroke = user[[Slot.AREA_HEAD, Slot.AREA_ROD]], user[Slot.VOLUME_HEAD], \
        user[Slot.STROKE]  # fmt: skip

    def rates(time, p):
        x, v = drawn_and_let_go(time)
        volume = dead + areas * [x, stroke - x]
        flow = areas * [-v, v] + leak * (p[::-1] - p)
        flow += make * np.maximum(0.0, tank - p) - top * np.maximum(0.0, p - port)
        soft = volume / beta
        air = user[Slot.AIR_RELEASE] / beta * ATMOSPHERE / (p + ATMOSPHERE) ** 2
        return flow / (soft + np.where(p < 0.0, volume * air, 0.0))

    times, end = np.arange(1, round(seconds / dt) + 1) * dt, None
    found = []
    for begin, stop in ((0.0, 0.5), (0.5, seconds)):  # the piston's speed jumps between
        at = times[(times > begin + 1e-9) & (times <= stop + 1e-9)]
        solution = solve_ivp(rates, (begin, stop), end if end is not None else [1.0e6, 1.0e6],
                             "Radau", at, rtol=1e-9, atol=1e-3)  # fmt: skip
        assert solution.success
        found.append(solution.y.T)
        end = solution.y[:, -1]
    expected = np.concatenate(found)
    states = run(user, drawn_and_let_go, dt, seconds)[1:]
    assert expected[:, 0].min() < -0.5 * ATMOSPHERE, "nothing cavitates here"
    assert expected[-1, 0] > 0.0, "the chamber does not fill again here"
    # A step may begin to draw or end to fill anywhere inside: first order there, in the time of a
    # step times the fastest change of a pressure between these two.
    fastest = np.abs(np.diff(expected[:, 0])).max()
    assert np.abs(states - expected)[:, 0].max() < fastest
    calm = (times > 0.1) & (times <= 0.5)
    assert np.abs(states - expected)[calm, 0].max() < 0.002 * ATMOSPHERE


@pytest.mark.parametrize("dt", [1e-3, 2.5e-4])
def test_refilling_does_not_overshoot_the_valve_that_fills(boom, dt):
    """Only the make-up valve fills: nothing may go beyond the tank, from which the oil comes."""
    boom[Slot.LEAKAGE] = 0.0
    states = run(boom, drawn_and_let_go, dt, 3.0)
    after = states[round(0.5 / dt) :, 0]
    assert after[0] < 0.0
    assert after[-1] == pytest.approx(boom[Slot.TANK_PRESSURE], rel=1e-3)
    assert after.max() <= boom[Slot.TANK_PRESSURE] * (1 + 1e-9)  # rounding


def test_however_fast_it_is_drawn_the_pressure_stays_above_vacuum(boom):
    rng = np.random.default_rng(0)
    for dt in (1e-4, 1e-3, 5e-3):
        speed = rng.uniform(-30.0, 30.0, 400)
        place = 0.6 + 0.5 * np.sin(np.cumsum(speed) * dt)  # beyond both ends of the stroke, too
        states = run(boom, lambda t, p=place, h=dt: (p[round(t / h)], 0.0), dt, 399 * dt)
        assert np.isfinite(states).all()
        assert states.min() > -ATMOSPHERE
        assert states.min() < 0.0, "nothing cavitates here"


@pytest.mark.parametrize("bubbles", [0.005, 0.05])
def test_bubbles_give_way_by_the_volume_that_they_lose(boom, bubbles):
    """A closed chamber that is squeezed: oil by beta, air by p V^1.4 = const, written anew.

    1 %: the volume, which shrinks by as much, counts at its mean here.
    """
    boom[[Slot.MAKEUP_GAIN, Slot.LEAKAGE]] = 0.0
    boom[Slot.ENTRAINED_AIR] = bubbles
    beta, area = boom[Slot.BULK_MODULUS], boom[Slot.AREA_ROD]
    start, speed, seconds = 1.0e6, 0.05, 0.1

    def motion(time):
        return 0.6 + speed * time, speed

    rod = run(boom, motion, 2.5e-4, seconds)[:, 1]

    def swept(p):  # at the mean volume of the chamber, which changes by half a per cent
        middle = boom[Slot.VOLUME_ROD] + area * (boom[Slot.STROKE] - motion(0.5 * seconds)[0])
        share = (ATMOSPHERE / (ATMOSPHERE + np.array([start, p]))) ** (1.0 / 1.4)
        return middle * ((p - start) / beta + bubbles * (share[0] - share[1]))

    expected = brentq(lambda p: swept(p) - area * speed * seconds, start, 1.0e8)
    assert rod[-1] == pytest.approx(expected, rel=0.01)
    stiff = boom.copy()
    stiff[Slot.ENTRAINED_AIR] = 0.0
    assert run(stiff, motion, 2.5e-4, seconds)[-1, 1] > rod[-1] + 1e5


def test_a_machine_above_atmosphere_knows_nothing_of_its_air(boom):
    """Not a bit changes with the amount of air where no chamber is drawn empty."""
    ends = []
    for air in (0.001, 0.5):
        boom[Slot.AIR_RELEASE] = air * boom[Slot.BULK_MODULUS]
        states = run(boom, lambda t: (0.5 + 0.02 * np.sin(t), 0.0), 1e-3, 2.0,
                     np.full(1, 0.3), (6.0e6, 4.0e6))  # fmt: skip
        assert states.min() > 0.0
        ends.append(states)
    np.testing.assert_array_equal(*ends)


def test_with_and_without_air_are_inverse_over_all_that_a_chamber_may_lack():
    for oil in -np.geomspace(1e-3, 1e11, 60):
        for release in (1e5, 8.1e7, 5e9):
            felt = pressure_with_released_air(oil, release)
            assert -ATMOSPHERE < felt < 0.0
            assert pressure_without_released_air(felt, release) == pytest.approx(oil, rel=1e-6)


def test_what_is_said_to_be_below_vacuum_is_nearly_empty_and_nothing_worse(boom):
    """Readings and states of other programs may be anything; none may turn into a pressure wave."""
    for start in (-ATMOSPHERE, -120e3, -2.9e6):
        assert pressure_without_released_air(start, 8.1e7) < -ATMOSPHERE
        states = run(boom, lambda _: (0.5, 0.0), 1e-3, 0.2, start=(start, 1.0e6))
        assert np.isfinite(states).all()
        assert states[1:].max() < 1.1e6
        assert states[1:].min() > -ATMOSPHERE


def test_axes_that_share_a_supply_stay_sound_while_one_of_them_is_empty():
    """A fed chamber that is drawn empty beside one that the supply couples it with."""
    user = np.concatenate(list(actuator_parameters(load_machine("cat215", "none")).values()))
    act, rate, scratch = np.zeros(12), np.zeros(12), circuit_scratch()
    act[2::4] = act[3::4] = 2.0e6
    x, v = np.full(3, 0.4), np.array([0.0, 0.6, 0.1])
    command = np.array([0.2, 0.3, 1.0])
    least = []
    for _ in range(1500):
        x = x + 1e-3 * v
        drives = Drives(3, act, x, v, command)
        step_circuit(user, 0, drives, 1e-3, rate, scratch, NO_TERMS, 0.0, NO_EXTRA_STATES)
        act = act + 1e-3 * rate
        least.append(act[4 * BOOM + 2])
        assert np.isfinite(act).all()
        assert min(act[2::4].min(), act[3::4].min()) > -ATMOSPHERE
    assert min(least) < 0.0, "the boom is not drawn empty here"
    assert np.ptp(least[-100:]) < 1e3, "the fed chamber hunts"
    assert len(user) == 3 * SLOT_COUNT


def test_a_balance_of_readings_misses_no_oil_where_a_chamber_gives_off_air(boom):
    """Readings of a chamber below atmosphere, whose true rates `chamber_pressure_rates` has."""
    pressures, x, v, spool = np.array([-6.0e4, 2.0e6]), 0.5, 0.3, 0.2
    numbers = (boom, 0, axis_valve_opening(boom, 0, spool), 20.0e6, *pressures, x, v, 0.0, (0.0,) * 4)
    oil = np.array(chamber_pressure_rates(*numbers)[:2])
    soft = np.array([air_softening_factor(p, boom[Slot.AIR_RELEASE]) for p in pressures])
    assert soft[0] < 1e-3 and soft[1] == 1.0
    volumes = np.array([
        [boom[Slot.VOLUME_HEAD] + boom[Slot.AREA_HEAD] * x],
        [boom[Slot.VOLUME_ROD] + boom[Slot.AREA_ROD] * (boom[Slot.STROKE] - x)],
    ])  # fmt: skip
    sides = np.stack([pressures, oil * soft], axis=1)[:, :, None]
    lacks = chamber_residuals(boom, np.array([spool]), np.array([20.0e6]), *sides, volumes, np.array([v]))
    assert np.abs(lacks).max() < 1e-12 * boom[Slot.AREA_HEAD] * v


def test_a_stick_that_is_lowered_faster_than_make_up_oil_comes():
    """The CAT 325's stick as `fell_tree` lowers it: its head side grows by 180 L/min, valve closed.

    Oil alone would settle where the make-up valve lets that in, 0.3 MPa of tank pressure less
    A v / k_m: -0.3 MPa above atmosphere, 0.2 MPa below vacuum. Air fills what is missing instead.
    """
    user = actuator_parameters(load_machine("cat325", "none"))["stick"].copy()
    user[[Slot.COUNT, Slot.LEAKAGE]] = 1, 0.0
    tank, make = user[Slot.TANK_PRESSURE], user[Slot.MAKEUP_GAIN]
    speed = 0.6e6 * make / user[Slot.AREA_HEAD]
    assert 0.1 < speed < 0.2

    def lowered(time):
        return 0.1 + speed * time, speed

    with_air = run(user, lowered, 1e-3, 1.0)[:, 0]
    assert -ATMOSPHERE < with_air.min() < 0.0
    user[Slot.AIR_RELEASE] = 0.0
    alone = run(user, lowered, 1e-3, 1.0)[:, 0]
    assert alone[-1] == pytest.approx(tank - 0.6e6, rel=1e-3)  # settles with V / (beta k_m)
    assert alone.min() < -2.0 * ATMOSPHERE
