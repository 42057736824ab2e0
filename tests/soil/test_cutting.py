"""Closed forms against published numbers, the wedge's own equilibrium and their limits."""

import doctest
import inspect
import math
import re

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from hydrotele import soil
from hydrotele.soil import step, terrain
from hydrotele.soil import step as bucket
from hydrotele.soil import step as cutting
from hydrotele.soil import step as wrench
from hydrotele.soil.parameters import CAT215, SOILS, Soil, pack_soil_parameters
from hydrotele.soil.step import (
    adhesion_factor,
    bearing_pressure,
    cohesion_factor,
    compute_cutting_force,
    failure_plane_angle,
    limit_rake_angle,
    limit_surface_slope,
    surcharge_factor,
    wedge_weight_factor,
)

DEGREE = math.pi / 180.0
PLACES = {"n", "out", "state"}  # packed arrays: `numbers` lists their units
ROOM = (bucket, cutting, step, terrain, wrench)


def laws(module):
    return {
        name: law
        for name, law in vars(module).items()
        if hasattr(law, "py_func") and law.py_func.__module__ == module.__name__ and not name.startswith("_")
    }


LAWS = {f"{m.__name__}.{name}": law for m in ROOM for name, law in laws(m).items()}


@pytest.mark.parametrize("name", LAWS)
def test_docstring_names_every_argument_with_its_unit(name):
    text, law = LAWS[name].__doc__, LAWS[name]
    found = re.search(r"^    Args:(.*?)(?=^    \S|\Z)", text, re.S | re.M)
    assert found
    entries = re.findall(r"^        (\w+): (.*?)(?=^        \w+: |\Z)", found.group(1), re.S | re.M)
    assert [entry[0] for entry in entries] == list(inspect.signature(law.py_func).parameters)
    for argument, meaning in entries:
        assert argument in PLACES or re.search(r"\[[^\]]+\]", meaning), f"{argument} has no unit"
    assert "Returns:" in text
    assert "Source:" in text


def test_doctests_run():
    for module, least in ((cutting, 4), (soil, 8)):
        result = doctest.testmod(module)
        assert result.attempted >= least
        assert result.failed == 0


def passive(phi, delta, slope, batter):
    """Coulomb's K_p from our wedge: over half the specific weight and the wall's height squared."""
    rake = 0.5 * math.pi - batter
    plane = failure_plane_angle(rake + slope, slope, phi, delta)
    factor = wedge_weight_factor(rake + slope, slope, phi, delta, plane)
    return 2.0 * factor * (math.sin(rake + slope) / math.sin(rake)) ** 2


@pytest.mark.parametrize("phi", [10, 20, 30, 40])
def test_smooth_upright_wall_is_rankines(phi):
    expected = math.tan((45 + phi / 2) * DEGREE) ** 2
    assert passive(phi * DEGREE, 0.0, 0.0, 0.0) == pytest.approx(expected, rel=1e-12)
    plane = failure_plane_angle(0.5 * math.pi, 0.0, phi * DEGREE, 0.0)
    cohesion = cohesion_factor(0.5 * math.pi, phi * DEGREE, 0.0, plane)
    assert cohesion == pytest.approx(2.0 * math.sqrt(expected), rel=1e-12)  # Bell 1915


# phi, delta, slope, batter [deg], K_p: table for level ground behind an upright wall (Das,
# Principles of Foundation Engineering), and worked examples of a sloping surface and a battered
# wall (calculatorsweb.site, "Coulomb Passive Earth Pressure"). All are printed to the last digit.
COULOMB = [
    (20, 0, 0, 0, 2.040), (20, 10, 0, 0, 2.636), (20, 20, 0, 0, 3.525), (30, 0, 0, 0, 3.000),
    (30, 5, 0, 0, 3.506), (30, 10, 0, 0, 4.143), (30, 15, 0, 0, 4.977), (30, 20, 0, 0, 6.105),
    (40, 20, 0, 0, 11.772), (30, 10, 0, 0, 4.1433), (34, 16, 8, 0, 10.0910), (38, 12, 5, 6, 6.9481),
]  # fmt: skip


@pytest.mark.parametrize(("phi", "delta", "slope", "batter", "expected"), COULOMB)
def test_wedge_is_coulombs(phi, delta, slope, batter, expected):
    found = passive(phi * DEGREE, delta * DEGREE, slope * DEGREE, batter * DEGREE)
    assert found == pytest.approx(expected, abs=1.01e-3)  # the table rounds up here and there


# Miedema, The Delft Sand, Clay and Rock Cutting Model, Tables I-1 and J-1: a blade as high as the
# layer in sand that an underpressure of 1 holds together, blade angle, delta, phi [deg], and the
# force along and across the motion per area of the layer.
CAVITATING = [
    (15, 15, 32, 1.390, 0.409), (15, 30, 52, 3.764, 1.034), (30, 15, 32, 1.206, 0.474),
    (30, 18, 37, 1.575, 0.588), (30, 24, 42, 2.286, 0.657), (30, 30, 52, 3.781, 1.031),
    (45, 15, 32, 1.419, 0.398), (45, 21, 37, 2.133, 0.396), (45, 27, 42, 3.174, 0.358),
    (45, 30, 52, 5.249, 0.678), (60, 15, 32, 1.879, 0.195), (60, 18, 42, 3.252, 0.329),
    (60, 24, 37, 3.267, -0.126), (60, 30, 52, 8.991, -0.570),
]  # fmt: skip


@pytest.mark.parametrize(("rake", "delta", "phi", "along", "down"), CAVITATING)
def test_cohesion_and_adhesion_are_miedemas(rake, delta, phi, along, down):
    # An underpressure p acts like cohesion p tan(phi) on the plane and adhesion p tan(delta).
    # The tables were computed with 3.14 for pi: with it all decimals come out, else within 0.4 %.
    rake, delta, phi = (x * 3.14 / 180.0 for x in (rake, delta, phi))

    def forces(plane):
        inclined = math.tan(phi) * cohesion_factor(rake, phi, delta, plane)
        inclined += math.tan(delta) * adhesion_factor(rake, phi, delta, plane)
        return (
            inclined * math.sin(rake + delta) + math.tan(delta) / math.tan(rake),
            inclined * math.cos(rake + delta) - math.tan(delta),
        )

    widest = min(1.4, math.pi - rake - delta - phi - 0.01)
    best = minimize_scalar(lambda b: forces(b)[0], bounds=(0.05, widest), method="bounded")
    found = forces(best.x)
    assert found == pytest.approx((along, down), abs=6e-4)  # printed to three decimals


# N_q and N_c of strip footings under upright loads, SP 22.13330.2016, Table 5.12.
FOOTING = [
    (5, 1.57, 6.49), (10, 2.47, 8.34), (15, 3.94, 10.98), (20, 6.40, 14.84), (25, 10.66, 20.72),
    (30, 18.40, 30.14), (35, 33.30, 46.12), (40, 64.19, 75.31),
]  # fmt: skip


@pytest.mark.parametrize(("phi", "overburden", "cohesion"), FOOTING)
def test_level_face_bears_like_a_strip_footing(phi, overburden, cohesion):
    assert bearing_pressure(1.0, 0.0, phi * DEGREE, 0.0) == pytest.approx(overburden, abs=0.011)
    assert bearing_pressure(0.0, 1.0, phi * DEGREE, 0.0) == pytest.approx(cohesion, abs=0.011)


def test_upright_face_bears_like_a_passive_wall():
    phi, c, q = 30 * DEGREE, 7.0e3, 2.0e3
    expected = 3.0 * q + 2.0 * c * math.sqrt(3.0)
    assert bearing_pressure(q, c, phi, 0.5 * math.pi) == pytest.approx(expected, rel=1e-12)


angles = {
    "rake": st.floats(16, 90), "slope": st.floats(-12, 12), "phi": st.floats(20, 40),
    "delta": st.floats(1, 20),
}  # fmt: skip


@given(**angles, share=st.floats(0.02, 0.98))
def test_plane_has_the_least_weight_factor(rake, slope, phi, delta, share):
    slope, phi, delta = slope * DEGREE, phi * DEGREE, delta * DEGREE
    rake = limit_rake_angle(rake * DEGREE, slope, phi, delta)
    widest = math.pi - rake - delta - phi
    best = failure_plane_angle(rake, slope, phi, delta)
    assume(6 * DEGREE < best < 84 * DEGREE)  # not at its bounds
    assume(rake + delta - slope > 20 * DEGREE)  # not where the wedge is kept from jamming
    other = share * min(widest, 0.5 * math.pi)
    least = wedge_weight_factor(rake, slope, phi, delta, best)
    assert least > 0.0
    assert least <= wedge_weight_factor(rake, slope, phi, delta, other) * (1.0 + 1e-9)


@given(**angles, plane=st.floats(10, 40), c=st.floats(0, 5e4), a=st.floats(0, 1e4))
def test_wedge_is_in_equilibrium(rake, slope, phi, delta, plane, c, a):
    """The factors against the two force balances of the wedge, solved as they stand."""
    rake, slope, phi, delta, plane = (x * DEGREE for x in (rake, slope, phi, delta, plane))
    assume(rake + delta + phi + plane < 170 * DEGREE)
    depth, weight, load = 0.3, 1.7e4, 2.0e3
    # Soil moves towards -x; the surface rises that way. Both planes start at the edge, (0, 0).
    blade, back = rake - slope, plane + slope  # against the horizontal
    along_plane = np.array([-math.cos(back), math.sin(back)])
    along_blade = np.array([math.cos(blade), math.sin(blade)])
    on_plane, on_blade = depth / math.sin(plane), depth / math.sin(rake)
    area = 0.5 * on_plane * on_blade * math.sin(math.pi - rake - plane)
    normal_plane = np.array([math.sin(back), math.cos(back)])  # into the wedge
    normal_blade = np.array([-math.sin(blade), math.cos(blade)])
    reaction = math.cos(phi) * normal_plane - math.sin(phi) * along_plane
    push = math.cos(delta) * normal_blade - math.sin(delta) * along_blade
    known = np.array([0.0, -weight * area - load])
    known -= c * on_plane * along_plane + a * on_blade * along_blade
    expected = np.linalg.solve(np.column_stack([push, reaction]), -known)[0]
    found = weight * depth**2 * wedge_weight_factor(rake, slope, phi, delta, plane)
    found += load * surcharge_factor(rake, slope, phi, delta, plane)
    found += c * depth * cohesion_factor(rake, phi, delta, plane)
    found += a * depth * adhesion_factor(rake, phi, delta, plane)
    scale = weight * depth**2 + load + (c + a) * depth
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * scale)


def numbers():
    return pack_soil_parameters(SOILS["sandy_loam"], CAT215, 3.0, 0.05)


def force(n, depth, rake=48 * DEGREE, slope=0.0, loose=0.0, load=0.0):
    out = np.empty(2)
    compute_cutting_force(n, depth, loose, rake, slope, load, out)
    return out


@given(
    rake=st.floats(-4, 4), slope=st.floats(-1.5, 1.5), depth=st.floats(0, 2),
    loose=st.floats(0, 3), load=st.floats(0, 2e4), name=st.sampled_from(sorted(SOILS)),
)  # fmt: skip
def test_cutting_force_is_bounded(rake, slope, depth, loose, load, name):
    s = SOILS[name]
    out = force(pack_soil_parameters(s, CAT215, 3.0, 0.05), depth, rake, slope, loose, load)
    assert np.isfinite(out).all()
    weight = s.density * 9.81 * depth * depth * CAT215.width
    # No factor exceeds 60: that of a rough upright blade in a steep surface is the largest.
    bound = 60.0 * (weight + load) + 60.0 * depth * CAT215.width * (s.cohesion + s.adhesion)
    assert math.hypot(*out) <= bound


def test_force_vanishes_with_depth_and_grows_with_it():
    n = numbers()
    assert force(n, 0.0).tolist() == [0.0, 0.0]
    assert force(n, -0.1).tolist() == [0.0, 0.0]
    depths = np.linspace(0.0, 0.5, 200)
    sizes = np.array([force(n, d, load=8e3)[0] for d in depths])
    assert (np.diff(sizes) > 0.0).all()
    assert sizes[1] < 100.0  # N, at 2.5 mm


def test_force_is_continuous_in_all_angles():
    n = numbers()
    for sweep in (
        [force(n, 0.2, rake=a) for a in np.linspace(-3.1, 3.1, 20001)],
        [force(n, 0.2, slope=a) for a in np.linspace(-1.5, 1.5, 20001)],
    ):
        jumps = np.abs(np.diff(sweep, axis=0)).max()
        assert jumps < 0.01 * np.abs(sweep).max()  # a jump would not shrink with the mesh


def test_units_fit():
    # Lengths k times as long, cohesion and adhesion with them, give k^3 the force.
    small = force(numbers(), 0.1, load=1.0e3)
    wide = CAT215._replace(width=2.0 * CAT215.width)
    loam = SOILS["sandy_loam"]
    strong = loam.model_copy(update={"cohesion": 2 * loam.cohesion, "adhesion": 2 * loam.adhesion})
    large = force(pack_soil_parameters(strong, wide, 3.0, 0.05), 0.2, load=8.0e3)
    assert large == pytest.approx(8.0 * small, rel=1e-12)


def test_soil_in_the_bucket_and_loose_soil_change_the_force():
    n = numbers()
    assert force(n, 0.2, load=4e3)[0] > force(n, 0.2)[0]
    assert force(n, 0.2, loose=0.1)[0] < force(n, 0.2)[0]  # no cohesion where it is loose


def test_slope_and_rake_stay_where_the_equation_holds():
    assert limit_surface_slope(1.0, 0.5) == pytest.approx(0.3)
    assert limit_rake_angle(2.5, 0.0, 0.5, 0.3) == pytest.approx(0.5 * math.pi)
    assert limit_rake_angle(0.0, 0.0, 0.5, 0.3) == pytest.approx(15 * DEGREE)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"friction": 0.3, "tool_friction": 0.4}, "slides"),
        ({"cohesion": 100.0, "adhesion": 200.0}, "lets go"),
        ({"repose": 0.8, "cut_slope": 0.7}, "below repose"),
        ({"density": 170.0}, "800"),
        ({"swell": 0.9}, "1"),
    ],
)
def test_impossible_soils_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Soil(**change)
