"""Long records, cut to their busiest stretches: the rest says the same again, at the same cost."""

import dataclasses

import numpy as np

from hydrotele.dataset.load import Dataset, RunData

MOST_SECONDS = 720.0  # of all fitted runs together: eighteen runs of a usual length


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
    part = slice(first, first + rows)
    return dataclasses.replace(
        run, start=run.start + first * run.period, command=run.command[part],
        command_known=run.command_known[part], reading=run.reading[part],
    )  # fmt: skip
