"""Selection of measurement poses, and leave-one-out prediction.

Poses are selected by the parameters' information matrix (determinant or observability index O1 to
O5).
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from hydrotele.core.errors import InputError

Criterion = Literal["D", "O1", "O2", "O3", "O4", "O5"]
_RELATIVE_RIDGE = 1e-9  # times the mean information, so that the first poses have a nonzero determinant
Key = TypeVar("Key", bound=Hashable)
Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class PoseSelection:
    """Selected poses.

    Attributes:
        chosen: indices of the poses among the candidates.
        index: value of the criterion for the selected poses; larger is better.
        exchanges: number of exchanges made by the search.
    """

    chosen: tuple[int, ...]
    index: float
    exchanges: int


def observability_index(information: np.ndarray, criterion: Criterion, equations: int) -> float:
    """Compute an observability index, which rates how well measured poses determine parameters.

    A larger index is better.

    With singular values s1 >= ... >= sp of the scaled identification Jacobian of m equations:
    D = O1 = (s1 ... sp)^(1/p) / sqrt(m), O2 = sp / s1, O3 = sp, O4 = sp^2 / s1,
    O5 = 1 / (1/s1 + ... + 1/sp).

    Args:
        information: (p, p) information matrix J'J of parameters in units of their scales.
        criterion: name of the index.
        equations: m, number of equations.

    Returns:
        The index; 0 if the information matrix is singular.

    Source: Borm and Menq 1991 (O1); Driels and Pathre 1990 (O2); Nahvi, Hollerbach and Hayward 1994
    (O3); Nahvi and Hollerbach 1996 (O4); Sun and Hollerbach 2008 (O5, comparison).

    >>> observability_index(np.diag([4.0, 1.0]), "O2", 10)
    0.5
    """
    s = np.sqrt(np.maximum(np.linalg.eigvalsh(information), 0.0))[::-1]
    if s[-1] <= 0.0:
        return 0.0
    if criterion in ("D", "O1"):
        return float(np.exp(np.mean(np.log(s))) / np.sqrt(equations))
    if criterion == "O2":
        return float(s[-1] / s[0])
    if criterion == "O3":
        return float(s[-1])
    if criterion == "O4":
        return float(s[-1] ** 2 / s[0])
    return float(1.0 / np.sum(1.0 / s))


def select_poses(
    jacobians: np.ndarray, count: int, criterion: Criterion = "D",
    prior: np.ndarray | None = None,
) -> PoseSelection:  # fmt: skip
    """Select the poses whose measurements are most informative about the parameters.

    Args:
        jacobians: (n, k, p) derivatives of the k equations of each candidate by identifiable
            parameters in units of their scales, divided by the equations' standard deviations.
        count: number of poses to select.
        criterion: `D` or an observability index.
        prior: (p, p) information already available, for example from earlier poses.

    Returns:
        The poses, found by addition and exchange; no exchange of one pose improves the criterion.

    Raises:
        InputError: there are fewer candidates than poses, or too few equations.

    Source: Fedorov 1972 (exchange); Daney, Papegay and Madeline 2005 (robot calibration).
    """
    rows = np.asarray(jacobians, float)
    n, k, p = rows.shape
    if not 0 < count <= n:
        raise InputError("poses", f"cannot select {count} poses from {n} candidates")
    if prior is None and count * k < p:
        raise InputError("poses", f"{count} poses give {count * k} equations for {p} parameters: choose more")
    each = np.einsum("nki,nkj->nij", rows, rows)
    small = _RELATIVE_RIDGE * max(float(np.trace(each.mean(axis=0))) / p, 1e-300) * np.eye(p)
    base = small if prior is None else np.asarray(prior, float) + small

    def find_best_candidate(total: np.ndarray, open_: np.ndarray, size: int) -> tuple[int, float]:
        if criterion in ("D", "O1"):
            gains = _log_det_gains(total, rows[open_])
            place = int(np.argmax(gains))
        else:
            values = [observability_index(total + each[c], criterion, size * k) for c in open_]
            place = int(np.argmax(values))
        chosen = int(open_[place])
        return chosen, observability_index(total + each[chosen], criterion, size * k)

    chosen: list[int] = []
    total = base.copy()
    for size in range(1, count + 1):
        open_ = np.setdiff1d(np.arange(n), chosen)
        new, _ = find_best_candidate(total, open_, size)
        chosen.append(new)
        total = total + each[new]
    value, exchanges, improved = observability_index(total, criterion, count * k), 0, True
    while improved and count < n:
        improved = False
        for place in range(count):
            without = total - each[chosen[place]]
            open_ = np.setdiff1d(np.arange(n), chosen)
            new, better = find_best_candidate(without, open_, count)
            if better > value * (1.0 + 1e-9):
                chosen[place], total, value = new, without + each[new], better
                exchanges, improved = exchanges + 1, True
    return PoseSelection(tuple(chosen), value, exchanges)


def _log_det_gains(total: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return by how much each candidate's rows J (k, p) would increase the log determinant of `total`.

    Args:
        total: (p, p) present information matrix.
        rows: (n, k, p) rows of the n candidates.

    Returns:
        (n,) log det(I + J total^-1 J').
    """
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(factor, np.swapaxes(rows, 1, 2).transpose(1, 0, 2).reshape(len(total), -1))
    half = half.reshape(len(total), len(rows), -1)
    grown = np.einsum("pnk,pnl->nkl", half, half) + np.eye(rows.shape[1])
    return np.linalg.slogdet(grown)[1]


def leave_one_out(
    groups: Iterable[Key], fit: Callable[[Sequence[Key]], Fitted],
    evaluate: Callable[[Fitted, Key], float],
) -> dict[Key, float]:  # fmt: skip
    """Cross-validate: compute the error of each group with a fit to all other groups.

    Args:
        groups: names of poses, or of groups of poses that are left out together.
        fit: function from groups to a fit.
        evaluate: function that returns the error of a fit on a group.

    Returns:
        Error by group.

    >>> data = {"a": 1.0, "b": 2.0, "c": 6.0}
    >>> mean = lambda names: sum(data[name] for name in names) / len(names)
    >>> leave_one_out(data, mean, lambda fitted, name: abs(fitted - data[name]))
    {'a': 3.0, 'b': 1.5, 'c': 4.5}
    """
    named = list(groups)
    return {name: evaluate(fit([other for other in named if other != name]), name) for name in named}
