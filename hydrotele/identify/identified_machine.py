"""Machine with identified parameters, and the document `identify.json`.

The identified base parameters do not determine all parameters. `find_consistent_parameters` selects physically
consistent ones. Every body is an affine deformation of the given body, so that its mass is positive
and its inertia belongs to a mass distribution. Friction dissipates energy. The selected machine has
the best fit with the smallest deformation. `build_identified_machine` writes the parameters to a
`Machine`; `build_identify_document` writes an identification as JSON data.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from hydrotele.effects.effect import with_value
from hydrotele.identify.hydraulic import HydraulicIdentification
from hydrotele.identify.result import STATUS_WEAK, Identification, count_statuses, parameter_rows
from hydrotele.machine.machine import Machine, SensorError
from hydrotele.multibody.inverse_dynamics import BODY_PARAMETERS, FRICTION_TERMS

_DEFORMATION_STD = 0.3  # standard deviation of a deformation: masses to 60 %, dimensions to 30 %
_MIN_SECOND_MOMENT_RATIO = 1e-4  # of the trace of the second moments: smallest second moment of a body
_MIN_VARIANCE_RATIO = 1e-10  # of the largest variance: smaller variances come from truncation
_SIGNED_FRICTION_SUFFIXES = ("asymmetry",)  # friction that may have either sign


@dataclass(frozen=True)
class ConsistentParameters:
    """Physically consistent parameters.

    Attributes:
        value: (m,) parameters in the order of the identification.
        squared_distance: squared Mahalanobis distance of their base parameters from the estimate. It is about
            the number of base parameters if the estimate is consistent within its noise.
    """

    value: np.ndarray
    squared_distance: float


@dataclass(frozen=True)
class AllowedDeformation:
    """Allowed deformation of a body.

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

    Masses are positive, inertias belong to a mass distribution, and friction dissipates energy.

    Args:
        found: the identification; its given bodies must have mass.
        deformations: body -> allowed deformation; unrestricted by default.

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
        """Return mass, moments and inertia (10,) of the body deformed by the variables x.

        x holds the logarithms of four scales, the shift of the centre of mass and, if allowed, shear.
        """
        shift = self.scale * x[4 : 4 + len(self.shift_directions)] @ self.shift_directions
        deform = np.diag(np.exp(x[:4]))
        deform[:3, 3] = shift
        if self.shear:
            deform[0, 1], deform[0, 2], deform[1, 2] = x[-3:]
        return _from_pseudo_inertia(deform @ self.nominal_pseudo_inertia @ deform.T)


def _to_pseudo_inertia(p: np.ndarray) -> np.ndarray:
    """Convert inertial parameters (10,) to the pseudo-inertia (4, 4).

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
    """Return a pseudo-inertia with some extent in every direction, so that it can be scaled."""
    central = pseudo[:3, :3] - np.outer(pseudo[:3, 3], pseudo[:3, 3]) / pseudo[3, 3]
    least = _MIN_SECOND_MOMENT_RATIO * max(float(np.trace(central)), 1e-12)
    values, axes = np.linalg.eigh(central)
    out = pseudo.copy()
    out[:3, :3] += axes @ np.diag(np.maximum(values, least) - values) @ axes.T
    return out


def _parameter_scales(found: Identification, others: np.ndarray) -> np.ndarray:
    """Return typical magnitudes (o,) of the parameters at indices `others` (o,), which are not of a body."""
    spread = {k: s for k, s in zip(found.data_identifiability.base, found.estimate.std, strict=True)}
    return np.array([max(abs(found.nominal[k]), abs(found.value[k]), spread.get(k, 0.0), 1e-9) for k in others])


_MIN_OFFSET_CHANGE_STD = 2.0  # standard deviations: smallest change of an offset that is written
_FRICTION_FIELDS = {"coulomb": "coulomb", "stribeck": "stribeck_extra", "viscous": "viscous"}


def build_identified_machine(
    machine: Machine, found: Identification, bars: dict[str, tuple[str, str]]
) -> tuple[Machine, ConsistentParameters]:
    """Return a machine with identified masses, inertias, friction and force offsets.

    Links of a `Machine` have principal axes parallel to their frames, and tubes and rods have their
    centre of mass on their axis. The result is the machine of this form with the best fit.

    Args:
        machine: the given machine.
        found: its identification.
        bars: body of a tube or rod -> (axis, `tube` or `rod`).

    Returns:
        The machine, and its consistent parameters with their distance from the estimate.
    """
    freedom = {}
    for name in found.names:
        kind, _, body = name.partition(".")
        if kind == "mass":
            freedom[body] = AllowedDeformation(
                can_rotate_axes=False,
                shift_direction=_bar_axis(found, body) if body in bars else None,
            )
    best = find_consistent_parameters(found, freedom)
    numbers = dict(zip(found.names, best.value, strict=True))
    for body in freedom:
        machine = _replace_body_inertia(machine, body, numbers, bars.get(body))
    for axis, facts in machine.axes.items():
        place = _friction_joint(found, facts.joint, axis)
        if place is None:
            continue
        drive = f"axes.{axis}.{'cylinder' if facts.cylinder else 'motor' if facts.motor else 'force'}"
        machine = _replace_friction(machine, f"{drive}.friction", place, numbers)
        machine = _replace_force_offset(machine, axis, place, found, numbers)
    return machine, best


def _bar_axis(found: Identification, body: str) -> np.ndarray:
    """Return the direction of a bar's centre of mass in its frame, a unit vector (3,)."""
    places = [found.names.index(f"moment_{c}.{body}") for c in "xyz"]
    moment = found.nominal[places]
    size = np.linalg.norm(moment)
    return moment / size if size else np.array([1.0, 0.0, 0.0])


def _friction_joint(found: Identification, joint: str, axis: str) -> str | None:
    """Return the location in the parameter names of an axis' friction: `AXIS_rod` or its joint, or None."""
    for place in (f"{axis}_rod", joint):
        if f"coulomb.{place}" in found.names:
            return place
    return None


def _replace_body_inertia(machine: Machine, body: str, numbers: dict, bar: tuple[str, str] | None) -> Machine:
    mass = numbers[f"mass.{body}"]
    com = np.array([numbers[f"moment_{c}.{body}"] for c in "xyz"]) / mass
    about = [numbers[f"inertia_{c}{c}.{body}"] for c in "xyz"]
    inertia = tuple(float(i - mass * (com @ com - c**2)) for i, c in zip(about, com, strict=True))
    if bar:
        path = f"axes.{bar[0]}.cylinder.{bar[1]}"
        given = getattr(machine.axes[bar[0]].cylinder, bar[1])
        numbers_of = {"mass": float(mass), "com": float(np.sign(given.com) * np.linalg.norm(com)),
                      "inertia": inertia}  # fmt: skip
    elif body in machine.links:
        path = f"links.{body}"
        numbers_of = {
            "mass": float(mass), "com": tuple(float(c) for c in com), "inertia": inertia
        }  # fmt: skip
    else:
        return machine
    for field, value in numbers_of.items():
        machine = with_value(machine, f"{path}.{field}", value)
    return machine


def _replace_friction(machine: Machine, path: str, place: str, numbers: dict) -> Machine:
    for kind, field in _FRICTION_FIELDS.items():
        if f"{kind}.{place}" in numbers:
            machine = with_value(machine, f"{path}.{field}", float(max(numbers[f"{kind}.{place}"], 0.0)))
    for kind, whole in (("coulomb", "coulomb"), ("viscous", "viscous")):
        key = f"{kind}_asymmetry.{place}"
        size = numbers.get(f"{whole}.{place}", 0.0)
        if key in numbers and size > 0.0:
            part = float(np.clip(numbers[key] / size, -0.99, 0.99))
            machine = with_value(machine, f"{path}.{kind}_asymmetry", part)
    return machine


def _replace_force_offset(machine: Machine, axis: str, place: str, found: Identification, numbers: dict) -> Machine:
    name = f"offset.{place}"
    if name not in numbers:
        return machine
    k = found.names.index(name)
    spread = {int(b): s for b, s in zip(found.data_identifiability.base, found.estimate.std, strict=True)}
    if k not in spread or abs(numbers[name] - found.nominal[k]) < _MIN_OFFSET_CHANGE_STD * spread[k]:
        return machine
    facts = machine.axes[axis]
    if facts.force:
        return with_value(machine, f"axes.{axis}.force.offset", float(numbers[name]))
    channel = f"pressure_head.{axis}"
    known = machine.sensor_errors.get(channel, SensorError())
    more = numbers[name] / facts.hydraulic_drive.effective_areas[0] * known.scale
    error = known.model_copy(update={"offset": float(known.offset + more)})
    return machine.model_copy(update={"sensor_errors": {**machine.sensor_errors, channel: error}})


def build_identify_document(
    found: Identification | None, hydraulics: HydraulicIdentification | None = None,
    best: ConsistentParameters | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the content of `identify.json`; unknown values are None or NaN.

    Args:
        found: identification of the mechanism, None if no force is known.
        hydraulics: identification of the hydraulics, None if not requested.
        best: the nearest physically consistent parameters.

    Returns:
        Keys `parameters`, `condition`, `heldout`, `friction`, `counts`, `status`, `seconds`, `band_hz`,
        `whiteness`, `nominal`, `consistent`, `notes`; `hydraulics` if requested.
    """
    distance, limit = found.squared_distance(found.nominal) if found else (None, None)
    rows = parameter_rows(found) if found else []
    document: dict[str, Any] = {
        "parameters": [
            {
                "name": row.name, "value": row.value, "std": row.std,
                "ci95": None if row.ci95 is None else list(row.ci95), "status": row.status,
                "unit": row.unit, "nominal": row.nominal, "combination": row.combination,
                "bias": row.bias,
            }
            for row in rows
        ],
        "condition": found.estimate.condition if found else None,
        "heldout": {
            drive: {
                "rms": h.rms, "unit": h.unit, "noise_rms": h.noise_rms, "relative": h.relative_error,
                "nominal_rms": h.nominal_rms, "explained": h.is_explained,
                "rest": {"fraction": h.rest_fraction, "friction": h.rest_friction, "excess_rms": h.excess_rms},
            }
            for drive, h in (found.heldout.items() if found else ())
        },
        "friction": [
            {"drive": f.drive, "speed": f.speed, "force": f.force, "std": f.std, "ci95": list(f.ci95), "unit": f.unit}
            for f in (found.friction if found else ())
        ],
        "counts": count_statuses(rows),
        "status": found.status if found else "no force is known",
        "seconds": found.seconds if found else 0.0,
        "band_hz": found.band if found else None,
        "whiteness": found.residual_autocorrelation if found else {},
        "nominal": {"distance": distance, "limit95": limit},
        "consistent": {
            "distance": best.squared_distance, "limit95": limit,
            "parameters": dict(zip(found.names, best.value.tolist(), strict=True)),
        } if found and best else None,
        "notes": list(found.notes) if found else [],
    }  # fmt: skip
    if hydraulics:
        document["parameters"] += [
            {
                "name": n.qualified_name, "value": n.value if n.is_determined else None,
                "std": n.std if n.is_determined else None, "ci95": list(n.ci95) if n.is_determined else None,
                "status": "full" if n.is_determined else STATUS_WEAK, "unit": n.unit, "nominal": n.nominal,
                "combination": "", "bias": None, "parameter": n.parameter,
            }
            for n in hydraulics.parameters
        ]  # fmt: skip
        document["hydraulics"] = {
            "nominal_rms_error": hydraulics.nominal_rms_error, "identified_rms_error": hydraulics.identified_rms_error,
            "status": hydraulics.status,
            "seconds": hydraulics.seconds,
        }  # fmt: skip
        document["seconds"] += hydraulics.seconds
    return document
