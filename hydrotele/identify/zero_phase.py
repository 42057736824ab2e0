"""Zero-phase low-pass by a Butterworth filter run forwards and backwards, and differentiation."""

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.smoothed import Smoothed, checked_period, columns_of, per_column

_WHERE = "zero-phase filter"


def zero_phase(
    values: np.ndarray,
    period: float,
    cutoff: float,
    noise: float | np.ndarray | None = None,
    *,
    order: int = 4,
    bridge: int = 0,
) -> Smoothed:
    """Low-pass without phase lag, and its derivatives by central differences.

    The two passes together have the gain `1 / (1 + (tan(pi f dt) / tan(pi f_c dt))^(2 order))`,
    which is 1/2 at the cutoff f_c. The five-point differences keep the rate of a frequency f to
    `(2 pi f dt)^4 / 30` of itself, the acceleration to a third of that.

    Args:
        values: (n,) or (n, k) samples on a uniform clock, NaN where missing [u].
        period: time between samples [s].
        cutoff: f_c [Hz], below half the sample rate.
        noise: standard deviation of one sample, scalar or (k,), for the standard deviations [u].
        order: of the Butterworth filter that is run twice [1].
        bridge: longest gap to bridge by a straight line [samples]; 0 refuses missing samples.

    Returns:
        The filtered signals, in the shape of `values`. Their standard deviations are what noise
        leaves; what the filter takes from the signal is not in them, nor are the ends.

    Raises:
        InputError: the cutoff is not below half the sample rate, too few samples, or a gap is
            longer than `bridge` or at an end.

    Source: Gustafsson 1996, IEEE Trans. Signal Processing 44(4); five-point differences: Abramowitz
    and Stegun 25.3.6 and 25.3.24.

    >>> import numpy as np
    >>> time = 0.01 * np.arange(400)
    >>> found = zero_phase(np.sin(3 * time), 0.01, cutoff=5.0)
    >>> bool(np.abs(found.rate - 3 * np.cos(3 * time))[50:-50].max() < 1e-3)
    True
    """
    dt = checked_period(period, _WHERE)
    if not 0.0 < cutoff < 0.5 / dt:
        raise InputError(
            _WHERE,
            f"the cutoff must lie between 0 and half the sample rate, {0.5 / dt:g} Hz,"
            f" got {cutoff:g} Hz",
        )
    samples = _bridged(columns_of(values, 2, _WHERE), bridge)
    from scipy.signal import butter, sosfiltfilt  # half a second that most runs do not need

    filtering = butter(order, cutoff, fs=1.0 / dt, output="sos")
    pad = round(3.0 / (cutoff * dt))  # the filter has forgotten its start after three periods
    if len(samples) <= pad:
        raise InputError(
            _WHERE,
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
        deviations = gains[:, None] * per_column(noise, samples.shape[1], "noise", _WHERE)
    shape = np.shape(values)
    spread = (np.broadcast_to(d, samples.shape).reshape(shape).copy() for d in deviations)
    return Smoothed(*(part.reshape(shape) for part in parts), *spread)


def _bridged(samples: np.ndarray, bridge: int) -> np.ndarray:
    rows = np.arange(len(samples))
    for k in range(samples.shape[1]):
        known = np.flatnonzero(np.isfinite(samples[:, k]))
        missing = max(np.diff(known).max() - 1, known[0], rows[-1] - known[-1])
        if missing == 0:
            continue
        if known[0] > 0 or known[-1] < rows[-1]:
            raise InputError(
                _WHERE,
                f"column {k} has no samples at an end: cut the record there, or use the optimal"
                " smoother",
            )
        if missing > bridge:
            raise InputError(
                _WHERE,
                f"column {k} lacks {missing} samples in a row, {bridge} may be bridged: set bridge,"
                " or use the optimal smoother, which needs none",
            )
        samples[:, k] = np.interp(rows, known, samples[known, k])
    return samples


def _derivatives(x: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n, k) and its first two derivatives: five points, towards the ends three."""
    rate = np.gradient(x, dt, axis=0, edge_order=2)
    acceleration = np.empty_like(x)
    acceleration[1:-1] = (x[2:] - 2.0 * x[1:-1] + x[:-2]) / dt**2
    acceleration[[0, -1]] = acceleration[[1, -2]]
    far, near = x[4:] - x[:-4], x[3:-1] - x[1:-3]
    rate[2:-2] = (8.0 * near - far) / (12.0 * dt)
    sums = 16.0 * (x[3:-1] + x[1:-3]) - 30.0 * x[2:-2] - (x[4:] + x[:-4])
    acceleration[2:-2] = sums / (12.0 * dt**2)
    return x, rate, acceleration
