"""The best answer so far of a search, to be kept while it runs.

A search takes minutes. Each time that it accepts a more likely model, that model is handed on with its effects and
calibrated parameters, without intervals and probabilities, which need the whole search.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hydrotele.estimate.evidence import Judged
from hydrotele.estimate.hypothesis import CALIBRATION, Hypothesis
from hydrotele.gap.result import finite
from hydrotele.machine.machine import Machine


@dataclass(frozen=True)
class Interim:
    """The best answer so far.

    Attributes:
        machine: the machine with it.
        document: `interim` (true), `effects` (name, location, parameters with value, nominal and unit),
            `calibration`, `evidence_gain` (fall of -2 log posterior probability density against the given
            machine [1]) and `seconds` since the start; strict JSON.
    """

    machine: Machine
    document: dict[str, Any]


def keep_better(machine: Machine, keep: Callable[[Interim], None], start: float) -> Callable[[Judged], None]:
    """Return a function that hands on evaluated hypotheses as long as each is more likely than the last one.

    Args:
        machine: the given machine.
        keep: receives the answers.
        start: `time.perf_counter()` at the start of the search [s].
    """
    losses: list[float] = []

    def consider(judged: Judged) -> None:
        if not np.isfinite(judged.loss) or (losses and judged.loss >= losses[-1]):
            return
        losses.append(judged.loss)
        parts = judged.guess.parts
        document = {
            "interim": True,
            "effects": [
                {"name": h.name, "location": h.location, "parameters": _parameters(h, d)}
                for h, d in parts if h.name != CALIBRATION
            ],
            "calibration": next((_parameters(h, d) for h, d in parts if h.name == CALIBRATION), {}),
            "evidence_gain": losses[0] - judged.loss,
            "seconds": time.perf_counter() - start,
        }  # fmt: skip
        keep(Interim(judged.guess.machine(machine), finite(document)))

    return consider


def _parameters(hypothesis: Hypothesis, deviation: np.ndarray) -> dict[str, dict[str, Any]]:
    values = hypothesis.values(deviation)
    return {
        key: {"value": values[key], "nominal": p.nominal, "unit": p.unit} for key, p in hypothesis.parameters.items()
    }
