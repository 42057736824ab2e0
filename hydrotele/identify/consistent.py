"""Physically consistent parameters: bodies that can exist, friction that takes energy.

The base parameters that data tell leave the others open. Here every body is the given one, deformed
by an affine map of space: whatever the map, its mass is positive and its inertia that of a mass
distribution. Of all such machines it takes the one that explains the data best and deforms the
given one least.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hydrotele.identify.result import Identification
from hydrotele.multibody.inverse_dynamics import BODY_PARAMETERS, FRICTION_TERMS

_USUAL = 0.3  # deformation that counts as one standard deviation: masses to 60 %, sizes to 30 %
_THIN = 1e-4  # of the largest second moment, that a body has at least in every direction
_CERTAIN = 1e-10  # of the largest variance, below which truncation has left none
_SIGNED = ("asymmetry",)  # friction that may have either sign


@dataclass(frozen=True)
class Consistent:
    """Result.

    Attributes:
        value: (m,) parameters of machines that can exist, in the identification's order.
        loss: squared distance of its base parameters from the estimate, in standard deviations;
            about their number where the estimate is consistent within its noise.
    """

    value: np.ndarray
    loss: float


@dataclass(frozen=True)
class Freedom:
    """How a body may differ from the given one.

    Attributes:
        shear: whether its principal axes may turn.
        axis: (3,) line along which its centre of mass may move; None for any way.
    """

    shear: bool = True
    axis: np.ndarray | None = None


def consistent(found: Identification, freedom: Mapping[str, Freedom] | None = None) -> Consistent:
    """The nearest machine that can exist.

    Args:
        found: the identification; its given bodies must have mass.
        freedom: body -> how it may differ; everything by default.

    Returns:
        The parameters.

    Source: Wensing, Kim and Slotine 2018, Linear matrix inequalities for physically consistent
    inertial parameter identification (pseudo-inertia); Rucker and Wensing 2022, Smooth
    parameterization of rigid-body inertia.
    """
    freedom = freedom or {}
    bodies = [n.partition(".")[2] for n in found.names if n.startswith("mass.")]
    pieces = [_Body(found, body, freedom.get(body, Freedom())) for body in bodies]
    taken = {k for piece in pieces for k in piece.places}
    others = np.array([k for k in range(len(found.names)) if k not in taken], int)
    std = found.estimate.std
    variances, ways = np.linalg.eigh(
        found.estimate.covariance / np.outer(*[found.estimate.std] * 2)
    )
    whiten = (ways / np.sqrt(np.maximum(variances, _CERTAIN * variances[-1]))).T
    whiten = whiten / std
    base, wanted = whiten @ found.told.combination, whiten @ found.estimate.value
    sizes = _sizes(found, others)
    counts = [piece.size for piece in pieces]
    ends = np.cumsum([0, *counts])

    def value_of(x: np.ndarray) -> np.ndarray:
        value = found.nominal.copy()
        for piece, a, b in zip(pieces, ends, ends[1:], strict=False):
            value[piece.places] = piece.parameters(x[a:b])
        value[others] = found.nominal[others] + sizes * x[ends[-1] :]
        return value

    def misfit(x: np.ndarray) -> np.ndarray:
        away = base @ value_of(x) - wanted
        return np.concatenate([away, x[: ends[-1]] / _USUAL, 1e-3 * x[ends[-1] :]])

    low = np.full(ends[-1] + len(others), -np.inf)
    for i, k in enumerate(others):
        kind = found.names[k].partition(".")[0]
        if kind in FRICTION_TERMS and not kind.endswith(_SIGNED):
            low[ends[-1] + i] = -found.nominal[k] / sizes[i]
    start = np.zeros(len(low))
    start[ends[-1] :] = np.maximum(
        (found.value[others] - found.nominal[others]) / sizes, low[ends[-1] :]
    )
    solved = least_squares(misfit, start, bounds=(low - 1e-9, np.inf))
    value = value_of(np.maximum(solved.x, low))
    return Consistent(value, float(np.sum((base @ value - wanted) ** 2)))


class _Body:
    """A body and the maps that deform it: stretches, mass, shift, shear."""

    def __init__(self, found: Identification, body: str, freedom: Freedom):
        self.places = np.array([found.names.index(f"{kind}.{body}") for kind in BODY_PARAMETERS])
        self.given = _thick(_pseudo_inertia(found.nominal[self.places]))
        if freedom.axis is not None:
            self.shifts = np.asarray(freedom.axis, float)[None]
        else:
            self.shifts = np.eye(3)
        self.shear = freedom.shear
        self.scale = np.sqrt(np.trace(self.given[:3, :3]) / self.given[3, 3])
        self.size = 4 + len(self.shifts) + (3 if freedom.shear else 0)

    def parameters(self, x: np.ndarray) -> np.ndarray:
        """(10,) inertial parameters."""
        shift = self.scale * x[4 : 4 + len(self.shifts)] @ self.shifts
        deform = np.diag(np.exp(x[:4]))
        deform[:3, 3] = shift
        if self.shear:
            deform[0, 1], deform[0, 2], deform[1, 2] = x[-3:]
        return _parameters(deform @ self.given @ deform.T)


def _pseudo_inertia(p: np.ndarray) -> np.ndarray:
    """(4, 4) second moments, first moments and mass of a body (10,)."""
    inertia = np.array([[p[4], p[5], p[6]], [p[5], p[7], p[8]], [p[6], p[8], p[9]]])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = p[1:4]
    out[3, 3] = p[0]
    return out


def _parameters(pseudo: np.ndarray) -> np.ndarray:
    """(10,) inertial parameters of a pseudo-inertia (4, 4)."""
    second = pseudo[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate([[pseudo[3, 3]], pseudo[:3, 3], inertia[np.triu_indices(3)]])


def _thick(pseudo: np.ndarray) -> np.ndarray:
    """A body with some extent in every direction: a rod without any cannot be stretched."""
    central = pseudo[:3, :3] - np.outer(pseudo[:3, 3], pseudo[:3, 3]) / pseudo[3, 3]
    least = _THIN * max(float(np.trace(central)), 1e-12)
    values, axes = np.linalg.eigh(central)
    out = pseudo.copy()
    out[:3, :3] += axes @ np.diag(np.maximum(values, least) - values) @ axes.T
    return out


def _sizes(found: Identification, others: np.ndarray) -> np.ndarray:
    """Sizes (o,) by which parameters that belong to no body are counted."""
    spread = {k: s for k, s in zip(found.told.base, found.estimate.std, strict=True)}
    return np.array(
        [max(abs(found.nominal[k]), abs(found.value[k]), spread.get(k, 0.0), 1e-9) for k in others]
    )
