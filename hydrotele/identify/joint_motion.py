"""Filtering and differentiation of noisy joint positions, with standard deviations.

`estimate_resolution` estimates noise and bandwidth of the positions. `compute_joint_motion` computes position, rate
and acceleration with the optimal smoother, a zero-phase filter, finite differences, or `filter_periodic`,
which filters and differentiates periodic signals in the frequency domain.
"""

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from hydrotele.core.errors import InputError
from hydrotele.identify.optimal_smoother import smooth_and_differentiate
from hydrotele.identify.smoothed_signal import SmoothedSignal, as_columns, check_period, expand_per_column
from hydrotele.identify.zero_phase_filter import filter_zero_phase
from hydrotele.multibody.inverse_dynamics import Projection

_PERIODIC_CONTEXT = "periodic filter"


def filter_periodic(
    values: np.ndarray,
    period: float,
    samples_per_cycle: int,
    harmonics: int,
    noise: float | np.ndarray | None = None,
) -> SmoothedSignal:
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
    >>> found = filter_periodic(np.sin(phase), 0.02, samples_per_cycle=50, harmonics=3)
    >>> bool(np.allclose(found.rate, 2 * np.pi * np.cos(phase)))
    True
    """
    dt, samples = check_period(period, _PERIODIC_CONTEXT), as_columns(values, 1, _PERIODIC_CONTEXT)
    rows, cycle = len(samples), int(samples_per_cycle)
    if not np.isfinite(samples).all():
        row = int(np.argwhere(np.isnan(samples))[0, 0])
        raise InputError(
            _PERIODIC_CONTEXT,
            f"row {row} is missing, but complete cycles are needed: use the optimal smoother",
        )
    if cycle < 3 or rows % cycle:
        raise InputError(
            _PERIODIC_CONTEXT,
            f"{rows} samples are not whole cycles of {cycle}: cut the record to"
            f" {rows // max(cycle, 1) * cycle} samples",
        )
    if not 0 <= harmonics < 0.5 * cycle:
        raise InputError(
            _PERIODIC_CONTEXT,
            f"harmonics must be below {cycle / 2:g} for {cycle} samples per cycle",
        )
    mean = samples.reshape(-1, cycle, samples.shape[1]).mean(axis=0)
    spectrum = np.fft.rfft(mean, axis=0)
    spectrum[harmonics + 1 :] = 0.0
    turn = 2j * np.pi * np.arange(len(spectrum))[:, None] / (cycle * dt)
    parts = [np.fft.irfft(spectrum * turn**k, cycle, axis=0) for k in range(3)]
    whole = [np.tile(part, (rows // cycle, 1)) for part in parts]
    free = rows - 1 - 2 * harmonics
    if noise is not None:
        sigma = expand_per_column(noise, samples.shape[1], "noise", _PERIODIC_CONTEXT)
    elif free > 0:
        sigma = np.sqrt(np.sum((samples - whole[0]) ** 2, axis=0) / free)
    else:
        sigma = np.full(samples.shape[1], np.nan)
    speeds = np.abs(turn[1 : harmonics + 1, 0])
    gains = [1.0 + 2.0 * harmonics, 2.0 * np.sum(speeds**2), 2.0 * np.sum(speeds**4)]
    shape = np.shape(values)
    spread = (np.broadcast_to(sigma * np.sqrt(g / rows), samples.shape) for g in gains)
    return SmoothedSignal(*(part.reshape(shape) for part in whole), *(s.reshape(shape).copy() for s in spread))


Method = Literal["optimal", "zero_phase", "periodic", "raw"]
METHODS = ("optimal", "zero_phase", "periodic", "raw")
_CUTOFF_OVER_BANDWIDTH = 2.5  # filter cutoff over resolved bandwidth: there the signal is a thousandth of the noise
_BAND_OVER_BANDWIDTH = 0.5  # band of the equations over bandwidth: there accelerations exceed their noise
_ACCELERATION_POWER_FRACTION = 0.98  # of the accelerations' power: above it, forces depend on more than the motion
_FRICTION_HARMONICS = 5.0  # harmonics of the motion: 90 % of the power of a sign change are in the first and third
_MIN_SPECTRAL_LINES = 10.0  # smallest number of the record's spectral lines in the band
_MIN_MOTION_OVER_NOISE = 10.0  # standard deviations of the noise: smallest amplitude of a moving joint
MAX_GAP_S = 0.1  # s, longest gap that a filter may interpolate
_ERROR_CONTEXT = "signal processing"


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
        harmonics: number of harmonics kept by the method `periodic`; 0 for those within the bandwidth of the
            zero-phase filter.
    """

    method: Method = "zero_phase"
    band: float | None = None
    period: float | None = None
    harmonics: int = 0

    def __post_init__(self) -> None:
        """Raise InputError for unknown methods and missing or invalid values."""
        if self.method not in METHODS:
            raise InputError(_ERROR_CONTEXT, f"{self.method!r} is not known: {', '.join(METHODS)}")
        if self.band is not None and not (math.isfinite(self.band) and self.band > 0):
            raise InputError(_ERROR_CONTEXT, f"the band must be positive, got {self.band} Hz")
        if self.period is not None and not (math.isfinite(self.period) and self.period > 0):
            raise InputError(_ERROR_CONTEXT, f"the period must be positive, got {self.period} s")
        if self.harmonics < 0:
            raise InputError(_ERROR_CONTEXT, f"harmonics must be 0 or more, got {self.harmonics}")
        if self.method == "periodic" and not self.period:
            raise InputError(_ERROR_CONTEXT, "periodic needs the period of the motion [s]")


@dataclass(frozen=True)
class Resolution:
    """Resolution of measured positions.

    Attributes:
        bandwidth: frequency [Hz] at which the optimal smoother has a gain of 1/2, smallest of the
            moving joints; at most 0.2 of the sample rate.
        is_moving: (k,) whether a joint moves by more than ten times the noise.
        acceleration_bandwidth: frequency [Hz] that contains 98 % of the accelerations' power.
        noise: (k,) standard deviation of one position [rad] or [m], stated or estimated.
    """

    bandwidth: float
    is_moving: np.ndarray
    acceleration_bandwidth: float
    noise: np.ndarray

    @property
    def band(self) -> float:
        """Cutoff of the low-pass filter of the force equations that suits these positions [Hz]."""
        return min(_BAND_OVER_BANDWIDTH * self.bandwidth, self.acceleration_bandwidth)

    @property
    def friction_band(self) -> float:
        """Cutoff of the force equations that also passes sign changes of dry friction at reversals [Hz]."""
        return min(_BAND_OVER_BANDWIDTH * self.bandwidth, _FRICTION_HARMONICS * self.acceleration_bandwidth)


def estimate_resolution(positions: np.ndarray, period: float, noise: np.ndarray, cycles: int = 1) -> Resolution:
    """Estimate the bandwidth and noise of measured positions, and which joints move.

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
    smoothed = smooth_and_differentiate(positions, period, _stated_noise(noise))
    ratio = math.sqrt(cycles) * smoothed.input_std / smoothed.noise
    halves = ratio ** (1.0 / smoothed.order) / (2.0 * math.pi)
    moves = np.nanstd(smoothed.value, axis=0) > _MIN_MOTION_OVER_NOISE * smoothed.noise
    limit = 0.2 / period
    power = np.cumsum(np.abs(np.fft.rfft(smoothed.acceleration[:, moves], axis=0)) ** 2, axis=0)
    rows = np.argmax(power >= _ACCELERATION_POWER_FRACTION * power[-1], axis=0)
    lines = np.fft.rfftfreq(len(positions), period)
    least = min(_MIN_SPECTRAL_LINES * lines[1], limit)
    return Resolution(
        bandwidth=max(float(min([limit, *halves[moves]])), least / _BAND_OVER_BANDWIDTH), is_moving=moves,
        acceleration_bandwidth=max([*lines[rows], least]) if moves.any() else limit, noise=smoothed.noise,
    )  # fmt: skip


def compute_joint_motion(
    positions: np.ndarray, period: float, position_resolution: Resolution, processing: Processing
) -> SmoothedSignal:
    """Filter and differentiate the positions of all joints by the method in `processing`.

    Joints at rest are smoothed optimally by every method, because a filter would turn their noise into
    motion.

    Args:
        positions: (n, k) positions [rad] or [m], NaN where missing.
        period: time between rows [s].
        position_resolution: noise and bandwidth of the positions.
        processing: method to differentiate the positions.

    Returns:
        Position, rate, acceleration and their standard deviations, (n, k) each.

    Raises:
        InputError: the method cannot be used with these positions.
    """
    if processing.method == "optimal":
        return smooth_and_differentiate(positions, period, position_resolution.noise)
    moving = _apply_linear_filter(positions, period, position_resolution, processing, position_resolution.noise)
    if position_resolution.is_moving.all():
        return moving
    return _replace_resting_joints(
        moving, smooth_and_differentiate(positions, period, position_resolution.noise), position_resolution.is_moving
    )


def apply_filter_adjoint(
    gain: np.ndarray, period: float, position_resolution: Resolution, processing: Processing
) -> np.ndarray:
    """Convert derivatives of results by the filtered motion to derivatives by the measured positions.

    This is the adjoint of filtering and differentiation. It holds for all methods except the optimal smoother: the
    filters are symmetric in time, the first derivative is antisymmetric.

    Args:
        gain: (3, p, n, k) derivatives of p results by filtered positions, rates and accelerations of k joints.
        period: time between rows [s].
        position_resolution: noise and bandwidth of the positions.
        processing: method to differentiate the positions.

    Returns:
        (p, n, k) derivatives by the measured positions; 0 for joints at rest.
    """
    _, p, rows, k = gain.shape
    flat = np.where(position_resolution.is_moving, gain, 0.0).transpose(0, 2, 1, 3).reshape(3, rows, p * k)
    parts = [_apply_linear_filter(one, period, position_resolution, processing, None) for one in flat]
    out = parts[0].value - parts[1].rate + parts[2].acceleration
    return out.reshape(rows, p, k).transpose(1, 0, 2)


def _apply_linear_filter(
    positions: np.ndarray, period: float, position_resolution: Resolution, processing: Processing,
    noise: np.ndarray | None,
) -> SmoothedSignal:  # fmt: skip
    """Filter and differentiate positions (n, k) by a method that is linear in the readings.

    `zero_phase` filters forwards and backwards, `periodic` keeps the mean and first harmonics of the mean
    cycle, and `raw` takes differences without a filter.
    """
    if processing.method == "zero_phase":
        cutoff = min(_CUTOFF_OVER_BANDWIDTH * position_resolution.bandwidth, 0.4 / period)
        return filter_zero_phase(positions, period, cutoff, noise, max_gap=round(MAX_GAP_S / period))
    if processing.method == "periodic":
        assert processing.period is not None
        cycle = round(processing.period / period)
        highest = round(_CUTOFF_OVER_BANDWIDTH * position_resolution.bandwidth * processing.period)
        harmonics = min(processing.harmonics or highest, (cycle - 1) // 2)
        return filter_periodic(positions, period, cycle, harmonics, noise)
    rate = np.gradient(positions, period, axis=0)
    acceleration = np.gradient(rate, period, axis=0)
    spread = np.broadcast_to(np.nan if noise is None else noise, positions.shape)
    return SmoothedSignal(
        positions, rate, acceleration, spread, spread / (math.sqrt(2.0) * period),
        spread * math.sqrt(6.0) / (4.0 * period**2),
    )  # fmt: skip


def propagate_rate_std(projection: Projection, given_joints: list[int], rate_std: np.ndarray) -> np.ndarray:
    """Compute the standard deviations of the rates of all joints from those of k independent joints.

    Args:
        projection: result of `project_on_drives`; it states how the rates of the joints are related.
        given_joints: indices of the k joints whose motion is known.
        rate_std: (n, k) standard deviations of their rates [rad/s] or [m/s].

    Returns:
        (n, v) standard deviations [rad/s] or [m/s].
    """
    # share[n, d, v] = d q_v / d q_d for the drives d; with it d q_v / d q_g for the given joints g
    moves = np.linalg.solve(projection.joint_projection[:, :, given_joints], projection.joint_projection)
    return np.sqrt(np.einsum("ngv,ng->nv", moves**2, rate_std**2))


def _replace_resting_joints(moving: SmoothedSignal, smoothed: SmoothedSignal, is_moving: np.ndarray) -> SmoothedSignal:
    """Return the filtered motion, with that of the optimal smoother for joints at rest.

    A filter would turn the noise of resting joints into motion.
    """
    return SmoothedSignal(*(
        np.where(is_moving, getattr(moving, part.name), getattr(smoothed, part.name))
        for part in fields(SmoothedSignal)
    ))  # fmt: skip


def _stated_noise(noise: np.ndarray) -> np.ndarray | None:
    """Return the noise (k,) if it is stated (positive) for all joints; None, to estimate it, otherwise."""
    return noise if (np.isfinite(noise) & (noise > 0.0)).all() else None
