"""`identify.json`: an identification as scripts read it."""

from typing import Any

from hydrotele.identify.consistent import Consistent
from hydrotele.identify.hydraulic import Hydraulics
from hydrotele.identify.result import WEAK, Identification, counts, parameter_rows


def identify_document(
    found: Identification | None, hydraulics: Hydraulics | None = None,
    best: Consistent | None = None,
) -> dict[str, Any]:  # fmt: skip
    """The document; what is unknown is None or NaN.

    Args:
        found: identification of the mechanism, None where no force is known.
        hydraulics: identification of the hydraulics, None where not asked for.
        best: the nearest machine that can exist.

    Returns:
        Keys `parameters`, `condition`, `heldout`, `counts`, `status`, `seconds`, `band_hz`,
        `whiteness`, `given`, `consistent`, `notes`; `hydraulics` where asked for.
    """
    distance, limit = found.distance(found.nominal) if found else (None, None)
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
                "rms": h.rms, "unit": h.unit, "noise_rms": h.noise_rms, "relative": h.relative,
                "nominal_rms": h.nominal_rms,
            }
            for drive, h in (found.heldout.items() if found else ())
        },
        "counts": counts(rows),
        "status": found.status if found else "no force is known",
        "seconds": found.seconds if found else 0.0,
        "band_hz": found.band if found else None,
        "whiteness": found.whiteness if found else {},
        "given": {"distance": distance, "limit95": limit},
        "consistent": {
            "distance": best.loss, "limit95": limit,
            "parameters": dict(zip(found.names, best.value.tolist(), strict=True)),
        } if found and best else None,
        "notes": list(found.notes) if found else [],
    }  # fmt: skip
    if hydraulics:
        document["parameters"] += [
            {
                "name": n.name, "value": n.value if n.told else None,
                "std": n.std if n.told else None, "ci95": list(n.ci95) if n.told else None,
                "status": "full" if n.told else WEAK, "unit": n.unit, "nominal": n.nominal,
                "combination": "", "bias": None, "parameter": n.parameter,
            }
            for n in hydraulics.numbers
        ]  # fmt: skip
        document["hydraulics"] = {
            "before": hydraulics.before, "after": hydraulics.after, "status": hydraulics.status,
            "seconds": hydraulics.seconds,
        }  # fmt: skip
        document["seconds"] += hydraulics.seconds
    return document
