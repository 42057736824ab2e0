"""Which poses to measure, and how well a calibration predicts those that it has not seen.

Poses are chosen by the information matrix of the parameters: its determinant (D) or one of the
observability indices O1 to O5 of robot calibration. The search adds poses one by one and then
exchanges them while that helps.
"""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from hydrotele.core.errors import InputError

Criterion = Literal["D", "O1", "O2", "O3", "O4", "O5"]
_RIDGE = 1e-9  # of the mean information, so that the first poses have a determinant

Key = TypeVar("Key", bound=Hashable)
Fitted = TypeVar("Fitted")


@dataclass(frozen=True)
class Selection:
    """Chosen poses.

    Attributes:
        chosen: places of the poses among the candidates.
        index: the criterion's value, larger is better.
        exchanges: that the second part of the search made.
    """

    chosen: tuple[int, ...]
    index: float
    exchanges: int


def observability(information: np.ndarray, criterion: Criterion, equations: int) -> float:
    """How well a set of equations tells scaled parameters; larger is better.

    With singular values s1 >= ... >= sp of the scaled identification Jacobian of m equations:
    D = O1 = (s1 ... sp)^(1/p) / sqrt(m), O2 = sp / s1, O3 = sp, O4 = sp^2 / s1,
    O5 = 1 / (1/s1 + ... + 1/sp).

    Args:
        information: (p, p) J'J of parameters in units of their sizes.
        criterion: which.
        equations: m, number of equations.

    Returns:
        The index; 0 where a direction is not told.

    Source: Borm and Menq 1991 (O1); Driels and Pathre 1990 (O2); Nahvi, Hollerbach and Hayward 1994
    (O3); Nahvi and Hollerbach 1996 (O4); Sun and Hollerbach 2008 (O5, comparison).

    >>> observability(np.diag([4.0, 1.0]), "O2", 10)
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
) -> Selection:  # fmt: skip
    """Poses whose measurements tell the parameters best.

    Args:
        jacobians: (n, k, p) derivatives of the k equations of every candidate by identifiable
            parameters in units of their sizes, over the equations' standard deviations.
        count: number of poses to choose.
        criterion: `D` or an observability index.
        prior: (p, p) information that is there already, such as that of poses measured before.

    Returns:
        The poses, found by adding and exchanging; no exchange of one pose improves them.

    Raises:
        InputError: fewer candidates than poses, or too few equations for the parameters.

    Source: Fedorov 1972 (exchange); Daney, Papegay and Madeline 2005 (robot calibration).
    """
    rows = np.asarray(jacobians, float)
    n, k, p = rows.shape
    if not 0 < count <= n:
        raise InputError("poses", f"{count} of {n} candidates cannot be chosen")
    if prior is None and count * k < p:
        raise InputError(
            "poses", f"{count} poses give {count * k} equations for {p} parameters: choose more"
        )
    each = np.einsum("nki,nkj->nij", rows, rows)
    small = _RIDGE * max(float(np.trace(each.mean(axis=0))) / p, 1e-300) * np.eye(p)
    base = small if prior is None else np.asarray(prior, float) + small

    def best(total: np.ndarray, open_: np.ndarray, size: int) -> tuple[int, float]:
        if criterion in ("D", "O1"):
            gains = _gains(total, rows[open_])
            place = int(np.argmax(gains))
        else:
            values = [observability(total + each[c], criterion, size * k) for c in open_]
            place = int(np.argmax(values))
        chosen = int(open_[place])
        return chosen, observability(total + each[chosen], criterion, size * k)

    chosen: list[int] = []
    total = base.copy()
    for size in range(1, count + 1):
        open_ = np.setdiff1d(np.arange(n), chosen)
        new, _ = best(total, open_, size)
        chosen.append(new)
        total = total + each[new]
    value, exchanges, improved = observability(total, criterion, count * k), 0, True
    while improved and count < n:
        improved = False
        for place in range(count):
            without = total - each[chosen[place]]
            open_ = np.setdiff1d(np.arange(n), chosen)
            new, better = best(without, open_, count)
            if better > value * (1.0 + 1e-9):
                chosen[place], total, value = new, without + each[new], better
                exchanges, improved = exchanges + 1, True
    return Selection(tuple(chosen), value, exchanges)


def _gains(total: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Growth of log det by every candidate's (n, k, p) rows: log det(I + J P J')."""
    factor = np.linalg.cholesky(total)
    half = np.linalg.solve(
        factor, np.swapaxes(rows, 1, 2).transpose(1, 0, 2).reshape(len(total), -1)
    )
    half = half.reshape(len(total), len(rows), -1)
    grown = np.einsum("pnk,pnl->nkl", half, half) + np.eye(rows.shape[1])
    return np.linalg.slogdet(grown)[1]


def leave_one_out(
    groups: Iterable[Key], fit: Callable[[Sequence[Key]], Fitted],
    judge: Callable[[Fitted, Key], float],
) -> dict[Key, float]:  # fmt: skip
    """Errors of predictions of every group by a fit to all others.

    Args:
        groups: names of poses or groups of poses that are left out together.
        fit: of groups to what is fitted.
        judge: error of a fit on a group.

    Returns:
        Group -> error.

    >>> data = {"a": 1.0, "b": 2.0, "c": 6.0}
    >>> mean = lambda names: sum(data[name] for name in names) / len(names)
    >>> leave_one_out(data, mean, lambda fitted, name: abs(fitted - data[name]))
    {'a': 3.0, 'b': 1.5, 'c': 4.5}
    """
    named = list(groups)
    return {name: judge(fit([other for other in named if other != name]), name) for name in named}
