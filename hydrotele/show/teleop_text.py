"""Wording of stability, margins, delays and errors of a teleoperator in tables and reports."""

import math

import numpy as np

from hydrotele.teleop.linear_analysis import (
    MAX_TESTED_DELAY,
    MAX_TESTED_FACTOR,
    StructureAnalysis,
)


def describe_stability(analysis: StructureAnalysis, released: bool = False) -> str:
    """Return a short text that states whether a structure is stable, with its number of unstable poles.

    A structure is stable if it has no unstable poles in contact with the task and in free motion.
    If it is stable in contact only, the text ends with `when free`.

    Args:
        analysis: results of the linear analysis of the structure.
        released: whether to describe the released handle instead of the held one.

    Returns:
        Text such as `no, 2 poles`; `yes` if the structure is stable.
    """
    both = (analysis.unstable_poles, analysis.unstable_poles_free)
    if released:
        both = (analysis.unstable_poles_released, analysis.unstable_poles_released_free)
    if both == (0, 0):
        return "yes"
    free = "" if both[0] != 0 else " when free"
    many = both[0] if not free else both[1]
    if many is None:
        return f"no, poles on the axis{free}"
    return f"no, {many} pole{'s' * (many != 1)}{free}"


def format_gain_margin(margin: float) -> str:
    """Format a gain margin as a factor; an infinite one as more than the largest tested factor.

    >>> format_gain_margin(0.17), format_gain_margin(math.inf)
    ('x 0.17', '> x 1000')
    """
    return f"> x {MAX_TESTED_FACTOR:g}" if math.isinf(margin) else f"x {margin:.3g}"


def format_delay(delay: float) -> str:
    """Format a maximum stable delay [s]; an infinite one as more than the largest tested delay.

    >>> format_delay(0.12345), format_delay(math.inf)
    ('123 ms', '> 10 s')
    """
    return f"> {MAX_TESTED_DELAY:g} s" if math.isinf(delay) else f"{1e3 * delay:.3g} ms"


def format_number(value: float) -> str:
    """Format a number with five significant digits, without an exponent.

    >>> format_number(-20026.0), format_number(0.0123456)
    ('-20026', '0.012346')
    """
    return np.format_float_positional(value, precision=5, fractional=False, trim="-")


def format_relative_error(error: float | None) -> str:
    """Format a relative error in per cent; `not measurable` for None.

    >>> format_relative_error(0.0016), format_relative_error(1e-7)
    ('0.16 %', '< 0.01 %')
    """
    if error is None:
        return "not measurable"
    return "< 0.01 %" if error < 1e-4 else f"{100.0 * error:.2g} %"
