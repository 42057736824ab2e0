"""Whether dry friction changes sign at once or smoothly: the data choose."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.identify.estimation import Estimator
from hydrotele.identify.identification import fit_runs, identify
from hydrotele.identify.motion import Processing
from hydrotele.identify.record import Record, beginning
from hydrotele.identify.result import Identification
from hydrotele.identify.setup import Setup

_TRIED = 600.0  # s of data that tell the shape


def identify_with_shapes(
    fit: Sequence[Record], heldout: Record, setup: Setup,
    processing: Processing | None = None, estimator: Estimator | None = None, *,
    notes: Sequence[str] = (),
) -> Identification:  # fmt: skip
    """Identify with friction as smooth as the machine states, or with a sharp sign.

    A machine's smoothing velocity often only helps a simulator; sharp friction is Coulomb's own.

    Args:
        fit: as of `identify`.
        heldout: as of `identify`.
        setup: as of `identify`.
        processing: as of `identify`.
        estimator: as of `identify`.
        notes: as of `identify`.

    Returns:
        The identification with the smaller residuals; a note says if it is the sharp one.

    Raises:
        InputError: as `identify`.
    """
    started = time.perf_counter()
    processing, estimator = processing or Processing(), estimator or Estimator()
    if any(one.smoothing for one in setup.rubbing):
        sharp = replace(setup, rubbing=tuple(replace(one, smoothing=0.0) for one in setup.rubbing))
        some = _some(fit, processing.period)
        misfits = [_misfit(some, s, processing, estimator) for s in (setup, sharp)]
        if misfits[1] < misfits[0]:
            setup = sharp
            said = "Dry friction changes sign at once in these data, more sharply than given."
            notes = (*notes, said)
    found = identify(fit, heldout, setup, processing, estimator, notes=notes)
    return replace(found, seconds=time.perf_counter() - started)


def _some(fit: Sequence[Record], period: float | None) -> list[Record]:
    """The first runs, as many as last long enough; one that alone is longer is cut."""
    some, seconds = [], 0.0
    for record in fit:
        some.append(beginning(record, _TRIED, period))
        seconds += len(record.force) * record.period
        if seconds >= _TRIED:
            break
    return some


def _misfit(
    fit: Sequence[Record], setup: Setup, processing: Processing, estimator: Estimator
) -> float:
    """What the residuals' likelihood asks to be small."""
    found = fit_runs(fit, setup, processing, estimator)
    # weights count as the inverse of standard deviations, or the shape that doubts most would win
    doubted = np.sum(np.mean(np.log(found.equations.weight**2), axis=0))
    return float(np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))) - doubted)
