"""A bucket that digs, rests, carries and drops; energy, mass, threads."""

import ctypes
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import (
    carray,  # pyright: ignore[reportPrivateImportUsage] -- its documented API
    types,
)

from hydrotele.core.compiled import callback
from hydrotele.soil.parameters import (
    CARRIED_VOLUME,
    CAT215,
    CELL_LENGTH,
    FORCE_R,
    FORCE_Z,
    GRAVITY,
    HEEL,
    HEEL_X,
    HEEL_Z,
    LOST_VOLUME,
    MASS,
    MASS_R,
    MASS_Z,
    MOMENT,
    RESULT_SIZE,
    SLIDE,
    SOILS,
    STATE_SIZE,
    STIFFNESS,
    SWELL,
    make_bucket_state,
    make_level_profile,
    pack_soil_parameters,
    total_soil_mass,
)
from hydrotele.soil.step import EdgeMotion, step_soil

DEGREE = math.pi / 180.0
DT = 0.005


class Ground:
    """A profile of 140 cells of 5 cm from 3 m on, and a bucket over it."""

    def __init__(self, soil="sandy_loam", height=0.0):
        self.numbers = pack_soil_parameters(SOILS[soil], CAT215, 3.0, 0.05)
        self.surface, self.loose = make_level_profile(140, height)
        self.state, self.out = make_bucket_state(), np.zeros(RESULT_SIZE)
        self.last = None

    def go(self, r, z, attitude, dt=DT):
        """Move the edge there in one step and return a copy of what comes out."""
        a, b = self.last or (r, z)
        self.last = (r, z)
        edge = EdgeMotion(r, z, (r - a) / dt, (z - b) / dt, attitude * DEGREE)
        step_soil(self.numbers, self.surface, self.loose, self.state, edge, dt, self.out)
        return self.out.copy()

    def path(self, *points, speed=0.5):
        """Go along (r, z, attitude [deg]) in straight lines; outs of all steps."""
        outs = []
        for start, end in zip(points[:-1], points[1:], strict=True):
            start, end = np.array(start), np.array(end)
            length = max(np.hypot(*(end - start)[:2]), abs(end - start)[2] * DEGREE)
            steps = max(int(length / (speed * DT)), 1)
            outs += [self.go(*(start + (end - start) * k / steps).tolist()) for k in range(1, steps + 1)]
        return np.array(outs)

    def mass(self):
        return total_soil_mass(self.numbers, self.surface, self.loose, self.state)


CUT = ((6.6, 0.1, -75.0), (6.4, -0.15, -85.0), (4.8, -0.15, -105.0))
CARRY = ((4.8, -0.15, -105.0), (4.5, 0.3, -150.0), (4.6, 1.5, -180.0))
DUMP = ((4.6, 1.5, -180.0), (7.5, 1.5, -60.0))


def test_nothing_happens_in_the_air():
    ground = Ground()
    outs = ground.path((6.0, 0.8, -90.0), (4.0, 0.8, -120.0), (6.0, 1.0, -60.0))
    assert not outs.any()
    assert not ground.surface.any()
    assert ground.state[CARRIED_VOLUME] == 0.0


@pytest.mark.parametrize(("soil", "low", "high"), [("sandy_loam", 6e3, 2e4), ("firm", 2e4, 6e4)])
def test_bucket_cuts_fills_carries_and_drops(soil, low, high):
    ground = Ground(soil)
    before = ground.mass()
    cutting = ground.path(*CUT)
    steady = cutting[-200:, FORCE_R]
    assert low < steady.min()
    assert steady.max() < high  # a machine of 20 t draws some 100 kN
    trench = ground.surface[45:60]  # 5.25 .. 6 m
    assert trench == pytest.approx(-0.15, abs=0.01)
    carried = ground.path(*CARRY)[-1]
    assert 200.0 < carried[MASS] < 1700.0  # kg; a heaped load weighs 1250
    assert carried[FORCE_R] == carried[FORCE_Z] == 0.0
    assert carried[MASS_R] > 0.3  # out beyond the edge, between it and the shell
    assert carried[MASS_Z] < 0.1
    ground.path(*DUMP)
    for _ in range(400):
        ground.go(7.5, 1.5, -60.0)
    assert ground.state[CARRIED_VOLUME] == 0.0
    assert ground.state[LOST_VOLUME] == 0.0
    assert ground.surface[60:].max() > 0.05  # a heap where it fell
    assert ground.mass() == pytest.approx(before, abs=1e-9)


def test_forces_change_gently_across_cells():
    ground = Ground("firm")
    ground.path((6.6, 0.1, -75.0), (6.4, -0.15, -90.0))
    outs = ground.path((6.4, -0.15, -90.0), (5.0, -0.15, -90.0))
    jumps = np.abs(np.diff(outs[100:, FORCE_R]))
    # 2.5 mm of way change the force by some percent; a jump at each cell would show.
    assert jumps.max() < 0.03 * outs[:, FORCE_R].max()


def test_full_bucket_pushes_a_pile_ahead():
    ground = Ground()
    ground.path((9.5, 0.1, -80.0), (9.3, -0.2, -90.0), (4.5, -0.2, -110.0))
    ahead = ground.surface[:30]  # up to 4.5 m
    assert ahead.max() > 0.15
    last = ground.state[CARRIED_VOLUME]
    ground.path((4.5, -0.2, -110.0), (4.2, -0.2, -110.0))
    assert ground.state[CARRIED_VOLUME] < last + 0.5 * 0.3 * 0.2 * CAT215.width * ground.numbers[SWELL]


def test_pushing_outwards_heaps_soil_outside():
    ground = Ground()
    before = ground.mass()
    ground.path((5.0, 0.1, -137.0), (5.0, -0.05, -137.0), (6.0, -0.05, -137.0))
    assert ground.state[CARRIED_VOLUME] == 0.0
    assert ground.surface[61:75].max() > 0.03
    assert ground.surface[42:58] == pytest.approx(-0.05, abs=0.01)
    assert ground.mass() == pytest.approx(before, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(data=st.data(), soil=st.sampled_from(sorted(SOILS)))
def test_soil_never_gives_energy(data, soil):
    ground = Ground(soil)
    attitude = data.draw(st.floats(-200, -30))
    number = st.floats(-1.0, 1.0)
    r, z, work, worst = 5.5, data.draw(st.floats(-0.3, 0.1)), 0.0, 0.0
    ground.go(r, z, attitude)
    for _ in range(6):
        dr, dz = data.draw(number) * 0.01, data.draw(number) * 0.01
        for _ in range(data.draw(st.integers(1, 25))):
            r, z = r + dr, z + dz
            out = ground.go(r, z, attitude)
            work += out[FORCE_R] * dr + out[FORCE_Z] * dz
            worst = max(worst, work)
    assert worst <= 1e-9  # J; rounding


@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_soil_never_gives_energy_to_a_turning_bucket(data):
    """So slowly that no damper acts: edge and heel then feel the springs that the state holds."""
    ground = Ground("firm")
    n, number = ground.numbers, st.floats(-1.0, 1.0)
    r, z, attitude = 5.5, data.draw(st.floats(-0.3, 0.1)), data.draw(st.floats(-200, -30))
    work, worst = 0.0, 0.0

    def heel(a):
        c, s = math.cos(a * DEGREE), math.sin(a * DEGREE)
        return np.array([c * n[HEEL_X] - s * n[HEEL_Z], s * n[HEEL_X] + c * n[HEEL_Z]])

    ground.go(r, z, attitude, dt=1e9)
    for _ in range(6):
        move = np.array([data.draw(number) * 0.01 for _ in range(2)])
        turn = data.draw(number)
        for _ in range(data.draw(st.integers(1, 25))):
            before = heel(attitude)
            (r, z), attitude = move + (r, z), attitude + turn
            out = ground.go(r, z, attitude, dt=1e9)
            arm = heel(attitude)
            at_heel = n[STIFFNESS] * ground.state[[SLIDE, HEEL]]
            moment = arm[0] * at_heel[1] - arm[1] * at_heel[0]
            assert out[MOMENT] == pytest.approx(moment, abs=1e-3)
            work += (out[:2] - at_heel) @ move + at_heel @ (move + arm - before)
            worst = max(worst, work)
    assert worst <= 1e-6  # J, of some kJ; the dampers still give 1 / 200 000 000 of their force


def test_bucket_that_rests_is_held_and_one_that_is_pressed_does_not_sink():
    """A mass on the edge, stepped explicitly at 200 Hz under a constant force."""
    mass = 1500.0
    for soil, attitude, press in (("sandy_loam", -90.0, 1e4), ("firm", -137.0, 5e4)):
        ground = Ground(soil)
        z, speed, places = 0.0, 0.0, []
        for _ in range(1200):
            out = ground.go(6.0, z, attitude)
            speed += (out[FORCE_Z] - press) / mass * DT
            z += speed * DT
            places.append(z)
        assert -0.3 < z < 0.0
        settled = np.array(places[-200:])
        assert np.ptp(settled) < 1e-5  # m in a second: neither creeps nor chatters
        assert out[FORCE_Z] == pytest.approx(press, rel=1e-3)


def test_curled_bucket_rests_on_its_heel():
    ground = Ground("firm")
    place = -150.0
    drop = CAT215.heel[1] * math.cos(place * DEGREE) + (CAT215.heel[0] - 1.35) * math.sin(place * DEGREE)
    outs = ground.path((6.0, 0.1 - drop, place), (6.0, -0.03 - drop, place))
    assert outs[-1, FORCE_Z] > 1e4
    assert outs[-1, MOMENT] > 0.3 * outs[-1, FORCE_Z]  # it acts outside of the edge


def test_tilted_bucket_spills_only_what_it_cannot_hold():
    ground = Ground()
    ground.state[CARRIED_VOLUME] = 0.6
    for _ in range(600):
        ground.go(6.0, 2.0, -140.0)
    assert 0.5 < ground.state[CARRIED_VOLUME] < 0.6
    for _ in range(600):
        ground.go(6.0, 2.0, -80.0)
    assert ground.state[CARRIED_VOLUME] == 0.0
    fallen = np.sum(ground.surface) * ground.numbers[CELL_LENGTH] * CAT215.width
    assert fallen == pytest.approx(0.6, rel=1e-12)
    slopes = np.abs(np.diff(ground.surface)) / ground.numbers[CELL_LENGTH]
    assert slopes.max() < math.tan(SOILS["sandy_loam"].repose) + 0.01


@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_mass_is_conserved_and_all_stays_finite_in_wild_motion(data):
    ground = Ground(data.draw(st.sampled_from(sorted(SOILS))), height=0.2)
    before, turned = ground.mass(), st.floats(-260, 90)
    place = st.tuples(st.floats(1.5, 11.5), st.floats(-0.8, 1.5), turned)
    for point in data.draw(st.lists(place, min_size=2, max_size=8)):
        for _ in range(3):
            assert np.isfinite(ground.go(*point)).all()
    points = data.draw(st.lists(place, min_size=2, max_size=4))
    outs = ground.path(*points, speed=2.0)
    assert np.isfinite(outs).all()
    assert np.abs(outs[:, :2]).max() < 3e6  # N: floor and heel of a buried bucket in firm soil
    assert ground.state[CARRIED_VOLUME] >= 0.0
    assert (ground.loose >= -1e-12).all()
    # Rounding of sums over some thousand steps of masses of some tonnes.
    assert ground.mass() == pytest.approx(before, rel=1e-10)


def test_environments_in_threads_do_not_touch_each_other():
    def dig(_):
        ground = Ground()
        return ground.path(*CUT).tobytes() + ground.surface.tobytes()

    alone = dig(0)
    with ThreadPoolExecutor(4) as pool:
        assert set(pool.map(dig, range(8))) == {alone}


def test_weight_of_what_is_carried_is_given_apart():
    ground = Ground()
    ground.state[CARRIED_VOLUME] = 0.5
    out = ground.go(6.0, 2.0, -180.0)
    soil = SOILS["sandy_loam"]
    assert out[MASS] == pytest.approx(0.5 / soil.swell * soil.density)
    assert out[FORCE_Z] == 0.0
    assert GRAVITY * out[MASS] > 6e3


_POINTER = types.CPointer(types.float64)


@callback(types.void(_POINTER, _POINTER, types.intp, _POINTER, _POINTER, _POINTER))
def _native(numbers, profile, count, state, move, out):
    n = carray(numbers, 64)
    cells = carray(profile, 2 * count)
    m = carray(move, 6)
    edge = EdgeMotion(m[0], m[1], m[2], m[3], m[4])
    step_soil(
        n,
        cells[:count],
        cells[count:],
        carray(state, STATE_SIZE),
        edge,
        m[5],
        carray(out, RESULT_SIZE),
    )


def test_native_callback_gives_the_same():
    python, native = Ground(), Ground()
    cells = np.concatenate([native.surface, native.loose])
    numbers = np.zeros(64)
    numbers[: len(native.numbers)] = native.numbers
    for k in range(300):
        z = 0.02 - 0.001 * min(k, 100)
        move = np.array([6.0 - 0.002 * k, z, -0.4, 0.0, -95.0 * DEGREE, DT])
        step_soil(
            python.numbers, python.surface, python.loose, python.state, EdgeMotion(*move[:5]),
            move[5], python.out,
        )  # fmt: skip
        arrays = (numbers, cells, native.state, move, native.out)
        n, c, s, m, o = (a.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for a in arrays)
        _native.ctypes(n, c, 140, s, m, o)
        assert native.out.tolist() == python.out.tolist()
    assert python.out[FORCE_R] > 1e3
    assert cells.tolist() == [*python.surface, *python.loose]
