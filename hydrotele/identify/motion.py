"""Filtering and differentiation of noisy joint positions, with standard deviations.

`resolution` estimates noise and bandwidth of the positions. `joint_motion` computes position, rate
and acceleration with the optimal smoother, a zero-phase filter, finite differences, or `periodic`,
which filters and differentiates periodic signals in the frequency domain.
"""

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.smoothing import (
    Smoothed,
    checked_period,
    columns_of,
    per_column,
    smooth,
    zero_phase,
)
from hydrotele.multibody.inverse_dynamics import Projection

_PERIODIC = "periodic filter"


def periodic(
    values: np.ndarray,
    period: float,
    samples_per_cycle: int,
    harmonics: int,
    noise: float | np.ndarray | None = None,
) -> Smoothed:
    """Reduce a signal to the mean and first harmonics of its cycles, and differentiate it exactly.

    With `N` samples, white noise of standard deviation s causes standard deviations of
    `s sqrt((1 + 2 H) / N)` in the value, `s sqrt(2 sum_h w_h^2 / N)` in the rate and
    `s sqrt(2 sum_h w_h^4 / N)` in the acceleration.

    Args:
        values: (n,) or (n, k) samples of a steady cyclic motion on a uniform clock, n a multiple of
            `samples_per_cycle` [u].
        period: time between samples [s].
        samples_per_cycle: samples per cycle of the excitation [1].
        harmonics: number H of harmonics to keep [1], below half of `samples_per_cycle`.
        noise: standard deviation of one sample, scalar or (k,) [u]; None to estimate it from the
            removed part of the signal.

    Returns:
        The filtered signals in the shape of `values`; every cycle is the mean cycle.

    Raises:
        InputError: samples are missing, n is not a multiple of `samples_per_cycle`, or too many
            harmonics.

    Source: Abdellatif 2008, section on frequency-domain filtering; Swevers et al. 1997, IEEE Trans.
    Robotics and Automation 13(5).

    >>> import numpy as np
    >>> phase = 2 * np.pi * np.arange(100) / 50
    >>> found = periodic(np.sin(phase), 0.02, samples_per_cycle=50, harmonics=3)
    >>> bool(np.allclose(found.rate, 2 * np.pi * np.cos(phase)))
    True
    """
    dt, samples = checked_period(period, _PERIODIC), columns_of(values, 1, _PERIODIC)
    rows, cycle = len(samples), int(samples_per_cycle)
    if not np.isfinite(samples).all():
        row = int(np.argwhere(np.isnan(samples))[0, 0])
        raise InputError(
            _PERIODIC,
            f"row {row} is missing, but complete cycles are needed: use the optimal smoother",
        )
    if cycle < 3 or rows % cycle:
        raise InputError(
            _PERIODIC,
            f"{rows} samples are not whole cycles of {cycle}: cut the record to"
            f" {rows // max(cycle, 1) * cycle} samples",
        )
    if not 0 <= harmonics < 0.5 * cycle:
        raise InputError(
            _PERIODIC, f"harmonics must be below {cycle / 2:g} for {cycle} samples per cycle"
        )
    mean = samples.reshape(-1, cycle, samples.shape[1]).mean(axis=0)
    spectrum = np.fft.rfft(mean, axis=0)
    spectrum[harmonics + 1 :] = 0.0
    turn = 2j * np.pi * np.arange(len(spectrum))[:, None] / (cycle * dt)
    parts = [np.fft.irfft(spectrum * turn**k, cycle, axis=0) for k in range(3)]
    whole = [np.tile(part, (rows // cycle, 1)) for part in parts]
    free = rows - 1 - 2 * harmonics
    if noise is not None:
        sigma = per_column(noise, samples.shape[1], "noise", _PERIODIC)
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


Method = Literal["optimal", "zero_phase", "periodic", "raw"]
METHODS = ("optimal", "zero_phase", "periodic", "raw")
_KEPT = 2.5  # filter cutoff over resolved bandwidth: there the signal is a thousandth of the noise
_BAND = 0.5  # band of the equations over bandwidth: there accelerations exceed their noise
_CONTENT = 0.98  # of the accelerations' power: above it, forces depend on more than the motion
_LINES = 10.0  # smallest number of the record's spectral lines in the band
_MOVES = 10.0  # standard deviations of the noise: smallest amplitude of a moving joint
GAP = 0.1  # s, longest gap that a filter may interpolate
_WHERE = "signal processing"


@dataclass(frozen=True)
class Processing:
    """Options for differentiating positions, and the frequency band of the equations.

    Attributes:
        method: `zero_phase` filter, `optimal` smoother, `periodic` (frequency domain) or `raw`
            differences. A smoother attenuates sharp corners of a motion, which reduces estimated
            inertia and friction near reversals; a filter with twice the bandwidth does not.
        band: cutoff of the low-pass filter of regressor and forces [Hz]; None to derive it from the
            resolution of the positions.
        period: period of a repeated motion [s], otherwise None.
        harmonics: number of harmonics kept by `periodic`; 0 for those within the bandwidth of the
            zero-phase filter.
    """

    method: Method = "zero_phase"
    band: float | None = None
    period: float | None = None
    harmonics: int = 0

    def __post_init__(self) -> None:
        """Raise InputError for unknown methods and missing or invalid values."""
        if self.method not in METHODS:
            raise InputError(_WHERE, f"{self.method!r} is not known: {', '.join(METHODS)}")
        if self.band is not None and not (math.isfinite(self.band) and self.band > 0):
            raise InputError(_WHERE, f"the band must be positive, got {self.band} Hz")
        if self.period is not None and not (math.isfinite(self.period) and self.period > 0):
            raise InputError(_WHERE, f"the period must be positive, got {self.period} s")
        if self.harmonics < 0:
            raise InputError(_WHERE, f"harmonics must be 0 or more, got {self.harmonics}")
        if self.method == "periodic" and not self.period:
            raise InputError(_WHERE, "periodic needs the period of the motion [s]")


@dataclass(frozen=True)
class Resolution:
    """Resolution of measured positions.

    Attributes:
        bandwidth: frequency [Hz] at which the optimal smoother has a gain of 1/2, smallest of the
            moving joints; at most 0.2 of the sample rate.
        moves: (k,) whether a joint moves by more than ten times the noise.
        content: frequency [Hz] that contains 98 % of the accelerations' power.
        noise: (k,) standard deviation of one position [rad] or [m], stated or estimated.
    """

    bandwidth: float
    moves: np.ndarray
    content: float
    noise: np.ndarray

    @property
    def band(self) -> float:
        """Band of the equations [Hz]."""
        return min(_BAND * self.bandwidth, self.content)


def resolution(
    positions: np.ndarray, period: float, noise: np.ndarray, cycles: int = 1
) -> Resolution:
    """Estimate bandwidth and noise of positions.

    The gain of the optimal smoother is `1 / (1 + (f/f_h)^(2 order))`. The mean of many cycles has
    less noise and thus a larger bandwidth.

    Args:
        positions: (n, k) positions [rad] or [m], NaN where missing.
        period: time between rows [s].
        noise: (k,) standard deviation of a position, NaN to estimate it.
        cycles: number of cycles of a repeated motion that are averaged later [1].

    Returns:
        The resolution; joints at rest do not affect the bandwidth.

    Source: Wiener filter of an integrator chain in white noise.
    """
    smoothed = smooth(positions, period, _known(noise))
    ratio = math.sqrt(cycles) * smoothed.input_std / smoothed.noise
    halves = ratio ** (1.0 / smoothed.order) / (2.0 * math.pi)
    moves = np.nanstd(smoothed.value, axis=0) > _MOVES * smoothed.noise
    limit = 0.2 / period
    power = np.cumsum(np.abs(np.fft.rfft(smoothed.acceleration[:, moves], axis=0)) ** 2, axis=0)
    rows = np.argmax(power >= _CONTENT * power[-1], axis=0)
    lines = np.fft.rfftfreq(len(positions), period)
    least = min(_LINES * lines[1], limit)
    return Resolution(
        bandwidth=max(float(min([limit, *halves[moves]])), least / _BAND), moves=moves,
        content=max([*lines[rows], least]) if moves.any() else limit, noise=smoothed.noise,
    )  # fmt: skip


def joint_motion(
    positions: np.ndarray, period: float, found: Resolution, processing: Processing
) -> Smoothed:
    """Filter and differentiate the positions of all joints.

    Args:
        positions: (n, k) positions [rad] or [m], NaN where missing.
        period: time between rows [s].
        found: resolution of the positions.
        processing: method to differentiate the positions.

    Returns:
        Position, rate, acceleration and their standard deviations, (n, k) each.

    Raises:
        InputError: the method cannot be used with these positions.
    """
    if processing.method == "optimal":
        return smooth(positions, period, found.noise)
    moving = _filtered(positions, period, found, processing, found.noise)
    if found.moves.all():
        return moving
    return _rested(moving, smooth(positions, period, found.noise), found.moves)


def adjoint(
    gain: np.ndarray, period: float, found: Resolution, processing: Processing
) -> np.ndarray:
    """Apply the adjoint of filtering and differentiation to gains on a motion.

    It holds for all methods except the optimal smoother: the filters are symmetric in time, the
    first derivative is antisymmetric.

    Args:
        gain: (3, p, n, k) gains of p sums on positions, rates and accelerations.
        period: time between rows [s].
        found: resolution of the positions.
        processing: method to differentiate the positions.

    Returns:
        (p, n, k) gains on measured positions; 0 for joints at rest.
    """
    _, p, rows, k = gain.shape
    flat = np.where(found.moves, gain, 0.0).transpose(0, 2, 1, 3).reshape(3, rows, p * k)
    parts = [_filtered(one, period, found, processing, None) for one in flat]
    out = parts[0].value - parts[1].rate + parts[2].acceleration
    return out.reshape(rows, p, k).transpose(1, 0, 2)


def _filtered(
    positions: np.ndarray, period: float, found: Resolution, processing: Processing,
    noise: np.ndarray | None,
) -> Smoothed:  # fmt: skip
    """Apply the linear filter of the method to any number of columns, and differentiate."""
    if processing.method == "zero_phase":
        cutoff = min(_KEPT * found.bandwidth, 0.4 / period)
        return zero_phase(positions, period, cutoff, noise, bridge=round(GAP / period))
    if processing.method == "periodic":
        assert processing.period is not None
        cycle = round(processing.period / period)
        highest = round(_KEPT * found.bandwidth * processing.period)
        harmonics = min(processing.harmonics or highest, (cycle - 1) // 2)
        return periodic(positions, period, cycle, harmonics, noise)
    rate = np.gradient(positions, period, axis=0)
    acceleration = np.gradient(rate, period, axis=0)
    spread = np.broadcast_to(np.nan if noise is None else noise, positions.shape)
    return Smoothed(
        positions, rate, acceleration, spread, spread / (math.sqrt(2.0) * period),
        spread * math.sqrt(6.0) / (4.0 * period**2),
    )  # fmt: skip


def rate_deviations(found: Projection, given: list[int], rate_std: np.ndarray) -> np.ndarray:
    """Propagate standard deviations of the given joints' rates to all joints.

    Args:
        found: projection on k drives.
        given: indices of the k joints whose motion is known.
        rate_std: (n, k) standard deviations of their rates [rad/s] or [m/s].

    Returns:
        (n, v) standard deviations [rad/s] or [m/s].
    """
    # share[n, d, v] = d q_v / d q_d for the drives d; with it d q_v / d q_g for the given joints g
    moves = np.linalg.solve(found.share[:, :, given], found.share)
    return np.sqrt(np.einsum("ngv,ng->nv", moves**2, rate_std**2))


def _rested(moving: Smoothed, smoothed: Smoothed, moves: np.ndarray) -> Smoothed:
    """Use the smoother's motion for joints at rest: a filter would turn their noise into motion."""
    return Smoothed(*(
        np.where(moves, getattr(moving, part.name), getattr(smoothed, part.name))
        for part in fields(Smoothed)
    ))  # fmt: skip


def _known(noise: np.ndarray) -> np.ndarray | None:
    """Return the stated noise, or None to estimate it, also for a stated noise of 0."""
    return noise if (np.isfinite(noise) & (noise > 0.0)).all() else None
