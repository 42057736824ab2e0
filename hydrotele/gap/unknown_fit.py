"""Greedy sparse regression: few terms that explain a residual and hold up on the held-out run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from hydrotele.gap.unknown_target import Target, signal
from hydrotele.gap.unknown_terms import TERMS, Term

_MOST = 3  # terms: more describe noise, and nobody reads them
_TRIED = 4  # families tried for one place before giving up
_AGAIN = {"bore", "place", "beat", "teeth"}  # families that may come twice, at another place
_LEAST = 0.04  # share of a sum of squares below which a term tells a mechanic nothing


@dataclass(frozen=True)
class Fitted:
    """A term with its numbers.

    Attributes:
        term: the family.
        parameters: of its columns.
        coefficients: (1,) or (2,) of sine and cosine.
    """

    term: Term
    parameters: tuple[float, ...]
    coefficients: np.ndarray


@dataclass(frozen=True)
class Explained:
    """Terms that explain a target.

    Attributes:
        terms: the most telling first.
        fit_share: part of the fit runs' sum of squares that they explain [1].
        heldout_share: the same of the held-out run, with the fit runs' numbers [1].
    """

    terms: tuple[Fitted, ...]
    fit_share: float
    heldout_share: float


def explain(target: Target) -> Explained:
    """Explain a target by orthogonal matching pursuit.

    A term is taken if it pays for its numbers and for the grid searched (Bayes' criterion) on the
    fit runs, and, with the numbers found there, lowers the sum of squares of the held-out run.

    Args:
        target: at least two runs; the first is the held-out one.

    Returns:
        Up to three terms; none where none holds up.
    """
    chosen: list[tuple[Term, tuple[float, ...]]] = []
    if len(target.parts) < 2:
        return Explained((), 0.0, 0.0)
    library = _library(target)
    total, test = _score(target, chosen)
    first, before = (total, test), (total, test)
    while len(chosen) < _MOST:
        for term, start in _ranked(target, library, chosen)[:_TRIED]:
            tried = [*chosen, (term, _refined(target, chosen, term, start))]
            after = _score(target, tried)
            if _pays(target, term, library, before[0], after[0], first[0]) and (
                after[1] < before[1] - _LEAST * first[1]
            ):
                chosen, before = tried, after
                break
        else:
            break
    chosen, before = _without_idle(target, chosen, before, first)
    coefficients, fitted = _solve(target, chosen), []
    for term, parameters in chosen:
        size = len(_columns(target, term, parameters, 1))
        fitted.append(Fitted(term, parameters, coefficients[:size]))
        coefficients = coefficients[size:]
    return Explained(tuple(fitted), 1.0 - before[0] / first[0], 1.0 - before[1] / first[1])


Library = Sequence[tuple[Term, list[tuple[float, ...]]]]
Chosen = Sequence[tuple[Term, tuple[float, ...]]]


def _library(target: Target) -> Library:
    """Families whose signals all runs have, with the parameters to try."""
    found = []
    for term in TERMS:
        names = [target.roles.get(role, "") for role in term.roles]
        there = all(name in part.scene.values for part in target.parts for name in names)
        if target.law not in term.laws or not there:
            continue
        signals = [
            np.concatenate([signal(part.scene, name) for part in target.parts[1:]])
            for name in names
        ]
        grid = term.grid(*signals) if term.grid else [()]
        if grid:
            found.append((term, grid))
    return found


def _columns(
    target: Target, term: Term, parameters: Sequence[float], part: int
) -> list[np.ndarray]:
    """Weighted columns of a term at the rows of a part, each (k,)."""
    scene, rows = target.parts[part].scene, target.parts[part].rows
    columns = term.columns(*(signal(scene, target.roles[r]) for r in term.roles), *parameters)
    if target.banded:
        columns = scene.in_band(np.nan_to_num(np.column_stack(columns))).T
    weight = target.parts[part].weight
    return [weight * np.nan_to_num(column[rows]) for column in columns]


def _matrix(target: Target, chosen: Chosen, parts: Sequence[int]) -> np.ndarray:
    """(k, c) columns of all terms over some parts."""
    rows = sum(len(target.parts[p].rows) for p in parts)
    blocks = []
    for term, parameters in chosen:
        each = [_columns(target, term, parameters, p) for p in parts]
        blocks += [np.concatenate(parts_of) for parts_of in zip(*each, strict=True)]
    return np.column_stack(blocks) if blocks else np.zeros((rows, 0))


def _fit_parts(target: Target) -> range:
    return range(1, len(target.parts))


def _wanted(target: Target, parts: Sequence[int]) -> np.ndarray:
    return np.concatenate([target.parts[p].weight * target.parts[p].wanted for p in parts])


def _solve(target: Target, chosen: Chosen) -> np.ndarray:
    matrix = _matrix(target, chosen, _fit_parts(target))
    size = np.sqrt(np.mean(matrix**2, axis=0)) + 1e-300
    wanted = _wanted(target, _fit_parts(target))
    return np.linalg.lstsq(matrix / size, wanted, rcond=1e-8)[0] / size


def _score(target: Target, chosen: Chosen) -> tuple[float, float]:
    """Sums of squares of the fit runs and of the held-out run."""
    found = _solve(target, chosen)
    sums = []
    for parts in (_fit_parts(target), [0]):
        left = _wanted(target, parts) - _matrix(target, chosen, parts) @ found
        sums.append(float(left @ left))
    return sums[0], sums[1]


def _pays(target, term: Term, library: Library, before: float, after: float, first: float) -> bool:
    if before - after < _LEAST * first:
        return False
    count = len(_wanted(target, _fit_parts(target)))
    grid = next(len(g) for t, g in library if t is term)
    numbers = 1 + len(term.units)
    gain = count * np.log(before / max(after, 1e-300))
    return gain > numbers * np.log(count) + 2.0 * np.log(grid)


def _ranked(target: Target, library: Library, chosen: Chosen) -> list:
    """(family, best parameters), by how much they lower the fit runs' sum of squares."""
    known = _matrix(target, chosen, _fit_parts(target))
    basis = np.linalg.qr(known)[0] if known.shape[1] else known
    wanted = _wanted(target, _fit_parts(target))
    left = wanted - basis @ (basis.T @ wanted)
    count, ranking = len(wanted), []
    used = {term.name for term, _ in chosen} - _AGAIN
    for term, grid in library:
        if term.name in used:
            continue
        best = (-np.inf, ())
        for parameters in grid:
            block = _matrix(target, [(term, parameters)], _fit_parts(target))
            full = np.sum(block**2)
            block = block - basis @ (basis.T @ block)
            if np.sum(block**2) <= 1e-6 * full:
                continue
            q = np.linalg.qr(block)[0]
            best = max(best, (float(np.sum((q.T @ left) ** 2)), parameters))
        if np.isfinite(best[0]):
            rest = max(float(left @ left) - best[0], 1e-300)
            cost = (1 + len(term.units)) * np.log(count) + 2.0 * np.log(len(grid))
            ranking.append((count * np.log(rest) + cost, len(ranking), term, best[1]))
    return [(term, parameters) for _, _, term, parameters in sorted(ranking, key=lambda r: r[:2])]


def _refined(target: Target, chosen: Chosen, term: Term, start: tuple[float, ...]):
    """Parameters moved from the grid to the best place beside it."""
    if not start:
        return start
    size = np.maximum(np.abs(start), 1e-9)

    def left(scaled: np.ndarray) -> float:
        if np.any(scaled * np.sign(start) <= 0.0):
            return np.inf
        tried = tuple(float(x) for x in scaled * size)
        return _score(target, [*chosen, (term, tried)])[0]

    simplex = np.vstack(
        [np.sign(start), *(np.sign(start) + 0.03 * row for row in np.eye(len(start)))]
    )
    found = minimize(
        left, np.sign(start), method="Nelder-Mead",
        options={"maxfev": 80, "xatol": 1e-3, "fatol": 1e-9, "initial_simplex": simplex},
    )  # fmt: skip
    return tuple(float(x) for x in found.x * size)


def _without_idle(target: Target, chosen: Chosen, before, first):
    """Drop terms that later ones made idle, and put the most telling first."""
    kept = list(chosen)
    for item in list(chosen):
        rest = [other for other in kept if other is not item]
        after = _score(target, rest)
        if len(kept) > 1 and after[0] - before[0] < _LEAST * first[0]:
            kept, before = rest, after
    alone = {id(item): _score(target, [o for o in kept if o is not item])[0] for item in kept}
    return sorted(kept, key=lambda item: -alone[id(item)]), before
