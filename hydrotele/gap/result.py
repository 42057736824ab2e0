"""What the search for a gap yields."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from hydrotele.machine import Machine

Verdict = Literal["named", "no_gap", "unknown", "ambiguous"]


@dataclass(frozen=True)
class Estimate:
    """A fitted number with its 95 % interval, and the machine's value without the effect."""

    value: float
    unit: str
    low: float
    high: float
    nominal: float


@dataclass(frozen=True)
class Alternative:
    """Another explanation that the data cannot rule out."""

    name: str
    location: str
    probability: float


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the data ask for."""

    name: str
    location: str
    probability: float
    parameters: Mapping[str, Estimate]
    alternatives: tuple[Alternative, ...] = ()


@dataclass(frozen=True)
class Unknown:
    """A disagreement that no effect of the library explains.

    Attributes:
        law: the law that fails, such as `force` or `flow`.
        channel: the channel that shows it most.
        depends_on: quantities that it depends on, such as `length.stick`.
        description: one paragraph in plain words.
        term: the sparse-regression term that holds up on the held-out run, or None.
        windows: (start, end) [s] in the held-out run where it shows most.
    """

    law: str
    channel: str
    depends_on: tuple[str, ...]
    description: str
    term: str | None = None
    windows: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class GapSize:
    """RMS of normalised one-step prediction errors of the held-out run; a perfect model has 1.

    Where the machine states no accuracy of its sensors, the given model's errors on the fitted runs
    have size 1, and `noise_floor`, the size that a perfect model's have, is None.
    """

    before: float
    after: float
    noise_floor: float | None
    metric: str = "RMS of the whitened one-step prediction errors, all channels, held-out run"


@dataclass(frozen=True)
class Candidate:
    """A line of the ranking: what naming this effect alone would gain.

    Attributes:
        gain: fall of -2 log likelihood over the fit runs.
        charge: what its parameters cost (Occam factor), in the same unit.
        parameters: parameter -> value.
    """

    name: str
    location: str
    gain: float
    charge: float
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Prediction:
    """One-step predictions of one run by one model.

    Attributes:
        run: name of the run.
        time: (n,) [s].
        channels: the c channels.
        predicted: (n, c) one-step predicted readings [channel's unit].
        measured: (n, c) readings, NaN where missing.
        whitened: (n, c) prediction errors over their predicted standard deviation, NaN where
            missing; a perfect model gives white noise of size 1.
    """

    run: str
    time: np.ndarray
    channels: tuple[str, ...]
    predicted: np.ndarray
    measured: np.ndarray
    whitened: np.ndarray


@dataclass(frozen=True)
class Gap:
    """Everything the search yields.

    Attributes:
        machine: the model that was given.
        patched: the model with the named effects; the same object if nothing was named.
        verdict: named, no_gap, unknown or ambiguous.
        effects: the named effects, the surest first.
        unknown: what no effect explains, or None.
        size: the gap on the held-out run before and after.
        ranking: single effects by gain, best first.
        before: predictions of the given model, the held-out run first, then the fit runs.
        after: the same of the patched model.
        laws: law -> axis or place -> {"before", "after", "noise"}: RMS balance residuals of the
            held-out run, [unit] as in `law_units`.
        law_units: law -> unit of its residual.
        tests: name of a residual test -> {"value", "limit", "passed"} of the final model.
        next_experiment: what would separate the alternatives or show the unknown better, or None;
            has "reason" and "scenario" (a scenario as a dict).
        notes: what was left out or mended in the data, one sentence each.
        seconds: wall time of the search.
    """

    machine: Machine
    patched: Machine
    verdict: Verdict
    effects: tuple[NamedEffect, ...]
    unknown: Unknown | None
    size: GapSize
    ranking: tuple[Candidate, ...]
    before: tuple[Prediction, ...]
    after: tuple[Prediction, ...]
    laws: Mapping[str, Mapping[str, Mapping[str, float]]] = field(default_factory=dict)
    law_units: Mapping[str, str] = field(default_factory=dict)
    tests: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    next_experiment: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()
    seconds: float = 0.0
