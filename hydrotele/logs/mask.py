"""Stretches of runs that may not be used: contact, maintenance, whatever the model leaves out."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.core.files import read_text

_HEADER = ("run", "begin", "end")


class Masked(NamedTuple):
    """From begin to end [s] of a run's own time stamps; the run "" stands for every run."""

    run: str
    begin: float
    end: float


def read_mask(path: str | Path) -> tuple[Masked, ...]:
    """Stretches of a CSV file with the columns `run,begin,end`, times in seconds.

    Args:
        path: the file; an empty run means every run, an empty time the run's own start or end.

    Raises:
        InputError: the file is not there, or a line is no stretch; names the line.
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
            if tuple(cells) != _HEADER:
                raise InputError(f"{path}:{number}", "must begin with the header run,begin,end")
            continue
        try:
            run, begin, end = cells
            stretch = Masked(run, float(begin or -math.inf), float(end or math.inf))
        except ValueError:
            message = f"is {','.join(cells)!r}: write run,begin,end, such as dig_1,12.5,14.0"
            raise InputError(f"{path}:{number}", message) from None
        if not stretch.begin < stretch.end:
            raise InputError(f"{path}:{number}", f"ends at {stretch.end:g} s, before its beginning")
        found.append(stretch)
    if not found:
        raise InputError(path, "masks nothing: write run,begin,end and one stretch per line")
    return tuple(found)


def check_runs(masks: Sequence[Masked], runs: Sequence[str]) -> None:
    """Refuse stretches of runs that are not there.

    Raises:
        InputError: names the run and those that are there.
    """
    for mask in masks:
        if mask.run and mask.run not in runs:
            raise InputError(
                f"mask of run {mask.run!r}", f"is not there; {suggest(mask.run, runs)}"
            )


def unmasked(masks: Sequence[Masked], run: str, time: np.ndarray) -> np.ndarray:
    """Whether each row (n,) of a run, at its time (n,) [s], is outside all stretches.

    >>> unmasked([Masked("", 1.0, 2.0)], "dig_1", np.array([0.5, 1.0, 1.5, 2.0])).tolist()
    [True, False, False, True]
    """
    valid = np.ones(len(time), dtype=bool)
    for mask in masks:
        if mask.run in ("", run):
            valid &= (time < mask.begin) | (time >= mask.end)
    return valid
