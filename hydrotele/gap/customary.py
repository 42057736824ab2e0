"""Numbers as a mechanic says them: mm, deg, bar or MPa, ms, %, L/min, with honest digits."""

import math
from typing import NamedTuple

from hydrotele.core.units import customary
from hydrotele.gap.result import Estimate

_LEAST_DIGITS, _MOST_DECIMALS = 3, 6


class CustomaryEstimate(NamedTuple):
    """An estimate in customary numbers, as texts without unit, and the unit; `-` if unknown."""

    value: str
    low: str
    high: str
    nominal: str
    unit: str


def amount(value: float, unit: str, parameter: str = "") -> str:
    """A number [unit] with three digits and its customary unit.

    >>> amount(0.0021, "m"), amount(-60e3, "Pa"), amount(0.0, "kg")
    ('2.1 mm', '-0.6 bar', '0 kg')
    """
    shown, factor = customary(unit, value, parameter)
    return f"{_rounded(value * factor)} {shown}"


def in_customary_units(estimate: Estimate, parameter: str = "") -> CustomaryEstimate:
    """An estimate in customary numbers; the interval decides how many digits are worth saying.

    >>> in_customary_units(Estimate(0.0853, "1", 0.0841, 0.0864, 0.04), "deadband")
    CustomaryEstimate(value='8.53', low='8.41', high='8.64', nominal='4', unit='%')
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
