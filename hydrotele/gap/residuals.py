"""Are the prediction errors of a model those of a perfect one? Several tests, none on one block.

Whitened errors of a perfect model are white noise of size 1 in every channel. The limits lie well
above what integrators and linearisation leave on clean simulated machines, whose worst channels
reach 1.02, 1.4 and 25 (`docs/validation/gap_calibration.md`), and far below what an effect of some
size leaves (3, 54 and 3100 on open_02).

Does an effect have the same size in every run? Something else that looks alike has not.

What a perfect model would score: runs simulated by the model with the sensors' noise.

How far an effect that closes a gap is to be believed: it may only imitate another law.

The probabilities of the search compare effects of the library with each other. A law that none of
them has is imitated by some of them to a part: by one, which leaves much, or by several of the same
axis, each of which takes a piece. The right effect in another form leaves little.

The numbers here are set by hand, from trials on a machine of other code whose answers were known
when they were set; series drawn later judge them (`docs/validation/independent_trials.md`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from hydrotele.estimate.evidence import Evidence
from hydrotele.estimate.hypothesis import CALIBRATION, LEARNED, Guess
from hydrotele.estimate.reduced_model import model_space, reduced_model, simulate_rows, state_size
from hydrotele.estimate.track import STEP, Track, track_run
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.log_channels import parse_channel
from hydrotele.machine.machine import Machine

_EXPECTED = (1.0, 1.0, 0.0)  # of white noise of size 1, in the order of LIMITS
ALLOWED = 5.0  # times what the filter leaves on simulated readings, which varies by two

_SETTLE = 0.5  # s until the start no longer matters
_WINDOW = 1.0  # s, longer than any ringing of the errors, shorter than a motion
_LAGS = 5
LIMITS = {"mean_square": 1.12, "window_means": 1.8, "autocorrelation": 60.0}
"""Largest value of a test in any channel that still passes, for a smooth model."""
_FALSE_ALARMS = 0.01  # largest probability that white noise alone exceeds the limit of a test in any channel


def residual_tests(
    tracks: Sequence[Track], channels: Sequence[str], perfect: Sequence[Track] = ()
) -> dict[str, dict[str, Any]]:
    """Tests of a model's errors over all runs.

    Where a model has backlash or late sensors, a filter that takes everything for locally straight
    leaves errors even on readings that the model itself made. A test then allows five times what
    those leave in a channel beyond white noise. Of few readings, mean squares scatter: their limits
    are at least the quantile of the chi-square distribution that white noise exceeds in 1 % of datasets.

    Args:
        tracks: the model's tracks, each with gains of its own.
        channels: the c channels.
        perfect: the model's tracks of the same runs with readings that it made itself.

    Returns:
        Test -> "value" (of the channel nearest to or farthest above its limit), "channel", "limit",
        "passed". `mean_square` of the errors; `window_means`: mean square of the means over 1 s,
        times their length; `autocorrelation`: sum over 5 lags of n r^2, mean over the runs, less
        its expectation 5.
    """
    values, counts = _values(tracks)
    own = _values(perfect)[0] if perfect else [np.full(len(channels), e) for e in _EXPECTED]
    found = {}
    for name, measured, made, white, count in zip(LIMITS, values, own, _EXPECTED, counts, strict=True):
        scatter = chi2.isf(_FALSE_ALARMS / len(channels), count) / count if len(count) else LIMITS[name]
        limits = np.maximum(np.maximum(LIMITS[name], scatter), white + ALLOWED * (made - white))
        worst = int(np.argmax(measured / limits))
        found[name] = {
            "value": float(measured[worst]),
            "channel": channels[worst],
            "limit": float(limits[worst]),
            "passed": bool(measured[worst] <= limits[worst]),
        }
    return found


def _values(tracks: Sequence[Track]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Per test the values (c,) of all channels over all runs, and the numbers (c,) of squares in their means.

    The numbers of the last test are empty.
    """
    parts = [_measures(track.whitened, track.run.period) for track in tracks]
    weights = np.array([p[0] for p in parts])
    total = np.maximum(weights.sum(axis=0), 1.0)
    values = [
        np.sum(weights * np.array([p[index] for p in parts]), axis=0) / total for index in range(1, 1 + len(LIMITS))
    ]
    windows = np.maximum(np.sum([p[-1] for p in parts], axis=0), 1.0)
    return values, [total, windows, np.zeros(0)]


def _measures(whitened: np.ndarray, period: float) -> tuple[np.ndarray, ...]:
    """Per channel (c,): rows with a reading, mean square, window means, autocorrelation, number of windows."""
    w = settled(whitened, period)
    window = min(max(2, round(_WINDOW / period)), len(w))  # a shorter run is one window
    there = np.isfinite(w)
    count = there.sum(axis=0).astype(float)
    w = np.where(there, w, 0.0)
    some = np.maximum(count, 1.0)
    square = (w**2).sum(axis=0) / some
    windows = len(w) // window
    cut, filled = (a[: windows * window].reshape(windows, window, -1).sum(axis=1) for a in (w, there))
    full = filled > window // 2
    means = np.where(full, cut**2 / np.maximum(filled, 1), 0.0).sum(axis=0)
    means /= np.maximum(full.sum(axis=0), 1)
    echo = np.zeros(w.shape[1])
    for lag in range(1, _LAGS + 1):
        echo += (w[lag:] * w[:-lag]).sum(axis=0) ** 2 / some / np.maximum(square, 1e-12) ** 2
    return count, square, means, echo - _LAGS, full.sum(axis=0)


def settled(whitened: np.ndarray, period: float) -> np.ndarray:
    """Whitened errors (n, c) without those of a run's start, at most half of them."""
    return whitened[min(round(_SETTLE / period), len(whitened) // 2) :]


def rms(tracks: Sequence[Track]) -> float:
    """RMS of the whitened errors of tracks over all channels, without the runs' starts."""
    parts = [settled(track.whitened, track.run.period).ravel() for track in tracks]
    return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))


LIMIT = 8.0
"""Largest chi-square per degree of freedom that still passes; noise alone leaves 1."""
_KNOWN = 1.0  # least information on a direction in units of the prior's: it tells as much


def has_sizes(guess: Guess) -> bool:
    """Whether effects beside the calibration have sizes; a learned law may have none of its own."""
    return len(guess.deviation) > len(_calibrated(guess))


def constancy(evidence: Evidence, guess: Guess, perfect: Evidence) -> dict[str, Any]:
    """Test of the sizes that the runs ask for, each by itself, against each other.

    With slopes S_r and errors e_r of run r, `chi^2 = sum_r g_r' I_r^-1 g_r - g' I^-1 g`, where
    `g_r = S_r' e_r` and `I_r = S_r' S_r`, and g and I are their sums: how much better the runs
    would be explained with numbers of their own. Five times what the filter leaves on readings
    that the guess made itself is allowed, too.

    Args:
        evidence: with the guess as its base, fitted.
        guess: at least one effect with a size (`has_sizes`).
        perfect: the same runs with readings that the guess made, with the guess as its base.

    Returns:
        As one of `residual_tests`; `channel` is the run that departs most.
    """
    value, run = _spread(evidence, guess)
    limit = max(LIMIT, ALLOWED * _spread(perfect, guess)[0])
    return {"value": value, "channel": run, "limit": limit, "passed": value <= limit}


def _spread(evidence: Evidence, guess: Guess) -> tuple[float, str]:
    """Chi-square per degree of freedom, and the run that departs most."""
    table = [_pull(evidence, guess, index) for index in range(len(evidence.tracks))]
    gains = [_gain(g, information) for g, information in table]
    whole, _ = _gain(np.sum([g for g, _ in table], axis=0), np.sum([i for _, i in table], axis=0))
    freedom = sum(rank for _, rank in gains) - len(guess.deviation) + len(_calibrated(guess))
    value = (sum(gain for gain, _ in gains) - whole) / freedom if freedom > 0 else 0.0
    worst = int(np.argmax([gain for gain, _ in gains]))
    return float(value), evidence.tracks[worst].run.name


def _calibrated(guess: Guess) -> set[int]:
    """Places of numbers of a calibration, a learned law, or some runs only: they may take up what runs differ by."""
    found, first = set(), 0
    for hypothesis, deviation in guess.parts:
        if hypothesis.name == CALIBRATION or hypothesis.name.startswith(LEARNED) or hypothesis.runs:
            found |= set(range(first, first + len(deviation)))
        first += len(deviation)
    return found


def _pull(evidence: Evidence, guess: Guess, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (P,) and information (P, P) of one run."""
    tracks = (evidence.tracks[index],)
    errors = evidence.errors(guess, tracks=tracks)
    columns, left_out = [], _calibrated(guess)
    for place, nudge in enumerate(guess.nudges()):
        if place in left_out:
            continue
        moved = guess.deviation
        moved[place] += nudge
        columns.append((evidence.errors(guess.at(moved), tracks=tracks) - errors) / nudge)
    slopes = np.column_stack(columns)
    return slopes.T @ errors, slopes.T @ slopes


def _gain(g: np.ndarray, information: np.ndarray) -> tuple[float, int]:
    """`g' I^-1 g` over the directions on which there is information, and their number."""
    sizes, directions = np.linalg.eigh(information)
    known = sizes > _KNOWN
    along = directions.T[known] @ g
    return float(np.sum(along**2 / sizes[known])), int(known.sum())


_SEED = 0  # of the first run; any: the floor's scatter over seeds is 0.003


def clean_run(machine: Machine, data: Dataset, run: RunData, start: np.ndarray, seed: int):
    """The run as the machine itself would have produced it.

    Args:
        machine: the machine.
        data: the dataset, for channels and noise.
        run: the run whose commands and missing readings are taken over.
        start: (nz,) state at the first row.
        seed: of the noise.

    Returns:
        A run with simulated readings. The noise is uniform, as the sensors' errors are.
    """
    model = reduced_model(machine, data.channels)
    space = model_space(model)
    space.time[1] = run.start
    rows = len(run.command)
    shown, states = np.empty((rows, len(data.channels))), np.empty((rows, state_size(model)))
    simulate_rows(
        model, space, start.copy(), run.command.copy(), run.period,
        max(1, round(run.period / (0.5 * STEP))), shown, states,
    )  # fmt: skip
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, shown.shape) * np.sqrt(3.0) * data.noise_of(run)
    reading = np.where(np.isnan(run.reading), np.nan, shown + noise)
    return replace(run, reading=reading)


def perfect_tracks(
    machines: Sequence[Machine], data: Dataset, tracks: Sequence[Track], each: Callable = map
) -> tuple[Track, ...]:
    """Tracks of a model on readings that it made itself.

    Args:
        machines: the model in each run.
        data: the dataset.
        tracks: the model's tracks of the runs to take after.
        each: `map`, or that of a pool.

    Returns:
        One track per run, with gains of its own.
    """

    def one(k: int) -> Track:
        run = clean_run(machines[k], data, tracks[k].run, tracks[k].states[0], _SEED + k)
        return track_run(machines[k], data, run)

    return tuple(each(one, range(len(tracks))))


def left_over(before: Track, after: Track, channels: Sequence[str], floor: float | None) -> dict[str, float]:
    """Share of the gap on a run that a patch leaves, of each axis' channels and of all.

    Args:
        before: the given model's track of the run.
        after: the patched one's.
        channels: names of the columns.
        floor: RMS of a perfect model's whitened errors, 1 where it is not known.

    Returns:
        Axis -> share, "" -> that of all channels; 0 where an axis has no gap.
    """
    axes = [parse_channel(name).axis or "" for name in channels]
    squares = [np.nanmean(settled(t.whitened, t.run.period) ** 2, axis=0) for t in (before, after)]
    least, shares = (floor or 1.0) ** 2, {}
    for axis in {"", *axes}:
        own = [k for k, name in enumerate(axes) if axis in ("", name)]
        gap, left = (float(np.nanmean(part[own])) - least for part in squares)
        shares[axis] = min(1.0, max(0.0, left / gap)) if gap > 1.0e-3 * least else 0.0
    return shares
