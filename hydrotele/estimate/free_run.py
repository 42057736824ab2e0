"""Free runs: how far a model is off when it has only the commands, over seconds instead of a row.

A one-step error says little of a prediction over 30 s: a model may be right from row to row and
drift, or miss the noise and arrive. So a model is started at many rows of a run, from its estimate
of the state there, runs freely on the commands, and is compared with the readings on its way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hydrotele.core.compiled import compiled
from hydrotele.core.errors import InputError
from hydrotele.estimate.levels import describe_lost_track, reading_resolution
from hydrotele.estimate.reduced_model import (
    Model,
    add_sensor_drift,
    advance,
    follow_trail,
    model_space,
    read_channels,
    reduced_model,
)
from hydrotele.estimate.track import DRIFT_TIME, STEP, Levels, state_scales, steps_per_row, track_run
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.machine import Machine

HORIZONS = (1.0, 5.0, 10.0, 30.0)  # s
TO_THE_END = "end"
SETTLE = 1.0  # s at a run's start, in which the state's estimate becomes good; no window starts there
_RATE_OVER = 0.1  # s over which rates are taken where no noise is stated
_FOLLOW = 0.5  # s in which a rate may become another one: as fast as a machine starts and stops
_SMALLEST = 1e-5  # of a channel's size: less noise than a converter of 16 bits is not believed
_BETWEEN = 1.0  # s, least time between two starts
_MOST_WINDOWS = 400  # per horizon and run
_GONE = 100.0  # times the range of the readings, beyond which a prediction has left the machine


class Runner(NamedTuple):
    """A model made ready for one run.

    Attributes:
        one_step: (n, c) prediction of every row's readings from all before [channel's unit].
        run: ((s,) start rows, count) -> (s, count, c) predictions of the `count` rows after each
            start, from the readings up to and with the start and from the commands alone.
        lost: how the model fails to follow the run from row to row, in one sentence; empty if it follows.
    """

    one_step: np.ndarray
    run: Callable[[np.ndarray, int], np.ndarray]
    lost: str = ""


Prepare = Callable[[RunData], Runner]


@dataclass(frozen=True)
class HorizonError:
    """Errors of the free runs over one horizon.

    Attributes:
        seconds: length of the windows [s].
        windows: number of windows.
        diverged: those of them in which the model left the machine's range.
        rms: (c,) RMS error over all rows of all windows; infinite where one diverged, NaN without
            a reading [channel's unit].
        final: (c,) the same of the windows' last rows.
        each: (w, c) RMS error of every window.
        median: (c,) median over the windows of each window's RMS error.
    """

    seconds: float
    windows: int
    diverged: int
    rms: np.ndarray
    final: np.ndarray
    each: np.ndarray
    median: np.ndarray


@dataclass(frozen=True)
class RunErrors:
    """Errors of one model along one run.

    Attributes:
        run: name of the run.
        one_step: (c,) RMS of the one-step errors [channel's unit].
        horizons: such as `5` (seconds) or `end` -> errors of the free runs.
    """

    run: str
    one_step: np.ndarray
    horizons: dict[str, HorizonError]


def following_levels(data: Dataset) -> Levels:
    """Noise levels for a filter whose states follow the readings.

    Stated noise is kept. Where none is stated, the readings' roughness tells it, and the state may
    drift as fast as the readings do: what matters here is where a free run starts, not how likely a
    model is, and a model may be far off. Of a hydraulic axis the position drifts and not the rate,
    which oil in a closed valve would undo at once.

    Args:
        data: the dataset.

    Returns:
        The levels.

    Source: noise of a smooth signal from second differences, whose variance is six times its own.
    """
    noise, machine = data.noise.copy(), data.machine
    drift: dict[str, float] = {}
    resolution = reading_resolution(data)
    period = data.fit[0].period
    per_time = math.sqrt(DRIFT_TIME / period)
    ahead = max(1, round(_RATE_OVER / period))
    share = np.sqrt(period / _FOLLOW)
    for c in np.flatnonzero(~np.isfinite(data.noise)).tolist():
        signal, columns = parse_channel(data.channels[c]), [run.reading[:, c] for run in data.fit]
        rough = _size([np.diff(column, 2) for column in columns]) / np.sqrt(6.0)
        noise[c] = max(rough, _SMALLEST * _size(columns), resolution[c])
        moves = _size([column[ahead:] - column[:-ahead] for column in columns]) / (ahead * period)
        if signal.kind.startswith("pressure_"):
            drift[f"{signal.kind}.{signal.axis}"] = moves * period * per_time
        elif ratio := _joint_per_reading(machine, data.channels, c):
            joint = machine.axes[signal.axis or ""].joint
            if signal.axis in machine.hydraulic_axes:
                drift[f"position.{joint}"] = ratio * moves * period * per_time
            else:
                drift[f"rate.{joint}"] = ratio * moves * share * per_time
    scales = state_scales(machine, list(drift))
    return Levels(noise, drift={n: size / s for (n, size), s in zip(drift.items(), scales, strict=True)})


def _joint_per_reading(machine: Machine, channels: Sequence[str], c: int) -> float:
    """Return the travel of the joint that a channel shows per change of its reading; 0 if it shows none.

    A length shows the joint of its cylinder where no position of that axis is read: range over stroke.
    """
    signal = parse_channel(channels[c])
    if signal.axis not in machine.axes:
        return 0.0
    kind, facts = machine.position_kind(signal.axis), machine.axes[signal.axis]
    if signal.kind == kind:
        return 1.0
    if signal.kind != "length" or f"{kind}.{signal.axis}" in channels or not facts.cylinder:
        return 0.0
    limits = machine.joints[facts.joint].range
    return (limits[1] - limits[0]) / facts.cylinder.stroke if limits else 1.0


def _size(parts: Sequence[np.ndarray]) -> float:
    """RMS of all finite values of several arrays; 0 without any."""
    values = np.concatenate(parts)
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def machine_runner(machine: Machine, data: Dataset, step: float = STEP) -> Prepare:
    """Make a machine ready for runs: its filter tells the states that free runs start from.

    Args:
        machine: the machine.
        data: the dataset, for its channels and noise; see `following_levels`.
        step: largest step of the integrator [s].

    Returns:
        What prepares a run.
    """
    model, levels = reduced_model(machine, data.channels), following_levels(data)

    def prepare(run: RunData) -> Runner:
        track = track_run(machine, data, run, step=step, levels=levels)
        states = track.states  # what the prediction keeps: gains and Jacobians of a track are larger
        steps = steps_per_row(machine, run.period, step)
        late = np.any(model.lag > 0.0) or np.any(model.time_constant > 0.0)
        before = _shown(model, states, run.period) if late else None

        def free(starts: np.ndarray, count: int) -> np.ndarray:
            out = np.full((len(starts), count, len(data.channels)), np.nan)
            for made, row in zip(out, starts, strict=True):
                if np.isfinite(states[row]).all():
                    past = np.zeros((1, len(model.lag))) if before is None else before
                    space = model_space(model)
                    space.time[1] = run.start
                    _run_from(model, space, states[row].copy(), run.command, int(row),
                              run.period, steps, past, made)  # fmt: skip
            return out

        return Runner(track.predicted, free, describe_lost_track(track, data.channels))

    return prepare


def free_run_errors(
    runner: Runner, run: RunData, horizons: Sequence[float] = HORIZONS, to_end: bool = True
) -> RunErrors:
    """Errors of a model along a run, from row to row and over each horizon.

    Windows start every half horizon, at least a second apart, and may overlap; horizons that do not
    fit into the run are left out.

    Args:
        runner: the model, made ready for the run.
        run: the run.
        horizons: lengths of the windows [s].
        to_end: whether to run from the start to the end of the run, too.

    Returns:
        The errors.

    Raises:
        InputError: a horizon is shorter than a row.
    """
    found = {}
    for seconds in horizons:
        starts = window_starts(len(run.reading), run.period, seconds)
        if len(starts):
            found[f"{seconds:g}"] = _judge(runner, run, starts, round(seconds / run.period))
    first = round(SETTLE / run.period)
    left = len(run.reading) - 1 - first
    if to_end and left > 0:
        found[TO_THE_END] = _judge(runner, run, np.array([first]), left)
    gone = find_diverged_rows(runner.one_step, run.reading)
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.where(gone, np.inf, runner.one_step - run.reading)
    return RunErrors(run.name, _rms(np.where(np.isnan(run.reading), np.nan, error)[first:]), found)


def chained(runner: Runner, run: RunData, seconds: float) -> np.ndarray:
    """Free runs one after the other, each started where the last one ends, for a picture.

    Args:
        runner: the model, made ready for the run.
        run: the run.
        seconds: length of each [s].

    Returns:
        (n, c) predictions, NaN before the first start [channel's unit].
    """
    count, rows = max(1, round(seconds / run.period)), len(run.reading)
    predicted = np.full(run.reading.shape, np.nan)
    for start in range(round(SETTLE / run.period), rows - 1, count):
        ahead = min(count, rows - 1 - start)
        predicted[start + 1 : start + 1 + ahead] = runner.run(np.array([start]), ahead)[0]
    return np.where(find_diverged_rows(predicted, run.reading), np.nan, predicted)


def window_starts(rows: int, period: float, seconds: float) -> np.ndarray:
    """Rows at which the windows of a horizon start.

    Args:
        rows: of the run.
        period: of the rows [s].
        seconds: the horizon [s].

    Returns:
        (s,) rows, none where the horizon does not fit.

    Raises:
        InputError: the horizon is shorter than a row.

    >>> window_starts(501, 0.02, 5.0) * 0.02
    array([1. , 3.5])
    """
    count = round(seconds / period)
    if count < 1:
        raise InputError(
            f"a horizon of {seconds:g} s",
            f"is shorter than a log row: use at least {period:g} s",
        )
    last = rows - 1 - count
    first = round(SETTLE / period)
    if last < first:
        return np.zeros(0, int)
    between = max(1, round(max(_BETWEEN, 0.5 * seconds) / period))
    starts = np.arange(first, last + 1, between)
    every = np.linspace(0, len(starts) - 1, min(len(starts), _MOST_WINDOWS))
    return starts[np.round(every).astype(int)]


def _judge(runner: Runner, run: RunData, starts: np.ndarray, count: int) -> HorizonError:
    """Errors of the windows of one length."""
    predicted = runner.run(starts, count)
    measured = run.reading[starts[:, None] + np.arange(1, count + 1)]
    gone = np.any(find_diverged_rows(predicted, run.reading), axis=(1, 2))
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.where(gone[:, None, None], np.inf, predicted - measured)
    error = np.where(np.isnan(measured), np.nan, error)
    each = np.array([_rms(window) for window in error])
    return HorizonError(
        seconds=count * run.period, windows=len(starts), diverged=int(gone.sum()),
        rms=_rms(error.reshape(-1, error.shape[2])), final=_rms(error[:, -1]),
        each=each, median=np.array([_median(column) for column in each.T]),
    )  # fmt: skip


def find_diverged_rows(predicted: np.ndarray, reading: np.ndarray) -> np.ndarray:
    """(..., c) where a prediction is no number, or far outside of all that was ever read."""
    low = np.min(reading, axis=0, initial=np.inf, where=np.isfinite(reading))
    high = np.max(reading, axis=0, initial=-np.inf, where=np.isfinite(reading))
    size = np.maximum(high - low, np.maximum(np.abs(low), np.abs(high)))
    with np.errstate(over="ignore", invalid="ignore"):
        far = np.abs(predicted - 0.5 * (low + high)) > _GONE * size
    return ~np.isfinite(predicted) | far


def _rms(error: np.ndarray) -> np.ndarray:
    """(c,) RMS of (n, c) errors; NaN without any, infinite with an infinite one."""
    count = np.isfinite(error).sum(axis=0) + np.isinf(error).sum(axis=0)
    total = np.nansum(error**2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)


def _median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.sort(known)[(len(known) - 1) // 2]) if len(known) else math.nan


def _shown(model: Model, states: np.ndarray, period: float) -> np.ndarray:
    """(n, c) what sensors without delay, scale and offset would show of the states."""
    ideal = model._replace(scale=np.ones(len(model.lag)), offset=np.zeros(len(model.lag)))
    shown = np.zeros((len(states), len(model.lag)))
    _read_rows(ideal, model_space(model), states, period, shown)
    return shown


@compiled
def _read_rows(model, sp, states, period, out):
    nothing, one = np.zeros((0, out.shape[1])), np.int64(1)  # numba compiles anew for a written 1
    for row in range(len(states)):
        read_channels(model, sp, states[row], row, one, 1.0, nothing, out[row])
    follow_trail(model, out, period, out[0].copy())


@compiled
def _run_from(model, sp, z, command, first, period, steps, before, out):
    """Free run from the state at a row, with the commands and readings that are on their way.

    Args:
        model: Model.
        sp: Space.
        z: (nz,) state at the row, advanced in place.
        command: (n, nu) commands of the whole run.
        first: the row.
        period: scalar [s].
        steps: steps per row.
        before: (n, c) what the sensors without delay show of the states of the whole run; (1, c)
            where no sensor is late.
        out: (k, c) written: what the sensors show in the rows after the first [channel's unit].
    """
    h, longest = period / steps, 0.0
    for lag in model.lag:
        longest = max(longest, lag)
    past = min(first, int(math.ceil(longest / period - 1e-9)))
    trail = np.zeros(((past + len(out)) * steps + 1, len(model.lag)))
    for row in range(past):
        for step in range(steps + 1):
            for c in range(len(model.lag)):
                here, there = before[first - past + row, c], before[first - past + row + 1, c]
                trail[row * steps + step, c] = here + (there - here) * step / steps
    shown = before[min(first, len(before) - 1)].copy()
    for k in range(len(out)):
        row = past + k
        ahead = trail[row * steps : (row + 1) * steps + 1]
        advance(model, sp, z, command, first + k, period, steps, ahead)
        follow_trail(model, ahead, h, shown)
        read_channels(model, sp, z, row + 1, steps, h, trail, out[k])
        add_sensor_drift(model, sp.time[1] + (first + k + 1) * period, out[k])
