"""Covariance of an estimate from the sensors' stated noise: every reading's way into it.

An estimate that is linear in the forces gives every equation a gain. Backwards through the
low-pass that gain falls on single force readings, and through the forces' slopes with respect to
the motion and the filter that made it, on single position readings. Their noise is independent.
"""

import numpy as np
from scipy.signal import fftconvolve

from hydrotele.identify.equations import low_pass, row_forces
from hydrotele.identify.motion import Processing, Resolution, adjoint, joint_motion
from hydrotele.identify.record import Record
from hydrotele.identify.setup import Setup
from hydrotele.identify.smoothed import Smoothed

_SLOPES = 8000  # rows of a run that are asked for the forces' slopes
_BLOCK = 4  # parameters at a time, so that long logs need little memory


def propagated(
    record: Record, found: Resolution, gain: np.ndarray, setup: Setup, processing: Processing,
    value: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Covariance that the noise of one run's readings leaves in an estimate.

    Args:
        record: the run.
        found: what its positions resolve.
        gain: (p, n, k) of the estimate, for the run's equations and all drives; 0 where not used.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        value: (m,) parameters.

    Returns:
        (p, p).

    Source: first-order propagation of errors; Abdellatif 2008, section 4.2 (noise of positions).
    """
    p, _, k = gain.shape
    assert processing.band
    low, thin = low_pass(processing.band, record.period, processing.period)
    rows = len(record.force)
    spaced = np.zeros((p, rows, k))
    middle = (len(low) - 1) // 2
    spaced[:, middle + thin * np.arange(gain.shape[1])] = gain
    on_force = fftconvolve(spaced, low[None, :, None], mode="same", axes=1)
    noise = np.where(np.isfinite(record.force_noise), record.force_noise, 0.0)
    out = np.einsum("pnk,k,qnk->pq", on_force, noise**2, on_force, optimize=True)
    motion = joint_motion(record.position, record.period, found, processing)
    cycles = 1
    if processing.method == "periodic":  # every cycle has the same slopes and is read alike
        assert processing.period
        cycles = round(rows * record.period / processing.period)
    slopes = _slopes(motion, rows // cycles, setup, value)
    parts = []
    for first in range(0, p, _BLOCK):
        folded = on_force[first : first + _BLOCK].reshape(-1, cycles, rows // cycles, k)
        # an equation's error is measured less modelled force: the sign does not matter in a square
        on_motion = np.einsum("pcnk,xnkj->xpnj", folded, slopes, optimize=True)
        parts.append(adjoint(on_motion, record.period, found, processing))
    on_position, stated = np.concatenate(parts), found.noise**2 / cycles
    return out + np.einsum("pnj,j,qnj->pq", on_position, stated, on_position, optimize=True)


def _slopes(motion: Smoothed, count: int, setup: Setup, value: np.ndarray) -> np.ndarray:
    """Slopes (3, n, k, j) of drive forces over positions, rates and accelerations of the joints.

    They change as slowly as the motion: in long runs those of every few rows tell the others.
    """
    rows = np.arange(0, count, max(1, count // _SLOPES))
    motions = np.stack([motion.value, motion.rate, motion.acceleration])[:, rows]
    rate_std = motion.rate_std[rows]
    steps = (motion.value_std[rows], rate_std, motion.acceleration_std[rows])
    middle = row_forces(setup, motions, value, rate_std)
    out = np.empty((3, *middle.shape, motions.shape[2]))
    for x, step in enumerate(steps):
        for j in range(motions.shape[2]):
            moved = motions.copy()
            moved[x, :, j] += step[:, j]
            force = row_forces(setup, moved, value, rate_std)
            out[x, :, :, j] = (force - middle) / np.maximum(step[:, j], 1e-300)[:, None]
    if len(rows) == count:
        return out
    before = np.clip(np.searchsorted(rows, np.arange(count), side="right") - 1, 0, len(rows) - 2)
    part = ((np.arange(count) - rows[before]) / np.diff(rows)[before])[None, :, None, None]
    return (1.0 - part) * out[:, before] + part * out[:, before + 1]
