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
    candidates: Sequence[Sequence[str]], correlation: float = 0.3,
) -> Reduction:  # fmt: skip
    """Drop and merge candidates, one after the other.

    First the least significant candidate goes, until all that are left stand above the noise: a
    normal deviate that all candidates together exceed by chance with 5 % only. Then, among
    candidates of one kind, the two with the largest correlation of their estimates get a common
    parameter, until none is above the limit, as long as the residuals allow it.

    Args:
        matrix: (n, k, p) regressor of independent parameters.
        forces: (n, k) [N] or [N m].
        covariance: (k, k) of their errors.
        names: the p parameters.
        candidates: groups of names of one kind, within which parameters may be merged.
        correlation: magnitude above which two estimates count as strongly correlated.

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
    groups = [(name,) for name in names]
    columns = {name: matrix[:, :, k] for k, name in enumerate(names)}
    whitened = np.linalg.inv(np.linalg.cholesky(covariance))
    steps, first, separate = [], {}, set()

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

    value, spread, misfit, free = fit()
    note("start", tuple(names), 0.0, spread, misfit, free)
    while True:
        std = np.sqrt(np.diag(spread))
        ratio = np.abs(value) / std
        open_ = [k for k, g in enumerate(groups) if g[0] in kind]
        weakest = min(open_, key=lambda k: ratio[k], default=None)
        if weakest is None or ratio[weakest] >= significant:
            break
        gone, figure = groups.pop(weakest), float(ratio[weakest])
        value, spread, misfit, free = fit()
        note("drop", gone, figure, spread, misfit, free)
    while True:
        std = np.sqrt(np.diag(spread))
        pairs = [
            (abs(spread[a, b]) / (std[a] * std[b]), a, b)
            for a in range(len(groups))
            for b in range(a)
            if groups[a][0] in kind and kind[groups[a][0]] == kind.get(groups[b][0])
            and (groups[a], groups[b]) not in separate
        ]  # fmt: skip
        if not pairs or max(pairs)[0] < correlation:
            break
        figure, a, b = max(pairs)
        before, old = list(groups), misfit
        merged = groups[b] + groups[a]
        groups[b] = merged
        groups.pop(a)
        value, spread, misfit, free = fit()
        if misfit - old > significant**2:  # they differ by more than the noise
            separate.add((before[a], before[b]))
            groups = before
            value, spread, misfit, free = fit()
            continue
        note("merge", merged, float(figure), spread, misfit, free)
    return Reduction(tuple(steps), tuple(groups), value, np.sqrt(np.diag(spread)))
