"""`gap.json`: what scripts read of a Gap. Its keys are fixed."""

import math
from typing import Any

import numpy as np

from hydrotele.gap.result import Gap, NamedEffect


def gap_document(gap: Gap) -> dict[str, Any]:
    """A Gap as strict JSON: plain numbers and texts in SI, null where a number is not finite.

    Args:
        gap: what the search yields.

    Returns:
        Keys `verdict`, `effects`, `unknown`, `gap`, `next_experiment`, `laws` (law -> `unit` and
        `places`, place -> RMS `before`, `after` and `noise`), `seconds`.
    """
    unknown = gap.unknown and {
        "law": gap.unknown.law,
        "depends_on": list(gap.unknown.depends_on),
        "description": gap.unknown.description,
    }
    size = gap.size
    laws = {
        law: {"unit": gap.law_units.get(law, "1"), "places": places}
        for law, places in gap.laws.items()
    }
    return finite({
        "verdict": gap.verdict,
        "effects": [effect_document(effect) for effect in gap.effects],
        "unknown": unknown,
        "gap": {
            "metric": size.metric,
            "before": size.before,
            "after": size.after,
            "noise_floor": size.noise_floor,
        },
        "next_experiment": gap.next_experiment,
        "laws": laws,
        "seconds": gap.seconds,
    })  # fmt: skip


def effect_document(effect: NamedEffect) -> dict[str, Any]:
    """One effect as it stands in `gap.json`."""
    return {
        "name": effect.name,
        "location": effect.location,
        "probability": effect.probability,
        "parameters": {
            name: {"value": e.value, "unit": e.unit, "ci95": [e.low, e.high]}
            for name, e in effect.parameters.items()
        },
        "alternatives": [
            {"name": a.name, "location": a.location, "probability": a.probability}
            for a in effect.alternatives
        ],
    }


def finite(data: Any) -> Any:
    """Data with Python types only, and None for what is not finite; keys become texts.

    >>> finite({"a": (np.float64(1), np.nan), 2: np.array([True])})
    {'a': [1.0, None], '2': [True]}
    """
    if isinstance(data, np.ndarray | np.generic):
        data = data.tolist()
    if hasattr(data, "items"):
        return {str(key): finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    if isinstance(data, float) and not math.isfinite(data):
        return None
    return data
