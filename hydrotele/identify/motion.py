"""Motion of the joints from noisy positions: smoothed, differentiated, with its uncertainty.

Filter and differentiation of periodic signals in the frequency domain.
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
    dt, samples = checked_period(period, _PERIODIC), columns_of(values, 1, _PERIODIC)
    rows, cycle = len(samples), int(samples_per_cycle)
    if not np.isfinite(samples).all():
        row = int(np.argwhere(np.isnan(samples))[0, 0])
        raise InputError(
            _PERIODIC, f"row {row} is missing, whole cycles are needed: use the optimal smoother"
        )
    if cycle < 3 or rows % cycle:
        raise InputError(
            _PERIODIC,
            f"{rows} samples are not whole cycles of {cycle}: cut the record to"
            f" {rows // max(cycle, 1) * cycle} samples",
        )
    if not 0 <= harmonics < 0.5 * cycle:
        raise InputError(
            _PERIODIC, f"{cycle} samples per cycle tell less than {cycle / 2:g} harmonics"
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
_KEPT = 2.5  # times the resolved bandwidth: there the signal is a thousandth of the noise
_BAND = 0.5  # of the bandwidth is compared: there accelerations still stand above their noise
_CONTENT = 0.98  # of an acceleration's power, beyond which forces tell of other things than motion
_LINES = 10.0  # of the record's own lines lie in the band at least
_MOVES = 10.0  # standard deviations of the noise, from which a joint counts as moved
GAP = 0.1  # s without samples that a filter may bridge
_WHERE = "signal processing"


@dataclass(frozen=True)
class Processing:
    """How positions become rates and accelerations, and which band of the forces is compared.

    Attributes:
        method: `zero_phase` filter, `optimal` smoother, `periodic` (frequency domain) or `raw`
            differences. A smoother holds back the sharp corners of a motion, so that inertia and
            friction near reversals are underrated; a filter twice as wide as it does not.
        band: low-pass that regressor and forces pass alike [Hz]; None to take half of what the
            positions resolve.
        period: of the motion [s], where it is repeated.
        harmonics: of it that are kept in the frequency domain; 0 for those that a zero-phase
            filter would keep.
    """

    method: Method = "zero_phase"
    band: float | None = None
    period: float | None = None
    harmonics: int = 0

    def __post_init__(self) -> None:
        """Refuse what is not known or lacks a number."""
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
    """What positions tell of the motion.

    Attributes:
        bandwidth: frequency [Hz] at which the optimal smoother keeps half of the signal, of the
            moving joint that is told least; at most 0.2 of the sample rate.
        moves: (k,) whether a joint moves at all, by more than ten times the noise.
        content: frequency [Hz] below which 98 % of the accelerations' power lie.
        noise: (k,) standard deviation of one position [rad] or [m], stated or found.
    """

    bandwidth: float
    moves: np.ndarray
    content: float
    noise: np.ndarray

    @property
    def band(self) -> float:
        """Of the equations [Hz]."""
        return min(_BAND * self.bandwidth, self.content)


def resolution(
    positions: np.ndarray, period: float, noise: np.ndarray, cycles: int = 1
) -> Resolution:
    """Bandwidth and noise of positions.

    The optimal smoother's gain is `1 / (1 + (f/f_h)^(2 order))`; the mean of many cycles has less
    noise and resolves more.

    Args:
        positions: (n, k) [rad] or [m], NaN where missing.
        period: time between rows [s].
        noise: (k,) standard deviation of a position, NaN where to be found.
        cycles: of a repeated motion, of which the mean will be taken [1].

    Returns:
        The resolution; joints at rest are left out of the bandwidth.

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
    """Motion of all joints.

    Args:
        positions: (n, k) [rad] or [m], NaN where missing.
        period: time between rows [s].
        found: their resolution.
        processing: how.

    Returns:
        Position, rate, acceleration and their standard deviations, (n, k) each.

    Raises:
        InputError: the positions do not suit the method.
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
    """What single positions add to a sum over a motion; all but the optimal smoother.

    The filters are symmetric in time, the first derivative antisymmetric.

    Args:
        gain: (3, p, n, k) of p sums for positions, rates and accelerations.
        period: time between rows [s].
        found: resolution of the positions.
        processing: how they become a motion.

    Returns:
        (p, n, k) gains for positions; 0 for joints that rest.
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
    """Linear filter and derivatives of any number of columns."""
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
    """Standard deviations of all joints' rates.

    Args:
        found: projection on k drives.
        given: places of the k joints whose motion is known.
        rate_std: (n, k) of theirs [rad/s] or [m/s].

    Returns:
        (n, v) [rad/s] or [m/s].
    """
    # share[n, d, v] = d q_v / d q_d for the drives d; with it d q_v / d q_g for the given joints g
    moves = np.linalg.solve(found.share[:, :, given], found.share)
    return np.sqrt(np.einsum("ngv,ng->nv", moves**2, rate_std**2))


def _rested(moving: Smoothed, smoothed: Smoothed, moves: np.ndarray) -> Smoothed:
    """Joints that do not move as the smoother has them: a filter makes motion of their noise."""
    return Smoothed(*(
        np.where(moves, getattr(moving, part.name), getattr(smoothed, part.name))
        for part in fields(Smoothed)
    ))  # fmt: skip


def _known(noise: np.ndarray) -> np.ndarray | None:
    """Stated noise; None where it is to be found. An exact sensor counts as one to be found."""
    return noise if (np.isfinite(noise) & (noise > 0.0)).all() else None
