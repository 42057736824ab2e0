"""Zero-phase low-pass filter (Butterworth, forwards and backwards) with derivatives by central differences."""

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.smoothed_signal import SmoothedSignal, as_columns, check_period, expand_per_column

_ZERO_PHASE_CONTEXT = "zero-phase filter"


def filter_zero_phase(
    values: np.ndarray,
    period: float,
    cutoff: float,
    noise: float | np.ndarray | None = None,
    *,
    order: int = 4,
    max_gap: int = 0,
) -> SmoothedSignal:
    """Filter by a zero-phase low-pass, and differentiate by central differences.

    The two passes together have the gain `1 / (1 + (tan(pi f dt) / tan(pi f_c dt))^(2 order))`,
    which is 1/2 at the cutoff f_c. The relative error of the five-point differences at a frequency
    f is `(2 pi f dt)^4 / 30` for the rate and a third of that for the acceleration.

    Args:
        values: (n,) or (n, k) samples on a uniform clock, NaN where missing [u].
        period: time between samples [s].
        cutoff: f_c [Hz], below half the sample rate.
        noise: standard deviation of one sample, scalar or (k,), for the standard deviations [u].
        order: order of the Butterworth filter, which is applied twice [1].
        max_gap: longest gap that is interpolated linearly [samples]; with 0, missing samples are an
            error.

    Returns:
        The filtered signals in the shape of `values`. Their standard deviations include the noise,
        but not the attenuation of the signal by the filter or effects at the ends.

    Raises:
        InputError: the cutoff is not below half the sample rate, too few samples, or a gap is
            longer than `max_gap` or at an end.

    Source: Gustafsson 1996, IEEE Trans. Signal Processing 44(4); five-point differences: Abramowitz
    and Stegun 25.3.6 and 25.3.24.

    >>> import numpy as np
    >>> time = 0.01 * np.arange(400)
    >>> found = filter_zero_phase(np.sin(3 * time), 0.01, cutoff=5.0)
    >>> bool(np.abs(found.rate - 3 * np.cos(3 * time))[50:-50].max() < 1e-3)
    True
    """
    dt = check_period(period, _ZERO_PHASE_CONTEXT)
    if not 0.0 < cutoff < 0.5 / dt:
        raise InputError(
            _ZERO_PHASE_CONTEXT,
            f"the cutoff must lie between 0 and half the sample rate, {0.5 / dt:g} Hz, got {cutoff:g} Hz",
        )
    samples = _interpolate_gaps(as_columns(values, 2, _ZERO_PHASE_CONTEXT), max_gap)
    from scipy.signal import butter, sosfiltfilt  # this import takes half a second

    filtering = butter(order, cutoff, fs=1.0 / dt, output="sos")
    pad = round(3.0 / (cutoff * dt))  # the filter's transient lasts three periods
    if len(samples) <= pad:
        raise InputError(
            _ZERO_PHASE_CONTEXT,
            f"{len(samples)} samples are too few for a cutoff of {cutoff:g} Hz, more than {pad} are"
            " needed: raise the cutoff",
        )
    parts = _derivatives(sosfiltfilt(filtering, samples, axis=0, padlen=pad), dt)
    deviations = np.full((3, samples.shape[1]), np.nan)
    if noise is not None:
        impulse = np.zeros((4 * pad + 1, 1))
        impulse[2 * pad] = 1.0
        answers = _derivatives(sosfiltfilt(filtering, impulse, axis=0, padlen=0), dt)
        gains = np.sqrt([np.sum(answer**2) for answer in answers])
        deviations = gains[:, None] * expand_per_column(noise, samples.shape[1], "noise", _ZERO_PHASE_CONTEXT)
    shape = np.shape(values)
    spread = (np.broadcast_to(d, samples.shape).reshape(shape).copy() for d in deviations)
    return SmoothedSignal(*(part.reshape(shape) for part in parts), *spread)


def _interpolate_gaps(samples: np.ndarray, max_gap: int) -> np.ndarray:
    rows = np.arange(len(samples))
    for k in range(samples.shape[1]):
        known = np.flatnonzero(np.isfinite(samples[:, k]))
        missing = max(np.diff(known).max() - 1, known[0], rows[-1] - known[-1])
        if missing == 0:
            continue
        if known[0] > 0 or known[-1] < rows[-1]:
            raise InputError(
                _ZERO_PHASE_CONTEXT,
                f"column {k} has no samples at an end: cut the record there, or use the optimal smoother",
            )
        if missing > max_gap:
            raise InputError(
                _ZERO_PHASE_CONTEXT,
                f"column {k} has {missing} successive missing samples, at most {max_gap} are"
                " interpolated: set max_gap, or use the optimal smoother, which accepts gaps",
            )
        samples[:, k] = np.interp(rows, known, samples[known, k])
    return samples


def _derivatives(x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x (n, k) and its first and second time derivatives by central differences.

    They use five points, and three near the ends.
    """
    rate = np.gradient(x, dt, axis=0, edge_order=2)
    acceleration = np.empty_like(x)
    acceleration[1:-1] = (x[2:] - 2.0 * x[1:-1] + x[:-2]) / dt**2
    acceleration[[0, -1]] = acceleration[[1, -2]]
    far, near = x[4:] - x[:-4], x[3:-1] - x[1:-3]
    rate[2:-2] = (8.0 * near - far) / (12.0 * dt)
    sums = 16.0 * (x[3:-1] + x[1:-3]) - 30.0 * x[2:-2] - (x[4:] + x[:-4])
    acceleration[2:-2] = sums / (12.0 * dt**2)
    return x, rate, acceleration
