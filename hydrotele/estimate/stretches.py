"""Long or fast records, cut to their busiest stretches and averaged to a rate that says as much."""

import dataclasses

import numpy as np

from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.logs.rows import Rows, averaged

_RATE, _PER_CYCLE = 100.0, 6.0  # Hz; rows per cycle of the fastest valve
_SHORT = 2.0  # s, of a run that is kept as it is
MOST_SECONDS = 150.0  # of all fitted runs together: four runs of a usual length


def busiest(data: Dataset, most: float = MOST_SECONDS) -> Dataset:
    """A dataset whose fit runs are no longer than a stated time together.

    Every run is cut to its share, the stretch in which the commands change most, and a note says
    which. The run that is held out stays whole.

    Args:
        data: the dataset.
        most: time of all fit runs [s].

    Returns:
        The dataset, or the given one if it is short enough.
    """
    total = sum(len(run.command) * run.period for run in data.fit)
    if total <= most:
        return data
    runs, notes = [], []
    for run in data.fit:
        rows = round(len(run.command) * most / total)
        cut = _stretch(run, _busiest_row(data, run, rows), rows)
        runs.append(cut)
        end = cut.start + rows * run.period
        notes.append(f"{run.name} is long: it is fitted from {cut.start:.0f} to {end:.0f} s only.")
    return dataclasses.replace(data, fit=tuple(runs), notes=(*data.notes, *notes))


def thinned(data: Dataset) -> Dataset:
    """A dataset at no higher rate than its machine's valves answer, each row a mean of several.

    From one millisecond to the next a model and its readings can hardly disagree; what says
    whether a machine has a mass, a friction or a leak takes longer than a valve's own lag.
    """
    bandwidths = [a.valve.bandwidth / (2.0 * np.pi) for a in data.machine.axes.values() if a.valve]
    rate = max(_RATE, _PER_CYCLE * max(bandwidths, default=0.0))

    def thin(run: RunData) -> RunData:
        if run.period * rate > 0.75 or len(run.command) * run.period < _SHORT:
            return run
        valid = np.ones(len(run.command), bool) if run.valid is None else run.valid
        rows, behind, _ = averaged(
            Rows(run.start, run.period, run.command, run.command_known, run.reading, valid), rate
        )
        behind = behind * (1.0 if run.behind is None else run.behind)
        return dataclasses.replace(
            run, period=rows.period, command=rows.command, command_known=rows.known,
            reading=rows.reading, valid=rows.valid, behind=behind,
        )  # fmt: skip

    fit = tuple(map(thin, data.fit))
    return dataclasses.replace(data, fit=fit, heldout=thin(data.heldout))


def busiest_rows(run: RunData, rows: int) -> slice:
    """The stretch of some rows of a run in which its commands change most; all if it is shorter."""
    if rows >= len(run.command):
        return slice(0, len(run.command))
    spread = np.std(run.command, axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    first = int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))
    return slice(first, first + rows)


def _busiest_row(data: Dataset, run: RunData, rows: int) -> int:
    spread = np.std(np.concatenate([r.command for r in data.fit]), axis=0)
    jumps = np.abs(np.diff(run.command, axis=0)) / np.where(spread > 0.0, spread, 1.0)
    passed = np.concatenate([[0.0], np.cumsum(jumps.sum(axis=1))])
    return int(np.argmax(passed[rows - 1 :] - passed[: len(passed) - rows + 1]))


def _stretch(run: RunData, first: int, rows: int) -> RunData:
    return run.part(first, first + rows)
