"""Whether dry friction changes sign at once or smoothly: the data choose."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.identify.identification import Identification, identify
from hydrotele.identify.record import Record, trimmed
from hydrotele.identify.setup import Setup

_TRIED = 600.0  # s of data that tell the shape


def identify_with_shapes(
    fit: Sequence[Record], heldout: Record, setup: Setup, *args, **options
) -> Identification:
    """Identify with friction as smooth as the machine states, and with a sharp sign.

    A machine's smoothing velocity often only helps a simulator; sharp friction is Coulomb's own.

    Args:
        fit: as of `identify`.
        heldout: as of `identify`.
        setup: as of `identify`.
        args: as of `identify`.
        options: as of `identify`.

    Returns:
        The identification with the smaller residuals; a note says if it is the sharp one.

    Raises:
        InputError: as `identify`.
    """
    if not any(one.smoothing for one in setup.rubbing):
        return identify(fit, heldout, setup, *args, **options)
    started = time.perf_counter()
    sharp = replace(setup, rubbing=tuple(replace(one, smoothing=0.0) for one in setup.rubbing))
    some, judged = _some(fit), _head(heldout)
    misfits = [_misfit(identify(some, judged, s, *args, **options)) for s in (setup, sharp)]
    found = identify(fit, heldout, setup if misfits[0] <= misfits[1] else sharp, *args, **options)
    found = replace(found, seconds=time.perf_counter() - started)
    if misfits[0] <= misfits[1]:
        return found
    note = "Dry friction changes sign at once in these data, more sharply than in the machine."
    return replace(found, notes=(*found.notes, note))


def _some(fit: Sequence[Record]) -> list[Record]:
    """The first runs, as many as last long enough; one that alone is longer is cut."""
    some, seconds = [], 0.0
    for record in fit:
        some.append(_head(record))
        seconds += len(record.force) * record.period
        if seconds >= _TRIED:
            break
    return some


def _head(record: Record) -> Record:
    """The first part of a record."""
    rows = round(_TRIED / record.period)
    return trimmed(replace(record, position=record.position[:rows], force=record.force[:rows]))


def _misfit(found: Identification) -> float:
    """Sum over the drives of the logarithm of their residuals' RMS."""
    return float(np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))))
