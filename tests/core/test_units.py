"""Units against their definitions."""

import math

import pytest

from hydrotele.core.units import UNITS, display_unit, plot_axis_unit, si_unit_and_factor
from hydrotele.machine import log_channels


@pytest.mark.parametrize(
    ("unit", "si", "factor"),
    [
        ("deg", "rad", math.pi / 180),
        ("°/s", "rad/s", math.pi / 180),
        ("psi", "Pa", 0.45359237 * 9.80665 / 0.0254**2),  # pound, standard gravity, inch: all exact
        ("bar", "Pa", 1e5),
        ("l/min", "m^3/s", 1 / 60000),
        ("kN·m", "N m", 1e3),
        ("m³/s", "m^3/s", 1.0),
        ("furlong", "furlong", 1.0),
    ],
)
def test_conversion_to_si(unit, si, factor):
    assert si_unit_and_factor(unit)[0] == si
    assert si_unit_and_factor(unit)[1] == pytest.approx(factor, rel=1e-14)  # rounding of one division


def test_units_of_channels_are_si_and_every_unit_leads_to_one():
    known = {
        u for table in (log_channels.MEASURED_KINDS, log_channels.TRUTH_KINDS) for k in table.values() for u in k.units
    }
    assert not known & UNITS.keys()
    assert not {si for si, _ in UNITS.values()} & UNITS.keys()


SI = ("1", "m", "rad", "s", "Pa", "m^3/s", "m^3/(s Pa)", "m^3/Pa", "N", "N m", "N s/m", "N m s/rad",
      "N/m", "N m/rad", "kg m^2")  # fmt: skip


@pytest.mark.parametrize("unit", SI)
@pytest.mark.parametrize("size", [1e-9, 1e-3, 2.0, 1e4, 1e9])
def test_units_for_people_lead_back_to_the_si_unit(unit, size):
    for shown, factor in (plot_axis_unit(unit), display_unit(unit, size)):
        assert si_unit_and_factor(shown)[0] == unit
        assert factor * si_unit_and_factor(shown)[1] == pytest.approx(1.0, rel=1e-14)  # rounding of a division


def test_a_litre_per_minute_and_100_bar_by_their_definitions():
    assert si_unit_and_factor("L/min per 100 bar")[1] == pytest.approx(1e-3 / 60 / 100e5)
    assert si_unit_and_factor("cm³/bar") == ("m^3/Pa", pytest.approx(1e-6 / 1e5))
