"""A dead band in a loop: what share of a swing passes it."""

import math


def deadband_share(deadband: float, amplitude: float) -> float:
    """Gain of a dead band for a sine about its centre, of its slope outside.

    A loop with a dead band that is unstable by its slope still rests inside; it can sustain a swing
    where this share brings its gain to the limit.

    Args:
        deadband: half of the band d, scalar [m] or [rad].
        amplitude: of the sine A, scalar [m] or [rad], > 0.

    Returns:
        `1 - 2/pi (asin(d/A) + d/A sqrt(1 - (d/A)^2))`, scalar [1]; 0 for a swing inside.

    Source: describing function of a dead zone; Gelb and Vander Velde 1968, appendix B.

    >>> round(deadband_share(1.5e-3, 5.0e-3), 3), deadband_share(2.0, 1.0)
    (0.624, 0.0)
    """
    ratio = deadband / amplitude
    if ratio >= 1.0:
        return 0.0
    return 1.0 - 2.0 / math.pi * (math.asin(ratio) + ratio * math.sqrt(1.0 - ratio**2))
