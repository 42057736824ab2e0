"""`gap.json`: what scripts read of a Gap. Its keys are fixed."""

import dataclasses
import math
from typing import Any

import numpy as np

from hydrotele.gap.result import Gap, NamedEffect


def gap_document(gap: Gap) -> dict[str, Any]:
    """A Gap as strict JSON: plain numbers and texts in SI, null where a number is not finite.

    Args:
        gap: what the search yields.

    Returns:
        `verdict`: named, partly, ambiguous, unknown or no_gap.
        `effects`: named effects, see `effect_document`; `share` is the part of the held-out run's
        gap that comes back without the effect, `mechanism_probability` counts alternatives that are
        the same mechanism in another form (a lag for a delay), and decides the verdict.
        `calibration`: uncertain number -> `value`, `nominal`, `unit`, `ci95`.
        `learned`: laws learned from the data: `balance` (force, flow_head, flow_rod, flow_through,
        flow_supply, command), `axis`, `variable`, `other` (a second variable, or empty), `formula`
        in SI, `points` [`variable_unit`], `values` there and their standard deviations `spread`
        [`unit`], `resembles` (a library effect or null), `share`, `description`.
        `unknown`: what no effect explains, or null: `law`, `channel`, `depends_on`, `windows`
        [s], `description`.
        `lacks`: what the patched machine still lacks: `balance`, `axis`, standard deviation `size`
        [`unit`], `part` of the largest that makes sense.
        `noise`: channel -> `found` and `stated` standard deviation of a reading [SI].
        `gap`: RMS prediction errors `before` and `after`, and `noise_floor`, of the held-out run.
        `tests`: residual test -> `value`, `limit`, `passed`.
        `laws`: balance -> `unit` and `places`, place -> RMS `before`, `after` and `noise`.
        `next_experiment`: `reason` and `scenario`, or null. `notes`: on the data. `seconds`.
    """
    unknown = gap.unknown and {
        "law": gap.unknown.law,
        "channel": gap.unknown.channel,
        "depends_on": list(gap.unknown.depends_on),
        "windows": [list(window) for window in gap.unknown.windows],
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
        "calibration": {
            key: {"value": e.value, "nominal": e.nominal, "unit": e.unit, "ci95": [e.low, e.high]}
            for key, e in gap.calibration.items()
        },
        "learned": [
            {**dataclasses.asdict(law), "resembles": law.resembles or None} for law in gap.learned
        ],
        "unknown": unknown,
        "lacks": [dataclasses.asdict(lack) for lack in gap.lacks],
        "noise": {
            channel: {"found": found, "stated": stated}
            for channel, (found, stated) in gap.noise.items()
        },
        "gap": {
            "metric": size.metric,
            "before": size.before,
            "after": size.after,
            "noise_floor": size.noise_floor,
        },
        "tests": gap.tests,
        "laws": laws,
        "next_experiment": gap.next_experiment,
        "notes": list(gap.notes),
        "seconds": gap.seconds,
    })  # fmt: skip


def effect_document(effect: NamedEffect) -> dict[str, Any]:
    """One effect as it stands in `gap.json`."""
    return {
        "name": effect.name,
        "location": effect.location,
        "probability": effect.probability,
        "mechanism_probability": effect.mechanism_probability,
        "share": effect.share,
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
