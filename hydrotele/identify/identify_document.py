"""Content of `identify.json`: an identification as JSON data."""

from typing import Any

from hydrotele.identify.consistent_parameters import (
    ConsistentParameters,
)
from hydrotele.identify.hydraulic_identification import HydraulicIdentification
from hydrotele.identify.result import STATUS_WEAK, Identification, count_statuses, parameter_rows


def build_identify_document(
    found: Identification | None, hydraulics: HydraulicIdentification | None = None,
    best: ConsistentParameters | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the content of `identify.json`; unknown values are None or NaN.

    Args:
        found: identification of the mechanism, None if no force is known.
        hydraulics: identification of the hydraulics, None if not requested.
        best: the physically consistent parameters nearest to the identification, or None.

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
