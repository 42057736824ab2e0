"""Which parameters a regressor tells: each by itself, in combination with others, or not at all.

How large parameters are, to tell whether data say anything about them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.identify.setup import RegressorSetup
from hydrotele.multibody.inverse_dynamics import BODY_PARAMETERS, Regressor

UNIDENTIFIABLE, COMBINATION, FULL = "unidentifiable", "combination", "full"
WEAK = "weak"  # an effect below the noise
_NOTHING = 1e-11  # of the largest column of its kind: rounding
_RANK = 1e-8  # of the largest singular value of columns of length 1: the square root of rounding
_SHARE = 1e-5  # part of a parameter in the null space that puts it into a combination
_HALF = 0.5  # of its size, within which a parameter must be known to be worth saying
_SHIFT = 0.1  # standard deviations by which a parameter of its size must shift a combination
_COEFFICIENT = 1e-7  # below it a coefficient is rounding


@dataclass(frozen=True)
class Identifiability:
    """What a regressor tells; m parameters, rank r.

    Attributes:
        names: the m parameters.
        status: (m,) `unidentifiable`, `combination` or `full`; in noisy data also `weak`.
        base: (r,) places of the parameters that stand for the base parameters.
        combination: (r, m) base parameters as combinations of all parameters.
        condition: ratio of the largest to the smallest singular value of the base columns, each
            of length 1.
        gap: singular values on either side of the rank, over the largest; 0 without null space,
            and in noisy data.
    """

    names: tuple[str, ...]
    status: tuple[str, ...]
    base: np.ndarray
    combination: np.ndarray
    condition: float
    gap: tuple[float, float]

    @property
    def counts(self) -> dict[str, int]:
        """Status -> number of parameters; `weak` only where there are any."""
        known = (UNIDENTIFIABLE, COMBINATION, FULL, *([WEAK] if WEAK in self.status else []))
        return {s: self.status.count(s) for s in known}

    def text(self, base: int) -> str:
        """A base parameter written out, such as `inertia_zz.swing + 2.5 mass.boom`."""
        row = self.combination[base]
        parts = []
        for k in [self.base[base], *np.flatnonzero(row)]:
            if parts and k == self.base[base]:
                continue
            sign = "-" if row[k] < 0 else "+"
            size = "" if abs(abs(row[k]) - 1.0) < 1e-6 else f"{abs(row[k]):.6g} "
            parts.append(f"{sign} {size}{self.names[k]}")
        return " ".join(parts).removeprefix("+ ")


def identifiability(
    matrix: np.ndarray, names: Sequence[str], units: Sequence[str], first: Sequence[str] = ()
) -> Identifiability:
    """Classify parameters by the null space of a noise-free regressor.

    Args:
        matrix: (N, m) equations of a motion that excites whatever can be excited.
        names: the m parameters.
        units: (m,) theirs; columns are compared with others of the same unit only.
        first: parameters that shall stand for a base parameter if they can, in this order.

    Returns:
        The classification.

    Source: Khoshzaban 1992, 4.4.2 (null space); Gautier 1991, Numerical calculation of the base
    inertial parameters of robots (QR with pivots).
    """
    triangle = np.asarray(
        np.linalg.qr(matrix, mode="r") if len(matrix) > matrix.shape[1] else matrix
    )
    size = np.linalg.norm(triangle, axis=0)
    largest = {unit: max(size[k] for k, u in enumerate(units) if u == unit) for unit in units}
    there = np.array(
        [s > _NOTHING * max(largest[u], 1e-300) for s, u in zip(size, units, strict=True)]
    )
    scaled = triangle[:, there] / size[there]
    _, values, directions = np.linalg.svd(scaled, full_matrices=True)
    rank = int(np.sum(values > _RANK * values[0])) if len(values) else 0
    hidden = np.linalg.norm(directions[rank:], axis=0)
    status = np.full(len(names), UNIDENTIFIABLE, dtype=object)
    status[there] = np.where(hidden > _SHARE, COMBINATION, FULL)
    base, combination = _base(triangle, size, there, rank, [list(names).index(n) for n in first])
    kept = np.linalg.svd(triangle[:, base] / size[base], compute_uv=False) if rank else np.ones(1)
    gap = (
        (values[rank - 1] / values[0], values[rank] / values[0])
        if rank < len(values)
        else ((values[-1] / values[0] if rank else 0.0), 0.0)
    )
    return Identifiability(
        tuple(names), tuple(status), base, combination, float(kept[0] / kept[-1]),
        (float(gap[0]), float(gap[1])),
    )  # fmt: skip


def identifiable_in_noise(
    matrix: np.ndarray, names: Sequence[str], sizes: np.ndarray, asked: np.ndarray
) -> Identifiability:
    """What noisy data tell: parameters that they tell to better than half of their own sizes.

    Column by column, one is taken if its part that no earlier one explains stands above the noise;
    then the least known are given up, for each makes others known better. All other columns are
    combinations of those within the noise, and are named in them if they would shift them by a
    tenth of a standard deviation.

    Args:
        matrix: (N, m) equations over the standard deviation of their errors.
        names: the m parameters.
        sizes: (m,) their sizes.
        asked: (m,) whether a parameter may stand for a combination.

    Returns:
        The classification; `weak` is what shows by less than the noise, and stays as given.
    """
    whole = np.linalg.qr(matrix, mode="r") if len(matrix) > matrix.shape[1] else matrix
    scaled = np.asarray(whole) * (_HALF * sizes)
    length = np.linalg.norm(scaled, axis=0)
    base = _above_noise(scaled, length, asked)
    rows = scaled[:, base]
    inverse = np.linalg.pinv(rows)
    spread = np.linalg.norm(inverse, axis=1)
    weights = inverse @ scaled
    weights[:, base] = np.eye(len(base))
    weights[np.abs(weights) < _SHIFT * spread[:, None]] = 0.0
    weights[np.arange(len(base)), base] = 1.0
    shared = np.count_nonzero(weights, axis=1) > 1
    status = np.full(len(names), WEAK, dtype=object)
    status[length <= _NOTHING * max(length.max(initial=0.0), 1.0)] = UNIDENTIFIABLE
    status[np.any(weights != 0.0, axis=0)] = COMBINATION
    status[base[~shared]] = FULL
    combination = weights * sizes[base][:, None] / sizes
    columns = rows / length[base] if len(base) else np.ones((1, 1))
    return Identifiability(
        tuple(names), tuple(status), base, combination, float(np.linalg.cond(columns)), (0.0, 0.0)
    )


def _above_noise(scaled: np.ndarray, length: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Places of the columns that data tell, each to better than 1."""
    chosen: list[int] = []
    span = np.zeros((len(scaled), 0))
    for k in np.flatnonzero(asked & (length > 1.0)):
        rest = scaled[:, k] - span @ (span.T @ scaled[:, k])
        rest -= span @ (span.T @ rest)
        size = np.linalg.norm(rest)
        if size > max(1.0, np.sqrt(_RANK) * 1e-2 * length[k]):
            chosen.append(int(k))
            span = np.column_stack([span, rest / size])
    while chosen:
        spread = np.linalg.norm(np.linalg.pinv(scaled[:, chosen]), axis=1)
        if spread.max() <= 1.0:
            break
        chosen.pop(int(np.argmax(spread)))
    return np.array(chosen, int)


def _base(triangle, size, there, rank, first):
    """Places of independent columns, and all parameters' combinations in them."""
    order = [k for k in first if there[k]] + [k for k in np.flatnonzero(there) if k not in first]
    chosen: list[int] = []
    span = np.zeros((len(triangle), 0))
    for k in order:  # in the given order, so that the first of a combination stands for it
        if len(chosen) == rank:
            break
        column = triangle[:, k] / size[k]
        rest = column - span @ (span.T @ column)
        rest -= span @ (span.T @ rest)
        if np.linalg.norm(rest) > np.sqrt(_RANK) * 1e-2:
            chosen.append(k)
            span = np.column_stack([span, rest / np.linalg.norm(rest)])
    base = np.array(chosen, int)
    combination = np.zeros((len(base), triangle.shape[1]))
    q, r = np.linalg.qr(triangle[:, base] / size[base])
    for k in np.flatnonzero(there):
        if k in chosen:
            combination[chosen.index(int(k)), k] = 1.0
            continue
        row = np.linalg.solve(r, q.T @ triangle[:, k]) / size[base]
        weights = np.abs(row) * size[base] / size[k]
        combination[:, k] = np.where(weights > _COEFFICIENT, row, 0.0)
    return base, combination


_PART = 0.05  # of a drive's force that friction or an offset may be where none is given
_SPEED = 0.1  # m/s or rad/s, at which viscous friction may be as large
_LEVER = 0.1  # m: friction of a pin acts on its radius, that of a drive on a lever ten times longer


def reference_sizes(
    table: Regressor, setup: RegressorSetup, forces: np.ndarray, drives: Sequence[str] | None = None
) -> np.ndarray:
    """Sizes of all parameters.

    A body's are its given mass and radius of gyration; friction's are as given, and at least a
    share of its drive's force.

    Args:
        table: the parameters.
        setup: of the regressor.
        forces: (k,) RMS of drives' forces [N] or [N m].
        drives: names of these drives; the table's by default.

    Returns:
        (m,) positive, in the parameters' units.
    """
    chain = setup.chain
    names = table.drives if drives is None else drives
    known = {d: float(f) for d, f in zip(names, forces, strict=True)}
    usual = float(np.max(forces)) if len(forces) else 1.0
    sizes = []
    for name, given in zip(table.names, table.nominal, strict=True):
        kind, _, place = name.partition(".")
        if kind in BODY_PARAMETERS:
            sizes.append(_body_size(chain.inertia, chain.bodies.index(place), kind))
        elif kind == "drive_inertia":
            sizes.append(max(float(chain.armature[chain.index(place)]), usual))
        else:
            size = _PART * known.get(place, _LEVER * usual)
            sizes.append(max(abs(given), size / _SPEED if kind.startswith("viscous") else size))
    return np.maximum(sizes, 1e-12)


def _body_size(inertia: np.ndarray, body: int, kind: str) -> float:
    mass = inertia[body, 0] or inertia[:, 0].max()
    own = inertia[body] if inertia[body, 0] else inertia[int(np.argmax(inertia[:, 0]))]
    radius = np.sqrt((own[4] + own[7] + own[9]) / 2.0 / mass)
    return float(mass * radius ** {"mass": 0, "moment": 1, "inertia": 2}[kind.partition("_")[0]])
