"""Soil in the profile: nothing appears or vanishes, heaps rest at their angle, cuts stand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hydrotele.soil.parameters import (
    CAT215,
    CELL_LENGTH,
    PROFILE_START,
    SOILS,
    make_bucket_state,
    make_level_profile,
    pack_soil_parameters,
    total_soil_mass,
)
from hydrotele.soil.terrain import (
    MIN_SLIDING_HEIGHT,
    add_loose_soil,
    cut_cells,
    find_cell_at_radius,
    slide_soil_in_range,
    surface_height,
)

SOIL = SOILS["sandy_loam"]
NUMBERS = pack_soil_parameters(SOIL, CAT215, 3.0, 0.05)


def settle(surface, loose, wall=-2):
    for _ in range(20000):
        if not slide_soil_in_range(NUMBERS, surface, loose, 0, len(surface) - 1, wall):
            return
    raise AssertionError("still slides")


def test_heap_comes_to_rest_at_the_angle_of_repose():
    surface, loose = make_level_profile(80)
    add_loose_soil(NUMBERS, surface, loose, 40, 1.0)
    settle(surface, loose)
    slopes = np.abs(np.diff(surface)) / NUMBERS[CELL_LENGTH]
    limit = math.tan(SOIL.repose)
    assert slopes.max() <= limit + MIN_SLIDING_HEIGHT / NUMBERS[CELL_LENGTH]
    flank = slopes[(surface[:-1] > 0.1) & (surface[1:] > 0.1)]
    assert np.median(flank) == pytest.approx(limit, abs=2.0 * MIN_SLIDING_HEIGHT / NUMBERS[CELL_LENGTH])
    # A heap of slope s and area A is sqrt(A s) high; the cells are 6 % of that.
    assert surface.max() == pytest.approx(math.sqrt(limit / CAT215.width), abs=NUMBERS[CELL_LENGTH])
    assert np.sum(surface) * NUMBERS[CELL_LENGTH] * CAT215.width == pytest.approx(1.0, rel=1e-12)


def test_cut_face_stands_and_a_higher_one_breaks_to_its_slope():
    for height, breaks in ((0.15, False), (0.6, True)):
        surface, loose = make_level_profile(40)
        surface[20:] = height
        before = total_soil_mass(NUMBERS, surface, loose, make_bucket_state())
        settle(surface, loose)
        assert (loose.max() > 0.0) == breaks
        assert np.diff(surface).max() <= math.tan(SOIL.cut_slope) * NUMBERS[CELL_LENGTH] + MIN_SLIDING_HEIGHT
        after = total_soil_mass(NUMBERS, surface, loose, make_bucket_state())
        assert after == pytest.approx(before, rel=1e-12)


def test_nothing_slides_past_a_wall():
    surface, loose = make_level_profile(40)
    add_loose_soil(NUMBERS, surface, loose, 20, 0.5)
    settle(surface, loose, wall=21)
    assert loose[21:].max() == 0.0
    assert loose[:20].max() > 0.0


def test_cut_takes_what_lies_above_the_path():
    surface, loose = make_level_profile(80, 0.5)
    taken = cut_cells(NUMBERS, surface, loose, 6.0, 0.4, 5.0, 0.2)
    assert taken == pytest.approx(SOIL.swell * 0.2 * 1.0 * CAT215.width, rel=1e-12)
    middle = NUMBERS[PROFILE_START] + NUMBERS[CELL_LENGTH] * (np.arange(80) + 0.5)
    swept = (middle > 5.0) & (middle < 6.0)
    assert surface[swept] == pytest.approx(0.4 - 0.2 * (6.0 - middle[swept]), rel=1e-12)
    assert (surface[~swept] == 0.5).all()


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_small_steps_cut_as_one_large_one(way):
    fine, coarse = make_level_profile(80, 0.3), make_level_profile(80, 0.3)
    places = 5.5 + way * np.linspace(0.0, 0.97, 500)
    total = sum(cut_cells(NUMBERS, *fine, a, 0.1, b, 0.1) for a, b in zip(places[:-1], places[1:], strict=True))
    once = cut_cells(NUMBERS, *coarse, places[0], 0.1, places[-1], 0.1)
    assert total == pytest.approx(once, rel=1e-9)
    assert fine[0] == pytest.approx(coarse[0], abs=1e-12)


def test_loose_soil_is_cut_first_and_does_not_swell_again():
    surface, loose = make_level_profile(80)
    add_loose_soil(NUMBERS, surface, loose, 50, 0.006)  # 0.1 m high
    r = NUMBERS[PROFILE_START] + NUMBERS[CELL_LENGTH] * 50.0
    taken = cut_cells(NUMBERS, surface, loose, r + NUMBERS[CELL_LENGTH], 0.0, r, 0.0)
    assert taken == pytest.approx(0.006, rel=1e-12)
    assert surface[50] == pytest.approx(0.0, abs=1e-15)


def test_beside_the_profile_nothing_is_cut_and_what_falls_there_is_told():
    surface, loose = make_level_profile(20, 0.3)
    assert cut_cells(NUMBERS, surface, loose, 2.9, 0.0, 2.0, 0.0) == 0.0
    assert cut_cells(NUMBERS, surface, loose, 6.0, 0.0, 7.0, 0.0) == 0.0
    assert add_loose_soil(NUMBERS, surface, loose, -1, 0.2) == 0.2
    assert add_loose_soil(NUMBERS, surface, loose, 20, 0.2) == 0.2
    assert (surface == 0.3).all()


def test_surface_is_read_between_the_cells():
    surface = np.linspace(0.0, 1.9, 20)
    assert surface_height(NUMBERS, surface, 3.025) == pytest.approx(0.0)
    assert surface_height(NUMBERS, surface, 3.05) == pytest.approx(0.05)
    assert surface_height(NUMBERS, surface, 0.0) == 0.0
    assert surface_height(NUMBERS, surface, 9.0) == pytest.approx(1.9)
    assert find_cell_at_radius(NUMBERS, 3.07) == 1
    assert find_cell_at_radius(NUMBERS, 2.99) == -1


@settings(deadline=None)
@given(data=st.data())
def test_every_move_conserves_mass(data):
    place = st.floats(2.5, 6.5)
    surface, loose = make_level_profile(60, 0.5)
    state = make_bucket_state()
    for _ in range(10):
        before = total_soil_mass(NUMBERS, surface, loose, state)
        if data.draw(st.booleans()):
            z = st.floats(-0.2, 0.6)
            ends = data.draw(place), data.draw(z), data.draw(place), data.draw(z)
            state[0] += cut_cells(NUMBERS, surface, loose, *ends)
        else:
            volume = state[0] * data.draw(st.floats(0.0, 1.0))
            cell = data.draw(st.integers(-1, 60))
            state[0] += add_loose_soil(NUMBERS, surface, loose, cell, volume) - volume
        for _ in range(3):
            slide_soil_in_range(NUMBERS, surface, loose, 0, 59, data.draw(st.integers(-1, 59)))
        assert (loose >= 0.0).all()
        # Rounding of some hundred sums of masses of some tonnes.
        assert total_soil_mass(NUMBERS, surface, loose, state) == pytest.approx(before, rel=1e-12)
