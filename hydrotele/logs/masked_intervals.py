"""Intervals of runs whose readings are not used, read from a mask file, times in seconds."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest_valid_name
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text

_MASK_HEADER = ("run", "begin", "end")


class MaskedInterval(NamedTuple):
    """Interval of a run whose readings are not used: time stamps `begin` <= t < `end` [s].

    An empty run name means all runs.
    """

    run: str
    begin: float
    end: float


def read_mask(path: str | Path) -> tuple[MaskedInterval, ...]:
    """Read masked intervals from a CSV file with the columns `run,begin,end`, times in seconds.

    Args:
        path: the file; an empty run means all runs, an empty time the start or end of the run.

    Returns:
        The intervals, in the order of the file.

    Raises:
        InputError: the file does not exist or has no interval, or a line is invalid; the message
            names the line.
    """
    path = Path(path)
    lines = read_text(path).splitlines()
    found, header = [], False
    for number, cells in enumerate(csv.reader(lines), start=1):
        cells = [cell.strip() for cell in cells]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if not header:
            header = True
            if tuple(cells) != _MASK_HEADER:
                raise InputError(f"{path}:{number}", "must be the header run,begin,end")
            continue
        try:
            run, begin, end = cells
            stretch = MaskedInterval(run, float(begin or -math.inf), float(end or math.inf))
        except ValueError:
            message = f"is {','.join(cells)!r}: write run,begin,end, such as dig_1,12.5,14.0"
            raise InputError(f"{path}:{number}", message) from None
        if not stretch.begin < stretch.end:
            raise InputError(f"{path}:{number}", f"ends at {stretch.end:g} s, before its start")
        found.append(stretch)
    if not found:
        raise InputError(path, "has no interval: write run,begin,end and one interval per line")
    return tuple(found)


def check_mask_runs(masks: Sequence[MaskedInterval], runs: Sequence[str]) -> None:
    """Check that the run of every masked interval is one of `runs`.

    Raises:
        InputError: a run does not exist; the message lists the runs.
    """
    for mask in masks:
        if mask.run and mask.run not in runs:
            raise InputError(
                f"mask of run {mask.run!r}",
                f"the run does not exist; {suggest_valid_name(mask.run, runs)}",
            )


def find_unmasked_rows(masks: Sequence[MaskedInterval], run: str, time: np.ndarray) -> np.ndarray:
    """Return for each row of a run whether it is outside all masked intervals (n,), from its time stamp (n,) [s].

    An interval `begin <= t < end` masks the rows of its run, or of all runs if its run name is empty.

    >>> find_unmasked_rows([MaskedInterval("", 1.0, 2.0)], "dig_1", np.array([0.5, 1.0, 1.5, 2.0])).tolist()
    [True, False, False, True]
    """
    valid = np.ones(len(time), dtype=bool)
    for mask in masks:
        if mask.run in ("", run):
            valid &= (time < mask.begin) | (time >= mask.end)
    return valid
