"""Whether dry friction changes sign at once or smoothly: the data choose."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hydrotele.identify.identification import Identification, identify
from hydrotele.identify.record import Record
from hydrotele.identify.setup import Setup


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
    found = identify(fit, heldout, setup, *args, **options)
    if not any(one.smoothing for one in setup.rubbing):
        return found
    sharp = replace(setup, rubbing=tuple(replace(one, smoothing=0.0) for one in setup.rubbing))
    other = identify(fit, heldout, sharp, *args, **options)
    seconds = found.seconds + other.seconds
    if _misfit(other) >= _misfit(found):
        return replace(found, seconds=seconds)
    note = "Dry friction changes sign at once in these data, more sharply than in the machine."
    return replace(other, seconds=seconds, notes=(*other.notes, note))


def _misfit(found: Identification) -> float:
    """Sum over the drives of the logarithm of their residuals' RMS."""
    return float(np.sum(np.log(np.mean(found.estimate.residual**2, axis=0))))
