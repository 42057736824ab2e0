"""Which runs are fitted and which one judges; a single run is split in time."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hydrotele.core.datafile import suggest
from hydrotele.core.errors import InputError
from hydrotele.logs.rows import Rows, cut

SHORTEST = 0.5  # [s] of a run: a fast servo's stroke, of which the unknown start takes a part
FEWEST = 50  # rows of a run
_SHORTEST_PIECE = 10.0  # [s] of a piece of a single run, if it is to be fitted in several
_PIECES = 3
_SHARE = 0.15, 0.6  # of a run that was cut, which a piece that judges the others should have
_FIT = 0.75  # of a single run
_QUIET = 0.1  # of the commands' changes: less of them in the last quarter judges nothing
_LEAST_FIT = 0.5  # of a single run
_HELD_OUT = ("test", "heldout", "validation")


class Part(NamedTuple):
    """A run, a piece of one, or a part of a split piece.

    Attributes:
        name: its own name.
        piece: name of the run or piece that it was split from; its own name if it was not.
        rows: its rows.
    """

    name: str
    piece: str
    rows: Rows


class Split(NamedTuple):
    """Runs to fit, and the run held out."""

    fit: tuple[Part, ...]
    heldout: Part


def seconds(rows: Rows) -> float:
    """Length of a run [s]."""
    return len(rows.command) * rows.period


def too_short(rows: Rows) -> str | None:
    """What a run lacks in length, as words; None if it is long enough."""
    if seconds(rows) >= SHORTEST - 1e-9 and len(rows.command) >= FEWEST:
        return None
    return (
        f"{seconds(rows):.3g} s long ({len(rows.command)} rows); {SHORTEST:g} s and {FEWEST} rows"
        " are needed"
    )


def split(
    runs: Mapping[str, Rows], origin: Mapping[str, str], heldout: str | None
) -> tuple[Split, tuple[str, ...]]:
    """Hold one run out: the one named, else the first of the runs `test*`, `heldout*`,
    `validation*`, else the last by name. A single run is fitted on its first three quarters, or
    less where the machine rests after them.

    Args:
        runs: name of run or of piece -> rows, at least one.
        origin: the same names -> the run as logged, of which it may be a piece.
        heldout: name of a run, or None.

    Returns:
        (split, notes on runs that are neither fitted nor held out).

    Raises:
        InputError: there is no such run, nothing is left to fit, or a single run is too short.
    """  # noqa: D205 - the rule is one sentence
    names = sorted(set(origin.values()))
    if heldout is not None and heldout not in names:
        raise InputError(f"held-out run {heldout!r}", f"is not there; {suggest(heldout, names)}")
    if len(runs) == 1:
        name, rows = next(iter(runs.items()))
        if heldout is not None:
            raise InputError(
                f"held-out run {heldout!r}",
                "is the only run: leave the name away to split it in time, or add a run to fit",
            )
        return _split_in_time(name, rows), ()
    marked = [name for name in names if name.lower().startswith(_HELD_OUT)]
    if marked == names:
        marked = []
    chosen = heldout or (marked or [_last_piece(runs) if len(names) == 1 else names[-1]])[0]
    pieces = [n for n in runs if chosen in (n, origin[n])]
    judge = max(pieces, key=lambda n: seconds(runs[n]))
    aside = set(marked if heldout is None else ()) | {chosen}
    fit = [n for n in runs if n != judge and not {n, origin[n]} & aside]
    unused = [n for n in runs if n not in fit and n != judge]
    notes = (
        (f"{', '.join(unused)}: neither fitted nor judged on; {judge} is held out.",)
        if unused else ()
    )  # fmt: skip
    if not fit:
        raise InputError(f"held-out run {chosen!r}", "leaves no run to fit: add one")
    parts = tuple(Part(n, n, runs[n]) for n in fit)
    return Split(parts, Part(judge, judge, runs[judge])), notes


def _last_piece(runs: Mapping[str, Rows]) -> str:
    """Of the pieces of one run the last that is neither a scrap nor nearly all; else the last."""
    total = sum(map(seconds, runs.values()))
    low, high = _SHARE
    fair = [name for name, rows in runs.items() if low * total <= seconds(rows) <= high * total]
    return (fair or list(runs))[-1]


def _split_in_time(name: str, rows: Rows) -> Split:
    total = seconds(rows)
    n = len(rows.command)
    least = max(SHORTEST, FEWEST * rows.period) / (1.0 - _FIT)
    if total < least - 1e-9:
        raise InputError(
            name,
            f"is the only run and {total:.3g} s long; its last quarter is held out, which asks for"
            f" {least:.3g} s or more: log longer, or a second run",
        )
    last = _fit_rows(rows)
    count = int(np.clip(last * rows.period // _SHORTEST_PIECE, 1, _PIECES))
    edges = np.linspace(0, last, count + 1).astype(int)
    fit = tuple(
        Part(f"{name}_{i + 1}", name, cut(rows, a, b))
        for i, (a, b) in enumerate(zip(edges, edges[1:], strict=False))
    )
    return Split(fit, Part(f"{name}_heldout", name, cut(rows, edges[-1], n)))


def _fit_rows(rows: Rows) -> int:
    """Rows of a single run to fit on: three quarters, or less where the machine rests after them.

    A model of a machine at rest is right whatever its numbers. Then a quarter of the commands'
    changes is held out, and half of the run at most.
    """
    n = len(rows.command)
    passed = np.cumsum(np.abs(np.diff(rows.command, axis=0, prepend=rows.command[:1])).sum(axis=1))
    if passed[-1] == 0.0 or passed[-1] - passed[round(_FIT * n) - 1] >= _QUIET * passed[-1]:
        return round(_FIT * n)
    return max(int(np.searchsorted(passed, _FIT * passed[-1])), round(_LEAST_FIT * n))
