"""What is left unexplained in a mechanism's forces: on which drive, on what it depends, and when.

A sensor's noise cannot be foretold from the motion. Functions of the joints' positions and rates
are fitted to what is left of the fitted runs; what they foretell of the run that was not fitted is
a law that the model lacks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hydrotele.gap.mechanism_columns import Columns

_POINTS, _FINE, _GRID = 10, 40, 7  # of hat functions along one variable; of a grid of two
_RIDGE = 1e-3
_TOLD = 0.25  # share of the held-out residual's square that must be foretold: the best of many
# functions foretells up to a tenth of noise, and the form of a named law is not known exactly
_LAWS = 3  # functions that are added up at most
_WINDOW = 0.5  # s
_BURST = 4.0  # times the usual size of a window
_SMALL = 0.02  # share of a drive's force RMS below which nothing is lacking
_AGREES = 1.25  # times the fitted runs' noise, on the run that was not fitted
_SURE = 1e-4  # chance of a window of noise alone


@dataclass(frozen=True)
class Law:
    """A function of the state that foretells a part of one drive's residual.

    Attributes:
        drive: its place.
        variables: one or two, such as `position.slide_1`.
        share: of the held-out residual's square that it foretells.
        size: its RMS on the held-out run [N] or [N m].
    """

    drive: int
    variables: tuple[str, ...]
    share: float
    size: float


@dataclass(frozen=True)
class Left:
    """What is left.

    Attributes:
        laws: functions of the state, drive by drive, the most telling first.
        share: (k,) of the held-out residual's square that the laws of a drive foretell together.
        size: (k,) RMS of what is lacking [N] or [N m].
        tests: as of `Gap`.
        lacking: (k,) whether a drive's force lacks something.
    """

    laws: tuple[Law, ...]
    share: np.ndarray
    size: np.ndarray
    tests: Mapping[str, Mapping[str, float | bool]]
    lacking: np.ndarray


def find_left(
    fit: Columns, judge: Columns, rest: np.ndarray, judged: np.ndarray, std: np.ndarray,
    weight: np.ndarray, judge_weight: np.ndarray, spread: np.ndarray,
) -> Left:  # fmt: skip
    """Look for what is left.

    Args:
        fit: equations of the fitted runs; their states and times count.
        judge: of the run that was not fitted.
        rest: (n, k) residuals of the fitted runs [N] or [N m].
        judged: (j, k) of the other one.
        std: (k,) noise of the fitted runs.
        weight: (n, k) of the rows, lower where the sign of friction is in doubt.
        judge_weight: (j, k).
        spread: (k,) RMS of what the fit's own uncertainty does to the run that was not fitted.

    Returns:
        What is left.
    """
    drives = rest.shape[1]
    force = np.sqrt(np.mean(judge.measured**2, axis=0))
    laws, share, size = [], np.zeros(drives), np.zeros(drives)
    for k in range(drives):
        own, told = _laws(
            fit.states, judge.states, weight[:, k] * rest[:, k],
            judge_weight[:, k] * judged[:, k], weight[:, k], judge_weight[:, k], k,
        )  # fmt: skip
        share[k], size[k] = told
        if share[k] > _TOLD and size[k] > _SMALL * force[k]:
            laws += own
    burst, limit, loud = _bursts([(fit, weight * rest), (judge, judge_weight * judged)], std)
    grown = np.sqrt(np.mean((judge_weight * judged) ** 2, axis=0)
                    / np.mean(judge_weight**2, axis=0))  # fmt: skip
    std = np.hypot(std, spread)
    grown = grown / std
    excess = std * np.sqrt(np.maximum(grown**2 - 1.0, 0.0))
    by_state = (share > _TOLD) & (size > _SMALL * force)
    by_time = (burst > limit) & (loud > _SMALL * force)
    by_run = (grown > _AGREES) & (excess > _SMALL * force)
    laws.sort(key=lambda law: -law.size)
    worst = int(np.argmax(burst / limit))
    tests = {
        "state": _test(float(np.where(size > _SMALL * force, share, 0.0).max()), _TOLD,
                       not by_state.any()),
        "windows": _test(float(burst[worst]), float(limit[worst]), not by_time.any()),
        "heldout": _test(float(np.where(excess > _SMALL * force, grown, np.minimum(
            grown, _AGREES)).max()), _AGREES, not by_run.any()),
    }  # fmt: skip
    lacking = by_state | by_time | by_run
    size = np.maximum(np.where(by_state, size, 0.0), np.where(by_run, excess, 0.0))
    size = np.maximum(size, np.where(by_time, loud, 0.0))
    return Left(tuple(laws), share, size, tests, lacking)


def with_variation(left: Left, moved: np.ndarray, std: np.ndarray) -> Left:
    """What is left, with effects that are not the same in all parts of the fitted runs.

    Args:
        left: without them.
        moved: (k,) RMS of what they do to the drives' forces [N] or [N m].
        std: (k,) of the forces' noise; what is smaller says nothing.

    Returns:
        What is left.
    """
    loud = moved > std
    tests = {**left.tests, "constant": _test(float((moved / std).max()), 1.0, not loud.any())}
    return replace(
        left, tests=tests, lacking=left.lacking | loud,
        size=np.maximum(left.size, np.where(loud, moved, 0.0)),
    )  # fmt: skip


def _test(value: float, limit: float, passed: bool) -> dict[str, float | bool]:
    return {"value": value, "limit": limit, "passed": bool(passed)}


def _laws(states, other, rest, judged, weight, judge_weight, drive: int):
    """Functions of the state, one after the other; and share and RMS of all together."""
    whole = float(np.sum(judged**2))
    laws, left, after = [], rest.copy(), judged.copy()
    names = list(states)
    for _ in range(_LAWS):
        best, pick = 0.0, None
        for variables in _choices(names):
            for points in (_POINTS, _FINE) if len(variables) == 1 else (_GRID,):
                made = _fitted(states, other, variables, points, left, weight, judge_weight)
                if made is None:
                    continue
                told, foretold = made
                gained = float(np.sum(after**2) - np.sum((after - foretold) ** 2)) / whole
                if gained > best:
                    best, pick = gained, (variables, told, foretold)
        if pick is None or best < 0.5 * _TOLD:
            break
        variables, told, foretold = pick
        left, after = left - told, after - foretold
        laws.append(Law(drive, variables, best, float(np.sqrt(np.mean(foretold**2)))))
    gone = judged - after
    return laws, (1.0 - float(np.sum(after**2)) / whole, float(np.sqrt(np.mean(gone**2))))


def _choices(names: Sequence[str]):
    for k, one in enumerate(names):
        yield (one,)
        for two in names[k + 1 :]:
            yield one, two


def _fitted(states, other, variables, points, rest, weight, judge_weight):
    """A smooth function of one or two variables: its values on both sets of rows."""
    edges = []
    for name in variables:
        low, high = np.quantile(states[name], [0.005, 0.995])
        if not high > low:
            return None
        edges.append(np.linspace(low, high, points))
    here = _hats(states, variables, edges) * weight[:, None]
    there = _hats(other, variables, edges) * judge_weight[:, None]
    square = here.T @ here
    square[np.diag_indices_from(square)] += _RIDGE * len(rest) / len(square) + 1e-12
    value = np.linalg.solve(square, here.T @ rest)
    return here @ value, there @ value


def _hats(states, variables, edges) -> np.ndarray:
    """Hat functions, or products of two."""
    out = None
    for name, points in zip(variables, edges, strict=True):
        at = np.clip((states[name] - points[0]) / (points[1] - points[0]), 0.0, len(points) - 1.0)
        hats = np.maximum(1.0 - np.abs(at[:, None] - np.arange(len(points))), 0.0)
        out = hats if out is None else (out[:, :, None] * hats[:, None, :]).reshape(len(hats), -1)
    assert out is not None
    return out


def _bursts(parts: Sequence[tuple[Columns, np.ndarray]], std: np.ndarray):
    """Largest window of a drive over its usual window, the limit of noise alone, and its RMS."""
    drives, levels = len(std), []
    for columns, rest in parts:
        length = max(4, round(_WINDOW / columns.spacing))
        for first, last in zip(columns.starts[:-1], columns.starts[1:], strict=True):
            count = (last - first) // length
            blocks = rest[first : first + count * length].reshape(count, length, drives)
            levels.append(np.mean(blocks**2, axis=1))
    level = np.concatenate(levels)
    usual = np.maximum(np.median(level, axis=0), 1e-24)
    free = max(_WINDOW * 2.0 * parts[0][0].band / 3.0, 2.0)  # rows of a band follow each other
    limit = max(_BURST**2, float(chi2.isf(_SURE / level.size, free) / free))
    loud = np.sqrt(np.maximum(level.max(axis=0) - usual, 0.0))
    return np.sqrt(level.max(axis=0) / usual), np.full(drives, np.sqrt(limit)), loud


def loud_windows(
    time: np.ndarray, whitened: np.ndarray, most: int = 5
) -> tuple[tuple[float, float], ...]:  # fmt: skip
    """Windows of half a second in which errors (n,) are largest.

    Args:
        time: (n,) [s].
        whitened: (n,) errors over their noise.
        most: number of windows.

    Returns:
        (start, end) [s], in order of time; those at least twice the usual size.
    """
    spacing = float(np.median(np.diff(time)))
    length = max(1, round(_WINDOW / spacing))
    count = len(time) // length
    if count < 2:
        return ()
    level = np.nanmean(whitened[: count * length].reshape(count, length) ** 2, axis=1)
    usual = np.median(level)
    picked = sorted(int(k) for k in np.argsort(-level)[:most] if level[k] > 4.0 * usual)
    return tuple(
        (round(float(time[k * length]), 2), round(float(time[k * length] + _WINDOW), 2))
        for k in picked
    )
