"""Conversion of units to SI, alternative spellings, key suffixes and display units.

Logs, YAML files, plots and reports all use these tables.
"""

import math
from collections.abc import Mapping

PSI = 6894.757293168361  # Pa, exact pound-force and inch

UNITS: Mapping[str, tuple[str, float]] = {
    "deg": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "rev": ("rad", 2 * math.pi),
    "deg/s": ("rad/s", math.pi / 180),
    "rpm": ("rad/s", math.pi / 30),
    "deg/s^2": ("rad/s^2", math.pi / 180),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "in": ("m", 0.0254),
    "ft": ("m", 0.3048),
    "mm/s": ("m/s", 1e-3),
    "cm/s": ("m/s", 1e-2),
    "mm/s^2": ("m/s^2", 1e-3),
    "g0": ("m/s^2", 9.80665),
    "psi": ("Pa", PSI),
    "bar": ("Pa", 1e5),
    "mbar": ("Pa", 1e2),
    "kPa": ("Pa", 1e3),
    "MPa": ("Pa", 1e6),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "min": ("s", 60.0),
    "%": ("1", 1e-2),
    "%/s": ("1/s", 1e-2),
    "L/min": ("m^3/s", 1e-3 / 60),
    "L/s": ("m^3/s", 1e-3),
    "kN": ("N", 1e3),
    "lbf": ("N", 4.4482216152605),
    "kN m": ("N m", 1e3),
    "mV": ("V", 1e-3),
    "MN/m": ("N/m", 1e6),
    "kN/m": ("N/m", 1e3),
    "MN m/rad": ("N m/rad", 1e6),
    "kN m/rad": ("N m/rad", 1e3),
    "kN s/m": ("N s/m", 1e3),
    "kN m s/rad": ("N m s/rad", 1e3),
    "in^2": ("m^2", 0.0254**2),
    "cm^2": ("m^2", 1e-4),
    "cm^3/bar": ("m^3/Pa", 1e-11),
    "L/min per 100 bar": ("m^3/(s Pa)", 1e-10 / 60),
    "bar per 100 L/min": ("Pa s/m^3", 6e7),
}
"""Unit -> (SI unit, factor to it). All conversions are pure scalings."""

_SPELLINGS = {
    "-": "1", "sec": "s", "seconds": "s", "volt": "V", "µs": "us", "s^-1": "1/s",
    "Nm": "N m", "N*m": "N m", "N.m": "N m", "kNm": "kN m", "kN*m": "kN m", "m3/s": "m^3/s",
    "rad/s2": "rad/s^2", "deg/s2": "deg/s^2", "m/s2": "m/s^2", "°": "deg", "°/s": "deg/s",
    "l/min": "L/min", "lpm": "L/min", "degree": "deg", "degrees": "deg", "percent": "%", "°C": "degC",
}  # fmt: skip

_SI_UNITS = frozenset({si for si, _ in UNITS.values()} | {"mA", "degC"})

KEY_SUFFIXES: Mapping[str, str] = {
    "_deg": "deg", "_mm": "mm", "_in2": "in^2", "_cm2": "cm^2", "_psi": "psi", "_bar": "bar",
    "_hz": "Hz", "_l_min": "L/min", "_ms": "ms",
}  # fmt: skip
"""Suffix of a key in a YAML file -> unit. For an angular frequency, Hz stands for 2 pi rad/s."""

_AXIS_UNITS: Mapping[str, str] = {
    "rad": "deg", "rad/s": "deg/s", "rad/s^2": "deg/s^2", "m": "mm", "m/s": "mm/s",
    "m/s^2": "mm/s^2", "Pa": "MPa", "m^3/s": "L/min", "N": "kN", "N m": "kN m",
}  # fmt: skip

# SI unit -> (smallest magnitude in SI, unit in reports), in descending order of magnitude.
_REPORT_UNITS: Mapping[str, tuple[tuple[float, str], ...]] = {
    "1": ((0.0, "%"),),
    "m": ((1.0, "m"), (0.0, "mm")),
    "m/s": ((0.0, "mm/s"),),
    "rad": ((0.0, "deg"),),
    "rad/s": ((0.0, "deg/s"),),
    "s": ((1.0, "s"), (0.0, "ms")),
    "Pa": ((1e6, "MPa"), (0.0, "bar")),
    "m^3/s": ((0.0, "L/min"),),
    "m^3/(s Pa)": ((0.0, "L/min per 100 bar"),),
    "Pa s/m^3": ((0.0, "bar per 100 L/min"),),
    "m^3/Pa": ((0.0, "cm³/bar"),),
    "N": ((1e3, "kN"), (0.0, "N")),
    "N m": ((1e3, "kN m"), (0.0, "N m")),
    "N s/m": ((1e3, "kN s/m"), (0.0, "N s/m")),
    "N m s/rad": ((1e3, "kN m s/rad"), (0.0, "N m s/rad")),
    "N/m": ((1e6, "MN/m"), (0.0, "kN/m")),
    "N m/rad": ((1e6, "MN m/rad"), (0.0, "kN m/rad")),
    "kg m^2": ((0.0, "kg m²"),),
}


def canonical_unit(text: str) -> str:
    """Return the canonical spelling of a unit, or the stripped text if the unit is unknown.

    >>> canonical_unit("Nm"), canonical_unit("l/min")
    ('N m', 'L/min')
    """
    unit = text.strip().replace("²", "^2").replace("³", "^3").replace("·", "*").replace("μ", "µ")
    return _SPELLINGS.get(unit, unit)


def si_unit_and_factor(unit: str) -> tuple[str, float]:
    """Return the SI unit that corresponds to a unit, and the factor by which values are multiplied.

    An unknown unit is returned unchanged with factor 1.

    >>> si_unit_and_factor("bar")
    ('Pa', 100000.0)
    """
    unit = canonical_unit(unit)
    return UNITS.get(unit, (unit, 1.0))


def is_known_unit(text: str) -> bool:
    """Return whether a text is a unit that has a conversion to SI, or the SI unit of one.

    >>> is_known_unit("bar"), is_known_unit("V"), is_known_unit("boom")
    (True, True, False)
    """
    unit = canonical_unit(text)
    return unit in UNITS or unit in _SI_UNITS


def plot_axis_unit(unit: str) -> tuple[str, float]:
    """Return the unit used on the axes of plots for an SI unit, and the factor to multiply values by.

    >>> plot_axis_unit("Pa")
    ('MPa', 1e-06)
    >>> plot_axis_unit("1")
    ('1', 1.0)
    """
    shown = _AXIS_UNITS.get(unit, unit)
    return shown, 1.0 / si_unit_and_factor(shown)[1]


def display_unit(unit: str, magnitude: float, parameter: str = "") -> tuple[str, float]:
    """Return the unit in which reports show values of a given magnitude, and the factor to it.

    Args:
        unit: SI unit.
        magnitude: the largest magnitude to be displayed [unit].
        parameter: name of the parameter; a bandwidth in rad/s is displayed in Hz.

    Returns:
        (display unit, factor).

    >>> display_unit("Pa", 24.5e6), display_unit("Pa", 6e4)
    (('MPa', 1e-06), ('bar', 1e-05))
    """
    if unit == "rad/s" and parameter.endswith("bandwidth"):
        return "Hz", 0.5 / math.pi
    for least, shown in _REPORT_UNITS.get(unit, ()):
        if abs(magnitude) >= least or not math.isfinite(magnitude):
            return shown, 1.0 / si_unit_and_factor(shown)[1]
    return unit, 1.0
