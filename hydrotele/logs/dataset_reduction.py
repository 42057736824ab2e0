"""Reduction of a data set to its most exciting segments or to a lower sample rate."""

import dataclasses

import numpy as np

from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.resampling import RunRows, average_rows

_MIN_RATE, _ROWS_PER_CYCLE = 100.0, 6.0  # minimum rate [Hz]; rows per cycle of the fastest valve
_MIN_DOWNSAMPLED_SECONDS = 2.0  # s, shorter runs are not downsampled
MAX_FIT_SECONDS = 150.0  # s, maximum total duration of the fit runs: about four typical runs


def select_exciting_segments(data: Dataset, max_seconds: float = MAX_FIT_SECONDS) -> Dataset:
    """Shorten each fit run to its segment with the largest command changes.

    All runs are shortened by the same factor, so that their total duration is `max_seconds`. The
    changes of each command are divided by its standard deviation over all fit runs. A note states
    each segment. The held-out run is not changed.

    Args:
        data: the dataset.
        max_seconds: maximum total duration of the fit runs [s].

    Returns:
        The shortened dataset, or the given one if it is short enough.
    """
    total = sum(len(run.command) * run.period for run in data.fit)
    if total <= max_seconds:
        return data
    runs, notes = [], []
    for run in data.fit:
        rows = round(len(run.command) * max_seconds / total)
        cut = _segment(run, _find_exciting_row(data, run, rows), rows)
        runs.append(cut)
        end = cut.start + rows * run.period
        notes.append(f"{run.name} is long: only the interval from {cut.start:.0f} to {end:.0f} s is fitted.")
    return dataclasses.replace(data, fit=tuple(runs), notes=(*data.notes, *notes))


def downsample(data: Dataset) -> Dataset:
    """Return a dataset in which the sample rate of all runs is reduced by averaging rows.

    The new rate is at most about six times the bandwidth of the fastest valve or 100 Hz, whichever
    is larger. Higher rates add little information, because mass, friction and leakage act more
    slowly than the valves. Runs shorter than 2 s, or with a rate below 1.33 times this limit, are
    not changed.
    """
    bandwidths = [a.valve.bandwidth / (2.0 * np.pi) for a in data.machine.axes.values() if a.valve]
    rate = max(_MIN_RATE, _ROWS_PER_CYCLE * max(bandwidths, default=0.0))

    def downsample_run(run: RunData) -> RunData:
        if run.period * rate > 0.75 or len(run.command) * run.period < _MIN_DOWNSAMPLED_SECONDS:
            return run
        valid = np.ones(len(run.command), bool) if run.valid is None else run.valid
        rows, behind, _ = average_rows(
            RunRows(run.start, run.period, run.command, run.command_known, run.reading, valid), rate
        )
        behind = behind * (1.0 if run.readings_per_mean is None else run.readings_per_mean)
        return dataclasses.replace(
            run, period=rows.period, command=rows.command, command_known=rows.known,
            reading=rows.reading, valid=rows.valid, readings_per_mean=behind,
        )  # fmt: skip

    fit = tuple(map(downsample_run, data.fit))
    return dataclasses.replace(data, fit=fit, heldout=downsample_run(data.heldout))


def find_exciting_segment(run: RunData, rows: int) -> slice:
    """Return the `rows` consecutive rows of a run with the largest command changes, as a slice.

    The changes of each command are divided by its standard deviation in the run. If the run has
    fewer rows, the slice covers all of them.
    """
    if rows >= len(run.command):
        return slice(0, len(run.command))
    spread = np.std(run.command, axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    first = int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))
    return slice(first, first + rows)


def _find_exciting_row(data: Dataset, run: RunData, rows: int) -> int:
    spread = np.std(np.concatenate([r.command for r in data.fit]), axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    return int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))


def _segment(run: RunData, first: int, rows: int) -> RunData:
    return run.select_rows(first, first + rows)
