"""Noise levels from the data: of every channel's readings, and of what the model lacks.

What a model lacks is counted as unknown inputs of its balances (`estimate.filter`): force, flow
into the chambers, command. All levels are those of the largest likelihood (Kristensen, Madsen and
Jorgensen 2004, Automatica 40(2), section 3: grey-box models whose diffusion terms show where they
lack something). An accuracy that a machine states is a prior for its channel. So likelihoods and
intervals count what a model lacks, and a channel without a stated accuracy costs that channel its
prior and nothing else.

The readings' own instants may jitter: their noise then grows with the rate of what they show.

A run's filter linearised about a track: likelihood and its slopes for other noise levels.

The transition Jacobians of a track make its Kalman filter a linear one, which can be run again
with other noise of the readings and other process noise at a fraction of the cost. A disturbance
smoother goes back through it: it gives the slopes of the likelihood with respect to all levels in
one pass, and the disturbances themselves, which say where and when the model lacks something.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.estimate.colour import Spectrum, find_colour, measure_spectrum, state_labels
from hydrotele.estimate.filter import (
    Input,
    decay,
    input_columns,
    input_sizes,
    mirror_lower_triangle,
    multiply_symmetric,
    multiply_transposed,
    possible_inputs,
    update_covariance,
)
from hydrotele.estimate.reduced_model import state_names
from hydrotele.estimate.track import (
    DRIFT,
    STEP,
    Levels,
    Track,
    by_kind,
    row_variances,
    squared_rates,
    state_drift,
    track_run,
)
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.dataset_reduction import find_exciting_segment
from hydrotele.machine.machine import Machine, find_channel_sensor
from hydrotele.machine.sensors import make_channel_converter


class LinearRun(NamedTuple):
    """A run of n rows linearised about a track, with c channels and nz states.

    Attributes:
        flow: (n, nz, nz) d (state before the next row) / d (state after this one), the latter
            along the first index.
        slope: (n, c, nz) d reading / d state.
        error: (n, c) readings less what the track predicted, NaN where missing.
        correction: (n, nz) what the track's own filter added to the state at every row.
        initial: (nz, nz) covariance before the first reading.
        startle: (n, nz) variance that rows with unknown commands add.
    """

    flow: np.ndarray
    slope: np.ndarray
    error: np.ndarray
    correction: np.ndarray
    initial: np.ndarray
    startle: np.ndarray


def linear_run(track: Track, startle: np.ndarray, rows: slice = slice(None)) -> LinearRun:
    """Linearise a run.

    Args:
        track: made with `linearise`.
        startle: (nz,) variance that a row with unknown command adds.
        rows: part of the run to keep; the state's covariance before it is that before the run.

    Returns:
        The linear run.
    """
    run: RunData = track.run
    raw = track.whitened * track.gains.spread
    correction = np.einsum("rcs,rc->rs", track.gains.gain, np.nan_to_num(raw))
    unknown = np.outer(~run.command_known, startle)
    return LinearRun(
        track.flow[rows], track.gains.slope[rows], (run.reading - track.predicted)[rows],
        correction[rows], track.initial, unknown[rows],
    )  # fmt: skip


@compiled
def linear_filter(run, noise, drift, whitened, width, gain, before, covariance):
    """Kalman filter of a linear run; deviations of the state count from the track's.

    Args:
        run: LinearRun.
        noise: (n, c) variances of the readings.
        drift: (nz,) variance that a row adds to the state.
        whitened: (n, c) written: prediction errors over their spread, NaN where missing.
        width: (n, c) written: their predicted standard deviation [channel's unit].
        gain: (n, c, nz) written: corrections of the state per prediction error.
        before: (n, nz) written: deviations before each row's readings.
        covariance: (n or 0, nz, nz) written: their covariances.

    Returns:
        -2 log likelihood without its constant.

    Source: Anderson and Moore 1979, Optimal Filtering, chapter 6; sequential readings.
    """
    rows, channels, size = run.slope.shape
    p, work = run.initial.copy(), np.zeros((size, size))
    d, pull = np.zeros(size), np.zeros(size)
    loss = 0.0
    for row in range(rows):
        before[row] = d
        if len(covariance) > 0:
            covariance[row] = p
        for c in range(channels):
            y = run.error[row, c]
            if np.isnan(y):
                whitened[row, c] = np.nan
                width[row, c] = np.nan
                continue
            h = run.slope[row, c]
            for k in range(size):
                y -= h[k] * d[k]
            total = update_covariance(p, h, noise[row, c], pull, gain[row, c])
            width[row, c] = np.sqrt(total)
            whitened[row, c] = y / width[row, c]
            loss += y * y / total + np.log(total)
            for s in range(size):
                d[s] += gain[row, c, s] * y
        if row == rows - 1:
            break
        for s in range(size):
            pull[s] = d[s] - run.correction[row, s]
        f = run.flow[row]
        d[:] = 0.0
        for s in range(size):
            for r in range(size):
                d[r] += f[s, r] * pull[s]
        mirror_lower_triangle(p)
        multiply_transposed(f, p, work)  # F p
        multiply_symmetric(work, f, p)
        for a in range(size):
            p[a, a] += drift[a] + run.startle[row, a]
    return loss


@compiled
def linear_smoother(run, rates, whitened, width, gain, slopes, pulls, lacks):
    """Go back through a linear filter: slopes of its loss, and the smoothed disturbances.

    Args:
        run: LinearRun.
        rates: (n, c) squares of the readings' rates; (0, c) where no slope along jitter is wanted.
        whitened: as `linear_filter` wrote them.
        width: see whitened.
        gain: see whitened.
        slopes: written: (c,) d loss / d (variance of a channel's readings), (nz,) d loss /
            d (variance that a row adds), (1,) d loss / d (variance of the instants).
        pulls: (n, nz) written: r of the rows; a row's smoothed disturbance on its way to the next
            is the row's variance times the next row's r, and its smoothed deviation before the
            readings the covariance there times its own r.
        lacks: (n, nz) written: diagonal of N; the disturbance's variance is q - q N q.

    Returns:
        Nothing.

    Source: Koopman and Shephard 1992, Biometrika 79(4), Eqs 2.4-2.6; de Jong 1989.
    """
    rows, channels, size = run.slope.shape
    r, n = np.zeros(size), np.zeros((size, size))
    work, pull, new = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    turned = np.zeros((size, size))
    noise_slope, drift_slope, jitter_slope = slopes
    jitter_slope[:] = 0.0
    noise_slope[:] = 0.0
    drift_slope[:] = 0.0
    for row in range(rows - 1, -1, -1):
        if row < rows - 1:
            f = run.flow[row]
            for s in range(size):
                drift_slope[s] += n[s, s] - r[s] * r[s]
            for s in range(size):
                for k in range(size):
                    turned[k, s] = f[s, k]
            new[:] = 0.0
            for k in range(size):
                for s in range(size):
                    new[s] += turned[k, s] * r[k]
            for s in range(size):
                r[s] = new[s]
            multiply_transposed(turned, n, work)  # n = F' n F with f the transpose of F
            multiply_symmetric(work, turned, n)
        for c in range(channels - 1, -1, -1):
            if np.isnan(whitened[row, c]):
                continue
            h, k_gain = run.slope[row, c], gain[row, c]
            square = width[row, c] * width[row, c]
            u = whitened[row, c] / width[row, c]
            inner = 1.0 / square
            pull[:] = 0.0
            for k in range(size):
                u -= k_gain[k] * r[k]
            for k in range(0, size - 3, 4):
                for s in range(size):
                    total = (pull[s] + n[k, s] * k_gain[k]) + n[k + 1, s] * k_gain[k + 1]
                    pull[s] = (total + n[k + 2, s] * k_gain[k + 2]) + n[k + 3, s] * k_gain[k + 3]
            for k in range(size - size % 4, size):
                for s in range(size):
                    pull[s] += n[k, s] * k_gain[k]
            for s in range(size):
                inner += k_gain[s] * pull[s]
            noise_slope[c] += inner - u * u
            if len(rates) > 0:
                jitter_slope[0] += rates[row, c] * (inner - u * u)
            for s in range(size):
                if h[s] != 0.0:  # a reading depends on few states
                    r[s] += h[s] * u
                    for k in range(size):
                        n[s, k] += h[s] * (0.5 * inner * h[k] - pull[k])
                        n[k, s] += h[s] * (0.5 * inner * h[k] - pull[k])
        for s in range(size):
            pulls[row, s] = r[s]
            lacks[row, s] = n[s, s]


class Smoothed(NamedTuple):
    """What a run's filter and smoother say at some noise levels.

    Attributes:
        loss: -2 log likelihood without its constant.
        noise_slope: (c,) d loss / d variance of a reading.
        drift_slope: (nz,) d loss / d variance that a row adds.
        jitter_slope: d loss / d variance of the instants at which channels are read.
        whitened: (n, c) prediction errors over their spread.
        width: (n, c) that spread.
        disturbance: (n, nz) smoothed disturbance of the state on its way to the next row.
        known: (n, nz) share of the disturbance's variance that the readings resolve, 0 .. 1.
        deviation: (n, nz) smoothed state less the track's before the row's readings; empty unless
            asked for.
    """

    loss: float
    noise_slope: np.ndarray
    drift_slope: np.ndarray
    jitter_slope: float
    whitened: np.ndarray
    width: np.ndarray
    disturbance: np.ndarray
    known: np.ndarray
    deviation: np.ndarray


def smooth(
    run: LinearRun, noise: np.ndarray, drift: np.ndarray, states: bool = False,
    rates: np.ndarray | None = None,
) -> Smoothed:  # fmt: skip
    """Filter and smoother of a linear run.

    Args:
        run: LinearRun.
        noise: (n, c) variances of the readings [channel's unit squared].
        drift: (nz,) variance that a row adds to the state.
        states: whether to return the smoothed deviation of the state, too.
        rates: (n, c) squares of the readings' rates, for the slope along jitter; else that is 0.

    Returns:
        What they say.
    """
    rows, channels, size = run.slope.shape
    whitened, width = np.empty((rows, channels)), np.empty((rows, channels))
    gain, before = np.zeros((rows, channels, size)), np.empty((rows, size))
    covariance = np.empty((rows if states else 0, size, size))
    loss = linear_filter(run, noise, drift, whitened, width, gain, before, covariance)
    slopes = np.zeros(channels), np.zeros(size), np.zeros(1)
    rates = np.zeros((0, channels)) if rates is None else rates
    pulls, lacks = np.empty((rows, size)), np.empty((rows, size))
    linear_smoother(run, rates, whitened, width, gain, slopes, pulls, lacks)
    own = drift + run.startle
    disturbance, known = np.zeros((rows, size)), np.zeros((rows, size))
    disturbance[:-1] = own[:-1] * pulls[1:]
    known[:-1] = own[:-1] * lacks[1:]
    deviation = before + np.einsum("rsk,rk->rs", covariance, pulls) if states else before[:0]
    return Smoothed(
        loss, slopes[0], slopes[1], float(slopes[2][0]), whitened, width, disturbance, known,
        deviation,
    )  # fmt: skip


WHITE = ("rate", "drive_rate", "spool", "speed", "pressure_head", "pressure_rod")
"""Kinds of states to which white noise is added, too: ripple and what the rows are too slow for.

Where friction holds a drive fast, as that of a pump drive does, nothing but its position itself can
say that it moved all the same: see `_white_states`.
"""
_MOST = 1.0e4  # times its floor that white noise can reach
_RIPPLE = 10.0  # times its floor from which white noise counts as there
LEAST = 1.0e-4  # of an input's largest size: below it an input is none
STATED_WIDTH = 0.5  # prior standard deviation of log(noise / stated): a data sheet is good to a factor
_LACK = 4.0  # prior standard deviation of log(size / least): says next to nothing
_NOISIER = 1.25  # times the rough noise that a channel's noise can be: what is slow is no noise
_QUIETER = 0.7  # times the stated or the rough noise, whichever is smaller: readings that scatter
# less than they do are no sensor, but a lack that is faster than the unknown inputs
_QUIETER_UNSTATED = 0.3  # times the rough noise, where fast motion may be most of it
_FAINT = 0.1  # of the white noise: a coloured part below it, 1 % of the variance, does not show
_WHITE_LEFT = 0.03  # of a channel's noise with a coloured part, that is white: rounding at least
_LEAST_JITTER, _MOST_JITTER = 1.0e-3, 0.5  # of a period; less does not show, more is no clock
_BEGUN_JITTER = 0.03  # of a period, from which jitter is sought
_JITTERS = 30.0  # twice the log likelihood that it must bring
_TOLD_JITTER = 0.3  # of its variance: standard deviation with which a channel tells jitter
_ALIKE = 0.5  # of its variance, by which channels may differ beside that
_ROWS = 3000  # of all runs together that tell the levels; more say the same again
_ITERATIONS = 12  # of a round: what is left of the way is small against a round's own linearisation
_IMPOSSIBLE = 1.0e100  # -2 log likelihood of levels at which a linear filter breaks down
_SETTLED = 1.0  # change of -2 log likelihood that ends the rounds
_PARTS = (1.0, 0.5, 0.2)  # of the way to new levels, where teeth make the linear form doubtful
_LOOSE = {"rate": 0.02, "drive_rate": 0.02, "spool": 0.02, "pressure_head": 1e5,
          "pressure_rod": 1e5, "speed": 2.0}  # fmt: skip
_LOOSE_POSITION = 1e-4
# What 20 ms may add to a state at first, so that a model that lacks something follows the readings.


def rough_noise(data: Dataset) -> np.ndarray:
    """(c,) noise of one logged reading, from third differences of the runs [channel's unit].

    They take out what moves slowly against the rows; what moves faster makes it too large. Never
    less than the resolution of the readings, see `reading_resolution`. Of a channel that is logged at a
    lower rate than the rows, differences between its own readings count.
    """
    found, resolution = np.zeros(len(data.channels)), reading_resolution(data)
    for c in range(len(data.channels)):
        columns = [run.reading[:, c] for run in data.fit]
        counts = [1.0 if run.readings_per_mean is None else run.readings_per_mean[c] ** 0.5 for run in data.fit]

        def differences(columns: list[np.ndarray], counts: list[float] = counts) -> np.ndarray:
            parts = [np.diff(column, n=3) * count for column, count in zip(columns, counts, strict=True)]
            return np.concatenate(parts)

        values = differences(columns)
        values = values[np.isfinite(values)]
        if not len(values):
            values = differences([column[np.isfinite(column)] for column in columns])
        spread = 1.4826 * np.median(np.abs(values)) if len(values) else 0.0
        if spread == 0.0 and len(values):  # more than half of the readings repeat
            spread = float(np.std(values))
        found[c] = max(spread / np.sqrt(20.0), resolution[c])
    return found


_MAX_BITS = 20  # of a converter: no logged reading resolves more of its range
_SAME_READING = 1e-9  # of a channel's size: readings that differ by less are equal but for rounding
_CHANNEL_SIZES = {"pressure_head": 1e6, "pressure_rod": 1e6, "pressure_supply": 1e6}  # Pa; else 1 rad or 1 m


def reading_resolution(data: Dataset) -> np.ndarray:
    """Return the smallest noise that readings can have: that of their rounding.

    It is the step between logged values over sqrt(12). The step is the largest of: that of the stated
    converter, the smallest difference between two different readings, and the channel's range (or its size
    where it is constant) divided by 2^20.

    Args:
        data: the logs; its fit runs count.

    Returns:
        (c,) standard deviations [channel's unit], above 0.
    """
    found = np.zeros(len(data.channels))
    for c, channel in enumerate(data.channels):
        values = np.concatenate([run.reading[:, c] for run in data.fit])
        values = np.unique(values[np.isfinite(values)])
        size = float(np.max(np.abs(values), initial=0.0)) or _CHANNEL_SIZES.get(channel.partition(".")[0], 1.0)
        span = float(np.ptp(values)) if len(values) else 0.0
        steps = np.diff(values)
        step = float(np.min(steps[steps > _SAME_READING * size], initial=np.inf))
        finest = max(span or size, _SAME_READING * size) / 2.0**_MAX_BITS
        step = finest if not np.isfinite(step) else max(step, finest)
        found[c] = max(step / 12.0**0.5, _rounding(data, channel))
    return found


def _rounding(data: Dataset, channel: str) -> float:
    """Standard deviation of a converter's rounding [channel's unit]."""
    sensors = data.machine.sensors.get(data.sensors) if data.sensors else None
    step = make_channel_converter(find_channel_sensor(data.machine, sensors, channel), channel).step
    return step / 12.0**0.5


def stated_jitter(data: Dataset) -> float:
    """Standard deviation of the instants at which the machine's sensors read [s]; 0 if none."""
    sensors = data.machine.sensors.get(data.sensors) if data.sensors else None
    return sensors.jitter if sensors else 0.0


class Prior(NamedTuple):
    """What is known of the levels before they are found.

    Attributes:
        noise: (c,) most likely noise [channel's unit].
        width: (c,) standard deviation of its logarithm.
        low: (c,) least noise.
        high: (c,) largest noise.
    """

    noise: np.ndarray
    width: np.ndarray
    low: np.ndarray
    high: np.ndarray


def noise_prior(data: Dataset) -> Prior:
    """Prior of the readings' noise: what the machine states, and what the readings allow."""
    rough, stated = rough_noise(data), np.isfinite(data.noise)
    noise = np.where(stated, data.noise, rough)
    width = np.where(stated, STATED_WIDTH, 2.0 * STATED_WIDTH)
    quieter = np.where(stated, _QUIETER, _QUIETER_UNSTATED)
    low = np.maximum(quieter * np.minimum(noise, rough), reading_resolution(data))  # an encoder's error at rest
    return Prior(noise, width, low, np.maximum(_NOISIER * rough, low))


def find_levels(
    data: Dataset, machine: Machine, start: Sequence[Track] = (), each: Callable = map,
    step: float = STEP, rounds: int = 3, same: bool = False,
    reopened: bool = False, own: Mapping[str, Machine] | None = None,
) -> tuple[Track, ...]:  # fmt: skip
    """Levels of the largest posterior probability, given a machine.

    Args:
        data: the dataset; its `noise` is what the machine states, NaN where nothing.
        machine: the machine.
        start: tracks of a machine like it, with levels to begin with; without them every unknown
            input is tried.
        each: such as `map`, perhaps on several workers.
        step: largest step of the integrator [s].
        rounds: how often levels are found, each time about the tracks of the time before.
        same: whether `start` is of nearly the same machine, so that its Jacobians will do.
        reopened: whether inputs that `start` lacks are tried again.
        own: run -> machine where it differs from that of all runs, with the same states.

    Returns:
        Tracks of the fit runs with these levels, linearised. Where the filter of a machine like that of
        `start` breaks down, its tracks have an infinite loss.

    Raises:
        CannotFollowError: without `start`, and the filter breaks down.
    """
    prior = noise_prior(data)
    if start:
        levels = start[0].levels
        levels = _reopened(levels, machine) if reopened else _possible(levels, machine)
        tracks = _crossed(data, machine, levels, start, each, step, same, own)
        if not np.isfinite(_whole(tracks)):
            return tracks
    else:
        noise = np.clip(prior.noise, prior.low, prior.high)
        held = [n for n in _white_states(machine, state_names(machine)) if n.startswith("position")]
        rough = Levels(noise, drift={**_LOOSE, **dict.fromkeys(held, _LOOSE_POSITION)})
        tracks = _crossed(data, machine, rough, (), each, step, own=own)
        check_filter_follows(tracks, data.channels)
        inputs = possible_inputs(machine)
        levels = Levels(noise, inputs, 0.01 * input_sizes(machine, inputs))
        tracks = _crossed(data, machine, levels, tracks, each, step, own=own)
        check_filter_follows(tracks, data.channels)
    best = tracks
    for index in range(rounds):
        before, old = tracks, levels
        wanted = _most_likely(data, machine, levels, prior, tracks, each)
        near = (bool(start) or index > 0) and not _has_gap(machine)
        for part in _PARTS:  # where a filter hardly follows, its linear form misleads
            levels = _pruned(_between(old, wanted, part), machine)
            tracks = _crossed(data, machine, levels, before, each, step, near, own)
            if _whole(tracks) < _whole(before) or not _has_gap(machine):
                break
        if _whole(tracks) < _whole(best):
            best = tracks
        if _whole(tracks) > _whole(before) - _SETTLED:
            break
    return best if start else with_jitter(data, machine, best, each, step, own)


class CannotFollowError(InputError):
    """The filter of a model cannot follow the readings: its states diverge."""


_LIKELY_REASONS = (
    "Likely reasons: a wrong unit, sign or column of this channel or of a command; a home position or a linkage"
    " that does not reach the first readings; areas, chamber volumes or masses that are off by a large factor;"
    " a log rate that is too low for this drive."
)


def check_filter_follows(tracks: Sequence[Track], channels: Sequence[str]) -> None:
    """Check that the states of a filter do not diverge; large errors alone may be a missing effect.

    Args:
        tracks: of the runs.
        channels: names of the c channels.

    Raises:
        CannotFollowError: the states diverge; the message states the channel, the size of its errors and the
            likely reasons.
    """
    for track in tracks:
        if text := describe_lost_track(track, channels):
            raise CannotFollowError(f"run {track.run.name}", f"{text} {_LIKELY_REASONS}")


def describe_lost_track(track: Track, channels: Sequence[str]) -> str:
    """Return how a filter fails to follow a run, in one sentence; empty if it follows.

    Args:
        track: of the run.
        channels: names of the c channels.
    """
    lost = np.isinf(track.whitened).any(axis=1)
    if not lost.any():
        return ""
    until = int(np.argmax(lost))
    errors = np.clip(track.whitened[: max(until, 1)], -1e12, 1e12)  # 1e12: large, and its square is a number
    count = np.maximum(np.isfinite(errors).sum(axis=0), 1)
    ratio = np.sqrt(np.nansum(errors**2, axis=0) / count)
    worst = int(np.argmax(ratio))
    size = f"its one-step error is {ratio[worst]:.3g} times its noise"
    time = track.run.start + until * track.run.period
    return f"the model cannot follow channel {channels[worst]}: {size} until {time:.3g} s, where its states diverge."


def with_jitter(
    data: Dataset, machine: Machine, tracks: tuple[Track, ...], each: Callable = map,
    step: float = STEP, own: Mapping[str, Machine] | None = None,
) -> tuple[Track, ...]:  # fmt: skip
    """The same with instants that jitter, if that is clearly likelier and all channels say so.

    What a model lacks makes readings wrong by more the faster they move, too, but each channel by
    another time. Jitter that is there is found anew; otherwise it is held, for what another machine
    lacks may take its place.

    Args:
        data: the dataset.
        machine: the machine.
        tracks: its linearised tracks of the fit runs.
        each: such as `map`, perhaps on several workers.
        step: largest step of the integrator [s].
        own: run -> machine where it differs.

    Returns:
        Tracks with a jitter that was found, or the given ones.
    """
    levels, period = tracks[0].levels, tracks[0].run.period
    begun = levels.jitter or stated_jitter(data) or _BEGUN_JITTER * period
    begin = dataclasses.replace(levels, jitter=begun)
    wanted = _most_likely(data, machine, begin, noise_prior(data), tracks, each, jittered=True)
    if wanted.jitter < 2.0 * _LEAST_JITTER * period:
        return tracks
    wanted = _pruned(wanted, machine)
    found = _crossed(data, machine, wanted, tracks, each, step, not _has_gap(machine), own)
    likelier = _whole(found) < _whole(tracks) - (0.0 if levels.jitter else _JITTERS)
    return found if likelier and _agree_on_jitter(found) else tracks


def _agree_on_jitter(tracks: Sequence[Track]) -> bool:
    """Whether every channel that tells the jitter by itself says the same, and several do.

    Each channel's own jitter is one step of Fisher scoring away from that of all.
    """
    levels = tracks[0].levels
    slope = information = np.zeros(len(levels.noise))
    for track in tracks:
        linear = linear_run(track, track.unknown_command_variances)
        found = smooth(linear, row_variances(levels, track.run), track.process_variances)
        shares = levels.jitter**2 * squared_rates(track.run) / found.width**2
        slope = slope + np.nansum(shares * (found.whitened**2 - 1.0), axis=0)
        information = information + np.nansum(shares**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):  # channels that never move say nothing
        off, spread = slope / information, np.sqrt(2.0 / information)
    told = spread < _TOLD_JITTER
    alike = np.abs(off[told]) < _ALIKE + 3.0 * spread[told]
    return len(alike) > 1 and bool(alike.all())


def _has_gap(machine: Machine) -> bool:
    """Whether a drive has backlash: Jacobians then hold only as long as the same teeth touch."""
    return any(a.transmission and a.transmission.backlash for a in machine.axes.values())


def _between(old: Levels, new: Levels, part: float) -> Levels:
    """Levels part of the way from old ones to new ones of the same inputs, in logarithms."""
    if part == 1.0:
        return new

    def mean(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp((1.0 - part) * np.log(a) + part * np.log(b))

    names = list(new.drift)
    began = np.array([old.drift.get(name, 0.0) for name in names])
    drift = mean(np.maximum(began, by_kind(names, DRIFT)), by_kind(names, new.drift))
    drift = dict(zip(names, drift.tolist(), strict=True))
    return dataclasses.replace(
        new, noise=mean(old.noise, new.noise), sizes=mean(old.sizes, new.sizes), drift=drift,
    )  # fmt: skip


def _whole(tracks: Sequence[Track]) -> float:
    """-2 log likelihood of tracks times the prior of their levels; without constants."""
    return sum(track.loss for track in tracks) + tracks[0].levels.penalty


def _reopened(levels: Levels, machine: Machine) -> Levels:
    """Levels with every possible input, those that were none at a small size."""
    inputs = possible_inputs(machine)
    known = dict(zip(levels.inputs, levels.sizes, strict=True))
    small = 10.0 * LEAST * input_sizes(machine, inputs)
    sizes = [max(known.get(i, 0.0), s) for i, s in zip(inputs, small, strict=True)]
    return dataclasses.replace(levels, inputs=inputs, sizes=np.array(sizes))


def _possible(levels: Levels, machine: Machine) -> Levels:
    """Levels without inputs that a machine cannot have."""
    there = possible_inputs(machine)
    kept = np.array([i in there for i in levels.inputs], bool)
    inputs = tuple(i for i in levels.inputs if i in there)
    return dataclasses.replace(levels, inputs=inputs, sizes=levels.sizes[kept])


def _pruned(levels: Levels, machine: Machine) -> Levels:
    """Levels without the inputs that are none."""
    kept = levels.sizes > 2.0 * LEAST * input_sizes(machine, levels.inputs)
    inputs = tuple(i for i, keep in zip(levels.inputs, kept, strict=True) if keep)
    colours = tuple(c for c in levels.colours if c.size > _FAINT * levels.noise[c.channel])
    return dataclasses.replace(levels, inputs=inputs, sizes=levels.sizes[kept], colours=colours)


def _crossed(
    data: Dataset, machine: Machine, levels: Levels, near: Sequence[Track], each: Callable,
    step: float, same: bool = False, own: Mapping[str, Machine] | None = None,
) -> tuple[Track, ...]:  # fmt: skip
    """Linearised tracks with some levels; what inputs do is taken from tracks nearby.

    Where these are of the same machine with these inputs or more, so are the transition Jacobians,
    which cost most of a pass.
    """

    def cross(index: int) -> Track:
        run, columns, flow = data.fit[index], None, None
        there = (own or {}).get(run.name, machine)
        rest = near[index].rest if near else None
        if same:
            columns, flow = _without_pruned(near[index], levels.inputs)
        elif near and levels.inputs:
            columns = columns_of(there, near[index], levels.inputs)
        return track_run(there, data, run, None, step, levels, columns, True, rest, flow)

    return tuple(each(cross, range(len(data.fit))))


def _without_pruned(track: Track, inputs: Sequence[Input]) -> tuple[np.ndarray, np.ndarray]:
    """What inputs do, and transition Jacobians, of a track that may know more inputs."""
    before = list(track.levels.inputs)
    if len(before) == len(inputs):
        return track.columns, track.flow
    kept = [before.index(i) for i in inputs]
    first = track.flow.shape[1] - len(before)
    there = np.concatenate([np.arange(first), first + np.array(kept, dtype=int)])
    return (
        np.ascontiguousarray(track.columns[:, kept]),
        np.ascontiguousarray(track.flow[:, there[:, None], there]),
    )


def columns_of(machine: Machine, near: Track, inputs: Sequence[Input]) -> np.ndarray:
    """(n, m, nz) what inputs do in a machine, from a linearised track of one like it."""
    names, before = state_names(machine), list(near.names[: near.states.shape[1]])
    if names == before:
        return input_columns(machine, near.states, near.flow, near.run.period, inputs, near.run.command)
    there = [before.index(n) for n in names if n in before]
    here = [s for s, n in enumerate(names) if n in before]
    states = np.zeros((len(near.states), len(names)))
    flow = np.tile(np.eye(len(names)), (len(states), 1, 1))
    states[:, here] = near.states[:, there]
    flow[np.ix_(range(len(states)), here, here)] = near.flow[np.ix_(range(len(states)), there, there)]
    return input_columns(machine, states, flow, near.run.period, inputs, near.run.command)


def _most_likely(
    data: Dataset, machine: Machine, levels: Levels, prior: Prior, tracks: Sequence[Track],
    each: Callable, jittered: bool = False,
) -> Levels:  # fmt: skip
    """Levels of the largest posterior probability in the linearised runs; jitter if asked for."""
    names, c, m = list(tracks[0].names), len(data.channels), len(levels.inputs)
    scales = tracks[0].scales
    white = _white_states(machine, names)
    places, floor = [names.index(n) for n in white], by_kind(white, DRIFT)
    colours = levels.colours
    own = [c.channel for c in colours]
    tints = [[names.index(label) for label in state_labels([colour])] for colour in colours]
    w = c + m
    v = w + len(white)
    end = v + len(colours)
    rows = max(_ROWS // len(tracks), _ROWS // 8)
    runs = [_part(track, rows, levels.jitter > 0.0) for track in tracks]
    weight = sum(len(t.run.command) for t in tracks) / sum(len(run[0].error) for run in runs)
    largest = input_sizes(machine, levels.inputs)
    first = len(names) - m

    def of(x: np.ndarray) -> Levels:
        drift = dict(zip(white, np.exp(x[w:v]), strict=True))
        tinted = zip(colours, np.exp(x[v:end]).tolist(), strict=True)
        return dataclasses.replace(
            levels, noise=np.exp(x[:c]), sizes=np.exp(x[c:w]), drift=drift,
            colours=tuple(dataclasses.replace(colour, size=size) for colour, size in tinted),
            jitter=float(np.exp(x[end])) if jittered else levels.jitter,
        )  # fmt: skip

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        now, slope = of(x), np.zeros(len(x))

        def one(part: tuple) -> tuple[float, np.ndarray, np.ndarray, float]:
            run: RunData = part[1]
            drift = state_drift(names, now, run.period, scales)
            found = smooth(part[0], row_variances(now, run, part[2]), drift, rates=part[2])
            noise = now.noise**2 if run.readings_per_mean is None else now.noise**2 / run.readings_per_mean
            per_jitter = now.jitter**2 * found.jitter_slope
            return found.loss, noise * found.noise_slope, drift * found.drift_slope, per_jitter

        total = 0.0
        found = list(each(one, runs))
        if not all(np.isfinite(value) for value, *_ in found):
            return _IMPOSSIBLE, slope
        for value, per_noise, per_drift, per_jitter in found:
            total += value
            slope[:c] += 2.0 * per_noise
            slope[c:w] += 2.0 * per_drift[first:]
            slope[w:v] += 2.0 * per_drift[places]
            slope[v:end] += 2.0 * np.array([per_drift[place].sum() for place in tints])
            slope[end:] += 2.0 * per_jitter
        off, lack = prior_terms(x, now)
        whole = now.whole_noise
        slope[:c] += 2.0 * off / prior.width / weight * (now.noise / whole) ** 2
        slope[v:end] += (2.0 * off / prior.width / weight)[own] * (np.exp(x[v:end]) / whole[own]) ** 2
        slope[priced] += 2.0 * lack / _LACK / weight
        return total + float(off @ off + lack @ lack) / weight, slope

    def prior_terms(x: np.ndarray, now: Levels) -> tuple[np.ndarray, np.ndarray]:
        """Deviations of the whole noise of the channels, and of what else there may be, from their priors."""
        return np.log(now.whole_noise / prior.noise) / prior.width, (x - low)[priced] / _LACK

    period = min(track.run.period for track in tracks)
    least = prior.low.copy()
    least[own] = np.minimum(_WHITE_LEFT * prior.noise, least)[own]  # a constant channel has less noise than stated
    tint_low = [0.5 * _FAINT * _WHITE_LEFT * prior.noise[k] for k in own]
    low = np.concatenate([least, LEAST * largest, floor, tint_low, [_LEAST_JITTER * period]])
    high = np.concatenate([
        prior.high, largest, _MOST * floor, largest_colours(prior)[own], [_MOST_JITTER * period],
    ])  # fmt: skip
    priced = np.setdiff1d(np.arange(c, end + jittered), np.arange(v, end))
    low, high = (np.log(bound[: end + jittered]) for bound in (low, high))
    began = np.array([levels.drift.get(n, 0.0) for n in white])
    start = np.log(np.concatenate([
        levels.noise, np.maximum(levels.sizes, 3 * LEAST * largest), np.maximum(began, 1.5 * floor),
        [colour.size for colour in colours], [levels.jitter] if jittered else [],
    ]))  # fmt: skip
    found = minimize(
        loss, np.clip(start, low, high), jac=True, method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options={"maxiter": _ITERATIONS, "ftol": 1e-6},
    )  # fmt: skip
    x = found.x
    off, lack = prior_terms(x, of(x))
    return dataclasses.replace(of(x), penalty=float(off @ off + lack @ lack))


def largest_colours(prior: Prior) -> np.ndarray:
    """(c,) largest standard deviation of coloured noise: what the prior of the noise allows with 95 %."""
    return prior.noise * np.exp(2.0 * prior.width)


def propose_colours(data: Dataset, tracks: Sequence[Track], min_gain: float, seed: int = 0) -> Levels | None:
    """Propose the coloured noise that the readings of a model show.

    The smoothed noise of a right model has the spectrum that the model's own readings have; these are simulated once.

    Args:
        data: the dataset.
        tracks: of the model, linearised.
        min_gain: twice the log likelihood that the coloured noise of a channel must bring.
        seed: of the simulated readings.

    Returns:
        The levels with coloured noise of the channels that want it; None if no further channel has any.
    """
    levels, rng = tracks[0].levels, np.random.default_rng(seed)
    taken = {colour.channel for colour in levels.colours}
    spectra = [_noise_spectrum(track, rng) for track in tracks]
    noise, colours, largest = levels.noise.copy(), list(levels.colours), largest_colours(noise_prior(data))
    for c in range(len(noise)):
        if c in taken or not noise[c] < largest[c]:
            continue
        colour, white, gain = find_colour(spectra, c, noise[c] ** 2, largest[c])
        if gain > min_gain:
            noise[c] = white
            colours.append(colour)
    if len(colours) == len(taken):
        return None
    return dataclasses.replace(levels, noise=noise, colours=tuple(colours))


def _noise_spectrum(track: Track, rng: np.random.Generator) -> Spectrum:
    """Spectra of a track's smoothed noise over its variance, and of that of readings that its filter would make."""
    run, noise, drift = linear_run(track, track.unknown_command_variances), row_variances(
        track.levels, track.run), track.process_variances  # fmt: skip
    rows, channels, size = run.slope.shape
    state = np.zeros(size)
    first = np.linalg.eigh(run.initial)
    state = first[1] @ (np.sqrt(np.maximum(first[0], 0.0)) * rng.standard_normal(size))
    drawn = np.empty((rows, channels))
    for row in range(rows):
        drawn[row] = run.slope[row] @ state + np.sqrt(noise[row]) * rng.standard_normal(channels)
        state = state @ run.flow[row] + np.sqrt(drift + run.startle[row]) * rng.standard_normal(size)
    there = np.isfinite(run.error)
    made = run._replace(error=np.where(there, drawn, np.nan), correction=np.zeros_like(run.correction))
    found = []
    for one in (run, made):
        told = smooth(one, noise, drift, True)
        left = one.error - np.einsum("rcs,rs->rc", one.slope, told.deviation)
        found.append(np.where(there, left / noise, 0.0))
    return measure_spectrum(found[0], found[1], track.run.period)


def _white_states(machine: Machine, names: Sequence[str]) -> list[str]:
    """States of a track to which white noise is added."""
    held = {f"position.{a.joint}" for a in machine.axes.values() if a.pump}
    return [n for n in names if n.partition(".")[0] in WHITE or n in held]


def _part(track: Track, rows: int, jittered: bool) -> tuple[LinearRun, RunData, np.ndarray | None]:
    """The stretch of a run in which the commands change most: linearised, and its squared rates."""
    busy = find_exciting_segment(track.run, rows)
    rates = np.ascontiguousarray(squared_rates(track.run)[busy]) if jittered else None
    linear = linear_run(track, track.unknown_command_variances, busy)
    return linear, track.run.select_rows(busy.start, busy.stop), rates


def smoothed_inputs(track: Track, answer: tuple[LinearRun, Smoothed] | None = None) -> np.ndarray:
    """Unknown inputs of a track as the smoother tells them.

    Args:
        track: with m inputs.
        answer: of `smoothed`, where it is there already.

    Returns:
        (n, m) inputs [N], [N m], [m^3/s] or [1].
    """
    run, told = answer or smoothed(track)
    m, size = len(track.levels.inputs), run.slope.shape[2]
    fade, held = decay(track.run.period), np.zeros(m)
    found = np.zeros((len(run.error), m))
    for row in range(len(found)):  # what the track's own filter took them to be
        found[row] = held
        held = fade * (held + run.correction[row, size - m :])
    return found + told.deviation[:, size - m :]


def smoothed(track: Track) -> tuple[LinearRun, Smoothed]:
    """A track's linear run, and what its smoother says of it, states included."""
    run = linear_run(track, track.unknown_command_variances)
    return run, smooth(run, row_variances(track.levels, track.run), track.process_variances, True)


def undisturbed_loss(track: Track) -> float:
    """-2 log likelihood to expect of a track whose unknown inputs were nothing, noise as found."""
    names, m = list(track.names), len(track.levels.inputs)
    run = linear_run(track, track.unknown_command_variances)
    drift = track.process_variances
    initial = run.initial.copy()
    first = len(names) - m
    drift[first:], initial[first:] = 0.0, 0.0
    noise = row_variances(track.levels, track.run)
    width = smooth(run._replace(initial=initial), noise, drift).width
    there = np.isfinite(track.whitened)
    return float(np.sum(1.0 + 2.0 * np.log(width[there])))


def rippled(levels: Levels) -> bool:
    """Whether white process noise is more than what an integrator leaves."""
    return any(rippled_at(levels, name) for name in levels.drift)


def rippled_at(levels: Levels, state: str, times: float = _RIPPLE) -> bool:
    """Whether a state's white process noise, as of `rate.swing`, is more than an integrator's."""
    return levels.drift.get(state, 0.0) > times * DRIFT[state.partition(".")[0]]
