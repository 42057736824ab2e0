"""Filter and differentiation of periodic signals in the frequency domain."""

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.smoothed import Smoothed, checked_period, columns_of, per_column

_WHERE = "periodic filter"


def periodic(
    values: np.ndarray,
    period: float,
    samples_per_cycle: int,
    harmonics: int,
    noise: float | np.ndarray | None = None,
) -> Smoothed:
    """Keep the mean and the first harmonics of whole cycles, and differentiate them exactly.

    With `N` samples, white noise of standard deviation s leaves `s sqrt((1 + 2 H) / N)` in the
    value, `s sqrt(2 sum_h w_h^2 / N)` in the rate and `s sqrt(2 sum_h w_h^4 / N)` in the
    acceleration.

    Args:
        values: (n,) or (n, k) samples on a uniform clock, n a multiple of `samples_per_cycle`, and
            the machine in its steady cycle [u].
        period: time between samples [s].
        samples_per_cycle: of the excitation [1].
        harmonics: number H of harmonics to keep [1], below half of `samples_per_cycle`.
        noise: standard deviation of one sample, scalar or (k,) [u]; None to find it from what is
            not kept.

    Returns:
        The filtered signals, in the shape of `values`; all cycles are the same, their mean.

    Raises:
        InputError: samples are missing, n is no multiple, or too many harmonics.

    Source: Abdellatif 2008, section on frequency-domain filtering; Swevers et al. 1997, IEEE Trans.
    Robotics and Automation 13(5).

    >>> import numpy as np
    >>> phase = 2 * np.pi * np.arange(100) / 50
    >>> found = periodic(np.sin(phase), 0.02, samples_per_cycle=50, harmonics=3)
    >>> bool(np.allclose(found.rate, 2 * np.pi * np.cos(phase)))
    True
    """
    dt, samples = checked_period(period, _WHERE), columns_of(values, 1, _WHERE)
    rows, cycle = len(samples), int(samples_per_cycle)
    if not np.isfinite(samples).all():
        row = int(np.argwhere(np.isnan(samples))[0, 0])
        raise InputError(
            _WHERE, f"row {row} is missing, whole cycles are needed: use the optimal smoother"
        )
    if cycle < 3 or rows % cycle:
        raise InputError(
            _WHERE,
            f"{rows} samples are not whole cycles of {cycle}: cut the record to"
            f" {rows // max(cycle, 1) * cycle} samples",
        )
    if not 0 <= harmonics < 0.5 * cycle:
        raise InputError(
            _WHERE, f"{cycle} samples per cycle tell less than {cycle / 2:g} harmonics"
        )
    mean = samples.reshape(-1, cycle, samples.shape[1]).mean(axis=0)
    spectrum = np.fft.rfft(mean, axis=0)
    spectrum[harmonics + 1 :] = 0.0
    turn = 2j * np.pi * np.arange(len(spectrum))[:, None] / (cycle * dt)
    parts = [np.fft.irfft(spectrum * turn**k, cycle, axis=0) for k in range(3)]
    whole = [np.tile(part, (rows // cycle, 1)) for part in parts]
    free = rows - 1 - 2 * harmonics
    if noise is not None:
        sigma = per_column(noise, samples.shape[1], "noise", _WHERE)
    elif free > 0:
        sigma = np.sqrt(np.sum((samples - whole[0]) ** 2, axis=0) / free)
    else:
        sigma = np.full(samples.shape[1], np.nan)
    speeds = np.abs(turn[1 : harmonics + 1, 0])
    gains = [1.0 + 2.0 * harmonics, 2.0 * np.sum(speeds**2), 2.0 * np.sum(speeds**4)]
    shape = np.shape(values)
    spread = (np.broadcast_to(sigma * np.sqrt(g / rows), samples.shape) for g in gains)
    return Smoothed(
        *(part.reshape(shape) for part in whole), *(s.reshape(shape).copy() for s in spread)
    )
