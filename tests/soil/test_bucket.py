"""What a bucket holds, against a count of small squares, and its shape against the MJCF."""

import math
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hydrotele.core.errors import InputError
from hydrotele.core.files import models_folder
from hydrotele.soil.parameters import (
    CAT215,
    SOILS,
    make_level_profile,
    outline_relative_to_edge,
    pack_soil_parameters,
)
from hydrotele.soil.step import compute_bucket_capacity

DEGREE = math.pi / 180.0
SOIL = SOILS["sandy_loam"]
NUMBERS = pack_soil_parameters(SOIL, CAT215, 3.0, 0.05)


def held(attitude, level=0.0):
    out = np.empty(4)
    compute_bucket_capacity(NUMBERS, attitude, level, out)
    return out


def inside(points, polygon):
    """Which points (k, 2) lie in a polygon (m, 2), by counting crossings."""
    x, z = points.T
    result = np.zeros(len(points), bool)
    for (x0, z0), (x1, z1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (z0 > z) != (z1 > z)
        result ^= crosses & (x < x0 + (z - z0) / (z1 - z0 + 1e-300) * (x1 - x0))
    return result


@settings(deadline=None, max_examples=60)
@given(attitude=st.floats(-260, 80), level=st.floats(0.0, 0.6))
def test_held_volume_is_what_lies_below_the_surface(attitude, level):
    a = attitude * DEGREE
    turn = np.array([[math.cos(a), math.sin(a)], [-math.sin(a), math.cos(a)]])
    polygon = outline_relative_to_edge(CAT215) @ turn
    rim = polygon[-1]
    tilt = math.atan2(abs(rim[1]), rim[0])
    volume, r, z, low = held(a, level)
    if tilt < SOIL.repose:
        x, z = polygon.T
        struck = 0.5 * abs(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1)))
        assert volume >= struck * CAT215.inner_width - 1e-12  # full to the mouth, and more
        return
    side = 0.01
    grid = np.arange(-1.6, 1.6, side)
    points = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    start = rim if rim[1] < 0.0 else np.zeros(2)
    assert low == pytest.approx(start[0])
    if rim[1] > 0.0:
        start = min(level / rim[1], 1.0) * rim
    slope = math.tan(SOIL.repose) * (1.0 if rim[1] >= 0.0 else -1.0)
    below = points[:, 1] <= start[1] + slope * (points[:, 0] - start[0])
    counted = points[inside(points, polygon) & below]
    expected = len(counted) * side**2 * CAT215.inner_width
    assert volume == pytest.approx(expected, abs=0.02)  # squares along 3.5 m of boundary
    if expected > 0.1:
        assert np.array([r, z]) == pytest.approx(counted.mean(axis=0), abs=0.02)


def test_curled_bucket_carries_a_heaped_load_and_a_dumped_one_nothing():
    assert 0.7 < held(-180 * DEGREE)[0] < 1.0  # m^3, such a machine's bucket
    assert held(-178 * DEGREE)[0] > held(-150 * DEGREE)[0] > held(-120 * DEGREE)[0] > 0.0
    for attitude in (-90, -60, -30, 0, 30):
        assert held(attitude * DEGREE)[0] == 0.0


def test_soil_ahead_props_what_lies_in_the_mouth():
    levels = [held(-100 * DEGREE, level)[0] for level in (0.0, 0.1, 0.2, 0.4, 0.8)]
    assert (np.diff(levels) > 0.0).all()


def test_shape_is_that_of_the_model():
    path = models_folder() / "cat215" / "cat215.xml"
    root = ElementTree.parse(path).getroot()
    mesh = root.find(".//mesh[@name='bucket_side']")
    assert mesh is not None
    corners = np.array(mesh.get("vertex", "").split(), float).reshape(-1, 3)[:9, ::2]
    outline = np.array(CAT215.outline)
    for corner in outline[1:]:  # the side plates' corners; the edge is the teeth's tip
        assert np.hypot(*(corners - corner).T).min() < 0.01
    floor = root.find(".//geom[@name='bucket_edge']")
    assert floor is not None
    w, _, y, _ = map(float, floor.get("quat", "").split())
    assert 2.0 * math.atan2(y, w) == pytest.approx(CAT215.floor_angle, abs=1.0 * DEGREE)
    assert 2.0 * float(floor.get("size", "").split()[1]) == pytest.approx(CAT215.width)


def test_unusable_profiles_and_buckets_are_refused():
    with pytest.raises(InputError, match="0.01 to 0.5"):
        pack_soil_parameters(SOIL, CAT215, 3.0, 0.0)
    with pytest.raises(InputError, match="at least 0"):
        pack_soil_parameters(SOIL, CAT215, -1.0, 0.05)
    with pytest.raises(InputError, match="3 to 16"):
        pack_soil_parameters(SOIL, CAT215._replace(outline=CAT215.outline[:2]), 3.0, 0.05)
    with pytest.raises(InputError, match="at least 8"):
        make_level_profile(3)
