"""Fewer friction parameters: those below the noise are dropped, correlated ones are merged.

Every passive joint of a closed chain may have friction of its own. Measurements tell it badly, and
what they do not tell makes all other estimates worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from hydrotele.core.errors import InputError
from hydrotele.identify.estimation import estimate

_FALSE = 0.05  # chance that any one of all candidates without effect is kept
_WHERE = "reduction"


@dataclass(frozen=True)
class Step:
    """One step of a reduction.

    Attributes:
        action: `start`, `drop` or `merge`.
        names: what is dropped or merged.
        figure: of `drop`: estimate over its standard deviation; of `merge`: the correlation of two
            estimates; of `start`: 0.
        parameters: that are left.
        largest_std: largest ratio of a standard deviation to that of the first step, among
            parameters that are no candidates.
        misfit: weighted squared residuals over the degrees of freedom.
    """

    action: str
    names: tuple[str, ...]
    figure: float
    parameters: int
    largest_std: float
    misfit: float


@dataclass(frozen=True)
class Reduction:
    """Result of a reduction.

    Attributes:
        steps: the first is the whole model.
        groups: names that share a parameter, for every parameter that is left.
        value: (p,) estimates of these.
        std: (p,) standard deviations.
    """

    steps: tuple[Step, ...]
    groups: tuple[tuple[str, ...], ...]
    value: np.ndarray
    std: np.ndarray


def reduce_parameters(
    matrix: np.ndarray, forces: np.ndarray, covariance: np.ndarray, names: Sequence[str],
    candidates: Sequence[Sequence[str]],
) -> Reduction:  # fmt: skip
    """Drop and merge candidates, one after the other.

    The least significant candidate goes first, until all that are left stand above the noise: a
    normal deviate that all candidates together exceed by chance with 5 % only. Among
    candidates of one kind, the two whose estimates correlate most get a common parameter, unless
    the residuals say by the same deviate that they differ. What is then below the noise goes, too.

    Args:
        matrix: (n, k, p) regressor of independent parameters.
        forces: (n, k) [N] or [N m].
        covariance: (k, k) of their errors.
        names: the p parameters.
        candidates: groups of names of one kind, within which parameters may be merged.

    Returns:
        The reduction, with all its steps.

    Raises:
        InputError: a candidate is no parameter.

    Source: Abdellatif 2008, section 2.2.
    """
    kind = {name: k for k, group in enumerate(candidates) for name in group}
    if strange := [name for name in kind if name not in names]:
        raise InputError(_WHERE, f"{strange[0]} is no parameter: {', '.join(names)}")
    significant = float(norm.isf(0.5 * _FALSE / max(len(kind), 1)))
    groups: list[tuple[str, ...]] = [(name,) for name in names]
    columns = {name: matrix[:, :, k] for k, name in enumerate(names)}
    whitened = np.linalg.inv(np.linalg.cholesky(covariance))
    steps: list[Step] = []
    first: dict[tuple[str, ...], float] = {}
    separate: set[tuple[tuple[str, ...], tuple[str, ...]]] = set()

    def fit():
        stacked = np.stack([sum(columns[n] for n in group) for group in groups], axis=2)
        # the covariance is known, so that no residual scales it
        found = estimate(stacked, forces, covariance, order=0)
        normal = np.einsum("nkp,kl,nlq->pq", stacked, whitened.T @ whitened, stacked, optimize=True)
        spread = np.linalg.inv(normal)
        error = found.residual @ whitened.T
        return found.value, spread, float(np.sum(error**2)), error.size - len(groups)

    def note(action, which, figure, spread, misfit, free):
        std = dict(zip(groups, np.sqrt(np.diag(spread)), strict=True))
        if not first:
            first.update(std)
        wide = max((s / first[g] for g, s in std.items() if g[0] not in kind), default=1.0)
        steps.append(Step(action, which, figure, len(groups), float(wide), misfit / free))

    def drop(now):
        while True:
            ratio = np.abs(now[0]) / np.sqrt(np.diag(now[1]))
            open_ = [k for k, g in enumerate(groups) if g[0] in kind]
            weakest = min(open_, key=lambda k: ratio[k], default=None)
            if weakest is None or ratio[weakest] >= significant:
                return now
            gone, figure = groups.pop(weakest), float(ratio[weakest])
            now = fit()
            note("drop", gone, figure, *now[1:])

    def merge(now):
        while True:
            std = np.sqrt(np.diag(now[1]))
            pairs = [
                (abs(now[1][a, b]) / (std[a] * std[b]), a, b)
                for a, one in enumerate(groups)
                for b, other in enumerate(groups[:a])
                if one[0] in kind and kind[one[0]] == kind.get(other[0])
                and (one, other) not in separate
            ]  # fmt: skip
            if not pairs:
                return now
            figure, a, b = max(pairs)
            before, old = list(groups), now
            groups[b] = groups[b] + groups[a]
            merged = groups[b]
            groups.pop(a)
            now = fit()
            if now[2] - old[2] > significant**2:  # they differ by more than the noise
                separate.add((before[a], before[b]))
                groups[:], now = before, old
                continue
            note("merge", merged, float(figure), *now[1:])

    now = fit()
    note("start", tuple(names), 0.0, *now[1:])
    now = drop(merge(drop(now)))
    return Reduction(tuple(steps), tuple(groups), now[0], np.sqrt(np.diag(now[1])))
