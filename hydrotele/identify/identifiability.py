"""Classification of parameters as identifiable, identifiable in combination, or not identifiable.

`classify_parameters` uses the null space of a noise-free regressor, `classify_noisy_parameters` the
accuracy that noisy equations allow. `reference_sizes` gives the magnitude of each parameter, with
which its standard deviation is compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hydrotele.identify.regressor_setup import RegressorSetup
from hydrotele.multibody.regressor import BODY_PARAMETERS, Regressor, is_friction_deviation

STATUS_UNIDENTIFIABLE, STATUS_COMBINATION, STATUS_FULL = "unidentifiable", "combination", "full"
STATUS_WEAK = "weak"  # influence below the noise
_COLUMN_TOLERANCE = 1e-11  # of the largest column with the same unit: rounding
_RANK_TOLERANCE = 1e-8  # of the largest singular value of normalised columns: square root of rounding
_MIN_NULL_SPACE_COMPONENT = 1e-5  # null space component from which a parameter belongs to a combination
_MAX_STD_OVER_SIZE = 0.5  # of its reference size: largest standard deviation of an identifiable parameter
_MIN_SHIFT_STD = 0.1  # standard deviations: smallest shift for which a parameter is named in a combination
_COEFFICIENT_TOLERANCE = 1e-7  # smaller coefficients are rounding


@dataclass(frozen=True)
class Identifiability:
    """Identifiability of m parameters of a regressor of rank r.

    Attributes:
        names: names of the m parameters.
        status: (m,) `full` if the data determine the parameter alone, `combination` if only together with
            others, `unidentifiable` if it has no effect, `weak` if its effect is below the noise.
        base: (r,) indices of the parameters that represent the base parameters.
        combination: (r, m) base parameters as linear combinations of all parameters.
        condition: condition number of the normalised base columns.
        singular_value_gap: last singular value within the rank and the next one, over the largest; 0 without null
            space and for noisy data.
    """

    names: tuple[str, ...]
    status: tuple[str, ...]
    base: np.ndarray
    combination: np.ndarray
    condition: float
    singular_value_gap: tuple[float, float]

    @property
    def status_counts(self) -> dict[str, int]:
        """Number of parameters per status; `weak` only if there are any."""
        known = (
            STATUS_UNIDENTIFIABLE,
            STATUS_COMBINATION,
            STATUS_FULL,
            *([STATUS_WEAK] if STATUS_WEAK in self.status else []),
        )
        return {s: self.status.count(s) for s in known}

    def format_combination(self, base: int) -> str:
        """Return a base parameter, with its row number in `combination`, as text.

        An example is `inertia_zz.swing + 2.5 mass.boom`.
        """
        row = self.combination[base]
        parts = []
        for k in [self.base[base], *np.flatnonzero(row)]:
            if parts and k == self.base[base]:
                continue
            sign = "-" if row[k] < 0 else "+"
            size = "" if abs(abs(row[k]) - 1.0) < 1e-6 else f"{abs(row[k]):.6g} "
            parts.append(f"{sign} {size}{self.names[k]}")
        return " ".join(parts).removeprefix("+ ")


def classify_parameters(
    matrix: np.ndarray, names: Sequence[str], units: Sequence[str], preferred: Sequence[str] = ()
) -> Identifiability:
    """Classify parameters by the null space of a noise-free regressor.

    Args:
        matrix: (N, m) equations of a motion that excites all parameters that can be excited.
        names: names of the m parameters.
        units: (m,) their units; columns are compared only with columns of the same unit.
        preferred: parameters that preferably represent a base parameter, in this order.

    Returns:
        The classification.

    Source: Khoshzaban 1992, 4.4.2 (null space); Gautier 1991, Numerical calculation of the base
    inertial parameters of robots (QR with pivots).
    """
    triangle = np.asarray(np.linalg.qr(matrix, mode="r") if len(matrix) > matrix.shape[1] else matrix)
    size = np.linalg.norm(triangle, axis=0)
    largest = {unit: max(size[k] for k, u in enumerate(units) if u == unit) for unit in units}
    there = np.array([s > _COLUMN_TOLERANCE * max(largest[u], 1e-300) for s, u in zip(size, units, strict=True)])
    scaled = triangle[:, there] / size[there]
    _, values, directions = np.linalg.svd(scaled, full_matrices=True)
    rank = int(np.sum(values > _RANK_TOLERANCE * values[0])) if len(values) else 0
    hidden = np.linalg.norm(directions[rank:], axis=0)
    status = np.full(len(names), STATUS_UNIDENTIFIABLE, dtype=object)
    status[there] = np.where(hidden > _MIN_NULL_SPACE_COMPONENT, STATUS_COMBINATION, STATUS_FULL)
    base, combination = _select_base(triangle, size, there, rank, [list(names).index(n) for n in preferred])
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


def classify_noisy_parameters(
    matrix: np.ndarray, names: Sequence[str], sizes: np.ndarray, candidates: np.ndarray
) -> Identifiability:
    """Classify parameters by the accuracy with which noisy equations determine them.

    A base parameter has a standard deviation of at most half its reference size. A column of the
    matrix is selected if its component orthogonal to the selected columns exceeds the noise. Then the
    least accurate selected columns are removed one by one, which improves the others, until all are
    accurate enough. Each other column is, within the noise, a combination of the selected ones. It
    is named in a base parameter that it would shift by at least a tenth of a standard deviation.

    Args:
        matrix: (N, m) equations divided by the standard deviation of their errors.
        names: names of the m parameters.
        sizes: (m,) reference sizes.
        candidates: (m,) whether a parameter may represent a base parameter.

    Returns:
        The classification; `weak` parameters have an influence below the noise and keep their given
        values.
    """
    whole = np.linalg.qr(matrix, mode="r") if len(matrix) > matrix.shape[1] else matrix
    scaled = np.asarray(whole) * (_MAX_STD_OVER_SIZE * sizes)
    length = np.linalg.norm(scaled, axis=0)
    base = _select_columns_above_noise(scaled, length, candidates)
    rows = scaled[:, base]
    inverse = np.linalg.pinv(rows)
    spread = np.linalg.norm(inverse, axis=1)
    weights = inverse @ scaled
    weights[:, base] = np.eye(len(base))
    weights[np.abs(weights) < _MIN_SHIFT_STD * spread[:, None]] = 0.0
    weights[np.arange(len(base)), base] = 1.0
    shared = np.count_nonzero(weights, axis=1) > 1
    status = np.full(len(names), STATUS_WEAK, dtype=object)
    status[length <= _COLUMN_TOLERANCE * max(length.max(initial=0.0), 1.0)] = STATUS_UNIDENTIFIABLE
    status[np.any(weights != 0.0, axis=0)] = STATUS_COMBINATION
    status[base[~shared]] = STATUS_FULL
    combination = weights * sizes[base][:, None] / sizes
    columns = rows / length[base] if len(base) else np.ones((1, 1))
    return Identifiability(tuple(names), tuple(status), base, combination, float(np.linalg.cond(columns)), (0.0, 0.0))


def _select_columns_above_noise(scaled: np.ndarray, length: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Return the indices of selected candidate columns, whose parameters have standard deviations <= 1.

    Columns are scaled such that 1 is the accuracy required; `length` are their norms (m,). Columns are
    selected in order if their component orthogonal to the selected ones exceeds 1. Then the least
    accurate ones are removed one by one.
    """
    chosen: list[int] = []
    span = np.zeros((len(scaled), 0))
    for k in np.flatnonzero(candidates & (length > 1.0)):
        rest = scaled[:, k] - span @ (span.T @ scaled[:, k])
        rest -= span @ (span.T @ rest)
        size = np.linalg.norm(rest)
        if size > max(1.0, np.sqrt(_RANK_TOLERANCE) * 1e-2 * length[k]):
            chosen.append(int(k))
            span = np.column_stack([span, rest / size])
    while chosen:
        spread = np.linalg.norm(np.linalg.pinv(scaled[:, chosen]), axis=1)
        if spread.max() <= 1.0:
            break
        chosen.pop(int(np.argmax(spread)))
    return np.array(chosen, int)


def _select_base(triangle, size, nonzero, rank, preferred):
    """Select `rank` independent columns, preferred ones first, to represent the base parameters.

    Returns:
        (indices (r,) of the columns, combinations (r, m) of all parameters that they represent).
    """
    order = [k for k in preferred if nonzero[k]] + [k for k in np.flatnonzero(nonzero) if k not in preferred]
    chosen: list[int] = []
    span = np.zeros((len(triangle), 0))
    for k in order:  # the first parameter of a combination represents it
        if len(chosen) == rank:
            break
        column = triangle[:, k] / size[k]
        rest = column - span @ (span.T @ column)
        rest -= span @ (span.T @ rest)
        if np.linalg.norm(rest) > np.sqrt(_RANK_TOLERANCE) * 1e-2:
            chosen.append(k)
            span = np.column_stack([span, rest / np.linalg.norm(rest)])
    base = np.array(chosen, int)
    combination = np.zeros((len(base), triangle.shape[1]))
    q, r = np.linalg.qr(triangle[:, base] / size[base])
    for k in np.flatnonzero(nonzero):
        if k in chosen:
            combination[chosen.index(int(k)), k] = 1.0
            continue
        row = np.linalg.solve(r, q.T @ triangle[:, k]) / size[base]
        weights = np.abs(row) * size[base] / size[k]
        combination[:, k] = np.where(weights > _COEFFICIENT_TOLERANCE, row, 0.0)
    return base, combination


_DEFAULT_FORCE_FRACTION = 0.05  # of a drive's force: size of friction and offsets that are not given
_REFERENCE_SPEED = 0.1  # m/s or rad/s, speed at which viscous friction has that size
_PIN_LEVER_ARM_M = 0.1  # m: friction of a pin acts at its radius, a tenth of the lever arm of a drive


def reference_sizes(
    table: Regressor, setup: RegressorSetup, forces: np.ndarray, drives: Sequence[str] | None = None
) -> np.ndarray:
    """Return a typical magnitude of each parameter, with which its standard deviation is compared.

    Sizes of a body follow from its given mass and radius of gyration. Sizes of friction and offsets are
    the given values, at least 5 % of the drive force; for viscous friction that is the force at 0.1 m/s
    or rad/s. Deviations of friction near zero speed have the size of the drive force, so that they are
    left out only if nothing is known of them.

    Args:
        table: the parameters.
        setup: definition of the regressor.
        forces: (k,) RMS drive forces [N] or [N m].
        drives: names of these drives; those of the table by default.

    Returns:
        (m,) positive sizes in the units of the parameters.
    """
    chain = setup.chain
    names = table.drives if drives is None else drives
    known = {d: float(f) for d, f in zip(names, forces, strict=True)}
    usual = float(np.max(forces)) if len(forces) else 1.0
    sizes = []
    for name, given in zip(table.names, table.nominal, strict=True):
        kind, _, place = name.partition(".")
        if kind in BODY_PARAMETERS:
            sizes.append(_body_parameter_size(chain.inertia, chain.bodies.index(place), kind))
        elif kind == "drive_inertia":
            sizes.append(max(float(chain.armature[chain.index(place)]), usual))
        else:
            part = 1.0 if is_friction_deviation(name) else _DEFAULT_FORCE_FRACTION
            size = part * known.get(place, _PIN_LEVER_ARM_M * usual)
            sizes.append(max(abs(given), size / _REFERENCE_SPEED if kind.startswith("viscous") else size))
    return np.maximum(sizes, 1e-12)


def _body_parameter_size(inertia: np.ndarray, body: int, kind: str) -> float:
    mass = inertia[body, 0] or inertia[:, 0].max()
    own = inertia[body] if inertia[body, 0] else inertia[int(np.argmax(inertia[:, 0]))]
    radius = np.sqrt((own[4] + own[7] + own[9]) / 2.0 / mass)
    return float(mass * radius ** {"mass": 0, "moment": 1, "inertia": 2}[kind.partition("_")[0]])
