"""Numbers as a mechanic says them: mm, deg, bar or MPa, ms, %, L/min, with honest digits."""

import math
from typing import NamedTuple

from hydrotele.gap.result import Estimate

# SI unit -> (smallest magnitude in SI, customary unit, factor), the largest first.
_CUSTOMARY: dict[str, tuple[tuple[float, str, float], ...]] = {
    "1": ((0.0, "%", 1e2),),
    "m": ((1.0, "m", 1.0), (0.0, "mm", 1e3)),
    "m/s": ((0.0, "mm/s", 1e3),),
    "rad": ((0.0, "deg", 180.0 / math.pi),),
    "rad/s": ((0.0, "deg/s", 180.0 / math.pi),),
    "s": ((1.0, "s", 1.0), (0.0, "ms", 1e3)),
    "Pa": ((1e6, "MPa", 1e-6), (0.0, "bar", 1e-5)),
    "m^3/s": ((0.0, "L/min", 6e4),),
    "m^3/(s Pa)": ((0.0, "L/min per 100 bar", 6e11),),
    "m^3/Pa": ((0.0, "cm³/bar", 1e11),),
    "N": ((1e3, "kN", 1e-3), (0.0, "N", 1.0)),
    "N m": ((1e3, "kN m", 1e-3), (0.0, "N m", 1.0)),
    "N s/m": ((1e3, "kN s/m", 1e-3), (0.0, "N s/m", 1.0)),
    "N m s/rad": ((1e3, "kN m s/rad", 1e-3), (0.0, "N m s/rad", 1.0)),
    "N/m": ((1e6, "MN/m", 1e-6), (0.0, "kN/m", 1e-3)),
    "N m/rad": ((1e6, "MN m/rad", 1e-6), (0.0, "kN m/rad", 1e-3)),
    "kg m^2": ((0.0, "kg m²", 1.0),),
}
_HERTZ = ("Hz", 0.5 / math.pi)
_LEAST_DIGITS, _MOST_DECIMALS = 3, 6


class CustomaryEstimate(NamedTuple):
    """An estimate in customary numbers, as texts without unit, and the unit; `-` if unknown."""

    value: str
    low: str
    high: str
    nominal: str
    unit: str


def customary(unit: str, size: float, parameter: str = "") -> tuple[str, float]:
    """Customary unit for numbers of a size, and the factor to it.

    Args:
        unit: SI unit.
        size: the largest magnitude to be shown [unit].
        parameter: its name; a bandwidth is said in Hz.

    Returns:
        (customary unit, factor).

    >>> customary("Pa", 24.5e6), customary("Pa", 6e4)
    (('MPa', 1e-06), ('bar', 1e-05))
    """
    if unit == "rad/s" and parameter.endswith("bandwidth"):
        return _HERTZ
    for least, shown, factor in _CUSTOMARY.get(unit, ()):
        if abs(size) >= least or not math.isfinite(size):
            return shown, factor
    return unit, 1.0


def amount(value: float, unit: str, parameter: str = "") -> str:
    """A number [unit] with three digits and its customary unit.

    >>> amount(0.0021, "m"), amount(-60e3, "Pa"), amount(0.0, "kg")
    ('2.1 mm', '-0.6 bar', '0 kg')
    """
    shown, factor = customary(unit, value, parameter)
    return f"{_rounded(value * factor)} {shown}"


def in_customary_units(estimate: Estimate, parameter: str = "") -> CustomaryEstimate:
    """An estimate in customary numbers; the interval decides how many digits are worth saying.

    >>> said(Estimate(0.0853, "1", 0.0841, 0.0864, 0.04), "deadband")
    Said(value='8.53', low='8.41', high='8.64', nominal='4', unit='%')
    """
    numbers = (estimate.value, estimate.low, estimate.high, estimate.nominal)
    size = max((abs(x) for x in numbers[:3] if math.isfinite(x)), default=math.nan)
    unit, factor = customary(estimate.unit, size, parameter)
    width = 0.5 * abs(estimate.high - estimate.low) * factor
    value, low, high = (_number(x * factor, width) for x in numbers[:3])
    return CustomaryEstimate(value, low, high, _rounded(estimate.nominal * factor), unit)


def _number(value: float, width: float) -> str:
    """With two digits of the half width of its interval, or three of its own without one."""
    if not math.isfinite(value):
        return "-"
    if not (math.isfinite(width) and width > 0):
        return _rounded(value)
    decimals = min(max(0, 1 - math.floor(math.log10(width))), _MOST_DECIMALS)
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def _rounded(value: float) -> str:
    """With three digits, never with an exponent where a person would write none."""
    if not math.isfinite(value):
        return "-"
    if value == 0 or not 1e-3 <= abs(value) < 1e6:
        return f"{value + 0.0:.{_LEAST_DIGITS}g}"
    decimals = max(0, _LEAST_DIGITS - 1 - math.floor(math.log10(abs(value))))
    text = f"{value:.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
