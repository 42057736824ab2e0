"""Physically consistent inertial and friction parameters that fit an identification best.

The identified base parameters do not determine all parameters. Every body is an affine deformation of
the given body, so that its mass is positive and its inertia belongs to a mass distribution. Friction
dissipates energy. The selected parameters have the best fit with the smallest deformation.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hydrotele.identify.result import Identification
from hydrotele.multibody.regressor import BODY_PARAMETERS, FRICTION_TERMS

_DEFORMATION_STD = 0.3  # standard deviation of a deformation: masses to 60 %, dimensions to 30 %
_MIN_SECOND_MOMENT_RATIO = 1e-4  # of the trace of the second moments: smallest second moment of a body
_MIN_VARIANCE_RATIO = 1e-10  # of the largest variance: smaller variances come from truncation
_SIGNED_FRICTION_SUFFIXES = ("asymmetry",)  # friction that may have either sign


@dataclass(frozen=True)
class ConsistentParameters:
    """Inertial and friction parameters that are physically consistent (positive masses, dissipation).

    Attributes:
        value: (m,) parameters in the order of `Identification.names`.
        squared_distance: squared Mahalanobis distance of their base parameters from the estimate. It is about
            the number of base parameters if the estimate is consistent within its noise.
    """

    value: np.ndarray
    squared_distance: float


@dataclass(frozen=True)
class AllowedDeformation:
    """Allowed changes of a body's mass distribution relative to the given one.

    Attributes:
        can_rotate_axes: whether the principal axes may rotate.
        shift_direction: (3,) direction along which the centre of mass may move; None for all directions.
    """

    can_rotate_axes: bool = True
    shift_direction: np.ndarray | None = None


def find_consistent_parameters(
    found: Identification, deformations: Mapping[str, AllowedDeformation] | None = None
) -> ConsistentParameters:
    """Find the physically consistent parameters that fit an identification best.

    Masses are positive, inertias belong to a mass distribution, and friction dissipates energy. The
    parameters minimise the squared Mahalanobis distance of their base parameters from the estimate,
    plus squared deformations of the bodies over a standard deviation of 0.3.

    Args:
        found: the identification; its given bodies must have mass.
        deformations: body -> allowed deformation of its given mass distribution; unrestricted by
            default.

    Returns:
        The parameters.

    Source: Wensing, Kim and Slotine 2018, Linear matrix inequalities for physically consistent
    inertial parameter identification (pseudo-inertia); Rucker and Wensing 2022, Smooth
    parameterization of rigid-body inertia.
    """
    deformations = deformations or {}
    bodies = [n.partition(".")[2] for n in found.names if n.startswith("mass.")]
    pieces = [_DeformableBody(found, body, deformations.get(body, AllowedDeformation())) for body in bodies]
    taken = {k for piece in pieces for k in piece.places}
    others = np.array([k for k in range(len(found.names)) if k not in taken], int)
    std = found.estimate.std
    variances, ways = np.linalg.eigh(found.estimate.covariance / np.outer(*[found.estimate.std] * 2))
    whiten = (ways / np.sqrt(np.maximum(variances, _MIN_VARIANCE_RATIO * variances[-1]))).T
    whiten = whiten / std
    base, wanted = whiten @ found.data_identifiability.combination, whiten @ found.estimate.value
    sizes = _parameter_scales(found, others)
    counts = [piece.variable_count for piece in pieces]
    ends = np.cumsum([0, *counts])

    def deformed_parameters(x: np.ndarray) -> np.ndarray:
        value = found.nominal.copy()
        for piece, a, b in zip(pieces, ends, ends[1:], strict=False):
            value[piece.places] = piece.inertial_parameters(x[a:b])
        value[others] = found.nominal[others] + sizes * x[ends[-1] :]
        return value

    def misfit(x: np.ndarray) -> np.ndarray:
        away = base @ deformed_parameters(x) - wanted
        return np.concatenate([away, x[: ends[-1]] / _DEFORMATION_STD, 1e-3 * x[ends[-1] :]])

    low = np.full(ends[-1] + len(others), -np.inf)
    for i, k in enumerate(others):
        kind = found.names[k].partition(".")[0]
        if kind in FRICTION_TERMS and not kind.endswith(_SIGNED_FRICTION_SUFFIXES):
            low[ends[-1] + i] = -found.nominal[k] / sizes[i]
    start = np.zeros(len(low))
    start[ends[-1] :] = np.maximum((found.value[others] - found.nominal[others]) / sizes, low[ends[-1] :])
    solved = least_squares(misfit, start, bounds=(low - 1e-9, np.inf))
    value = deformed_parameters(np.maximum(solved.x, low))
    return ConsistentParameters(value, float(np.sum((base @ value - wanted) ** 2)))


class _DeformableBody:
    """A body with its affine deformations: scaling, mass, shift of the centre of mass, shear."""

    def __init__(self, found: Identification, body: str, freedom: AllowedDeformation):
        self.places = np.array([found.names.index(f"{kind}.{body}") for kind in BODY_PARAMETERS])
        self.nominal_pseudo_inertia = _add_min_extent(_to_pseudo_inertia(found.nominal[self.places]))
        if freedom.shift_direction is not None:
            self.shift_directions = np.asarray(freedom.shift_direction, float)[None]
        else:
            self.shift_directions = np.eye(3)
        self.shear = freedom.can_rotate_axes
        self.scale = np.sqrt(np.trace(self.nominal_pseudo_inertia[:3, :3]) / self.nominal_pseudo_inertia[3, 3])
        self.variable_count = 4 + len(self.shift_directions) + (3 if freedom.can_rotate_axes else 0)

    def inertial_parameters(self, x: np.ndarray) -> np.ndarray:
        """Return mass, first moments and inertia (10,) of the body deformed by the variables x.

        x holds the logarithms of four scales (three axes and the root of the mass), the shift of the
        centre of mass over the RMS distance of the given mass from the frame's origin, and three
        shears if the principal axes may rotate.
        """
        shift = self.scale * x[4 : 4 + len(self.shift_directions)] @ self.shift_directions
        deform = np.diag(np.exp(x[:4]))
        deform[:3, 3] = shift
        if self.shear:
            deform[0, 1], deform[0, 2], deform[1, 2] = x[-3:]
        return _from_pseudo_inertia(deform @ self.nominal_pseudo_inertia @ deform.T)


def _to_pseudo_inertia(p: np.ndarray) -> np.ndarray:
    """Convert inertial parameters (10,) (mass, first moments, inertia) to the pseudo-inertia (4, 4).

    This matrix holds second moments, first moments and mass; it is positive definite for any real body.
    """
    inertia = np.array([[p[4], p[5], p[6]], [p[5], p[7], p[8]], [p[6], p[8], p[9]]])
    out = np.empty((4, 4))
    out[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    out[:3, 3] = out[3, :3] = p[1:4]
    out[3, 3] = p[0]
    return out


def _from_pseudo_inertia(pseudo: np.ndarray) -> np.ndarray:
    """Convert a pseudo-inertia (4, 4) to mass, first moments and inertia matrix elements (10,)."""
    second = pseudo[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate([[pseudo[3, 3]], pseudo[:3, 3], inertia[np.triu_indices(3)]])


def _add_min_extent(pseudo: np.ndarray) -> np.ndarray:
    """Return a pseudo-inertia (4, 4) with some extent in every direction, so that it can be scaled.

    Principal second moments about the centre of mass become at least 1e-4 of their sum.
    """
    central = pseudo[:3, :3] - np.outer(pseudo[:3, 3], pseudo[:3, 3]) / pseudo[3, 3]
    least = _MIN_SECOND_MOMENT_RATIO * max(float(np.trace(central)), 1e-12)
    values, axes = np.linalg.eigh(central)
    out = pseudo.copy()
    out[:3, :3] += axes @ np.diag(np.maximum(values, least) - values) @ axes.T
    return out


def _parameter_scales(found: Identification, others: np.ndarray) -> np.ndarray:
    """Return typical magnitudes (o,) of the parameters at indices `others` (o,), which are not of a body.

    Each is the largest of given value, identified value (magnitudes), standard deviation and 1e-9.
    """
    spread = {k: s for k, s in zip(found.data_identifiability.base, found.estimate.std, strict=True)}
    return np.array([max(abs(found.nominal[k]), abs(found.value[k]), spread.get(k, 0.0), 1e-9) for k in others])
