"""Bias that noise of the positions leaves in identified parameters, by repeating it."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hydrotele.identify.equations import build_equations, row_forces
from hydrotele.identify.estimation import Weighted, weights
from hydrotele.identify.estimators import Estimate
from hydrotele.identify.gathering import Gathered, cycle_on
from hydrotele.identify.motion import Processing, Resolution, joint_motion
from hydrotele.identify.record import Record
from hydrotele.identify.setup import Setup
from hydrotele.identify.smoothing import smooth

_ENOUGH = 240.0  # s of data in all, spread evenly over the runs
_PIECE = 20.0  # s of one piece of a long run
_PERIODS = 12.0  # of the band that a piece has at least: its low-pass takes three


def motion_bias(
    data: Gathered, equations: Weighted, base: np.ndarray, found: Estimate, value: np.ndarray,
    setup: Setup, processing: Processing, pairs: int, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Mean error of an estimate whose regressor comes from noisy positions.

    The optimal smoother's motion, or the mean cycle, is taken for the true one and the parameters
    found for the true ones. Forces that follow from both meet a regressor to which the positions'
    noise is added anew: what then stands on the right of the normal equations would be 0 without
    noise. Every noise is used with both signs, so that only what does not average out remains.

    Args:
        data: equations of all runs.
        equations: the same, weighted.
        base: (r,) places of the base parameters.
        found: their estimate.
        value: (m,) all parameters that follow from it.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        pairs: of noise and its negative [1].
        seed: of the noise [1].

    Returns:
        (r,) to be taken off the base parameters.

    Source: Efron and Tibshirani 1993, An introduction to the bootstrap, chapter 10; Cook and
    Stefanski 1994 (noise added to correct for noise).
    """
    generator = np.random.default_rng(seed)
    total, rows = np.zeros(len(base)), 0
    for record, resolved, noise in _pieces(data, processing):
        world = _world(record, resolved, setup, processing, value)
        for _ in range(pairs):
            error = noise * generator.standard_normal(record.position.shape)
            for sign in (1.0, -1.0):
                moved = replace(world, position=world.position + sign * error)
                made, _ = build_equations(moved, setup, processing, resolved)
                matrix, force = made.matrix[:, data.columns], made.force[:, data.columns]
                weight = weights(equations.doubtful, made.doubt[:, data.columns])
                left = (weight * (force - matrix @ value)) @ found.white.T
                aside = weight[:, :, None] * matrix[:, :, base]
                if equations.instruments is not None:
                    assert processing.period
                    step = round(processing.period / made.spacing)
                    aside = np.nan_to_num(cycle_on(aside, step))
                known = np.isfinite(left).all(axis=1)
                total += np.einsum("nkr,nk->r", (found.white @ aside)[known], left[known])
                rows += int(known.sum())
    return found.normal @ total * (len(data.force) / max(rows, 1))


def _world(
    record: Record, found: Resolution, setup: Setup, processing: Processing, value: np.ndarray
) -> Record:
    """A record whose forces are those of its motion, and as unknown as they were."""
    if processing.method == "periodic":
        motion = joint_motion(record.position, record.period, found, processing)
    else:
        motion = smooth(record.position, record.period, found.noise)
    force = row_forces(setup, np.stack([motion.value, motion.rate, motion.acceleration]), value)
    force[~np.isfinite(record.force)] = np.nan
    return replace(record, position=motion.value, force=force)


def _pieces(
    data: Gathered, processing: Processing
) -> Iterator[tuple[Record, Resolution, np.ndarray]]:
    """Pieces of the runs, what their positions resolve, and the noise (k,) of a position.

    The noise of a mean cycle is that of all cycles.
    """
    lengths = [len(record.force) * record.period for record, _ in data.runs]
    part = min(1.0, _ENOUGH / sum(lengths))
    assert processing.band
    for (record, found), length in zip(data.runs, lengths, strict=True):
        noise = found.noise
        if processing.period:
            cycles = max(1, round(length / processing.period))
            used = min(cycles, max(2, math.ceil(part * cycles)))
            wanted = [(0.0, used * processing.period if used < cycles else length)]
            if processing.method == "periodic":
                noise = noise * math.sqrt(used / cycles)
        elif part == 1.0:
            wanted = [(0.0, length)]
        else:
            piece = min(max(_PIECE, _PERIODS / processing.band), length)
            count = max(1, round(part * length / piece))
            starts = (np.arange(count) + 0.5) * length / count - 0.5 * piece
            wanted = [(start, piece) for start in np.clip(starts, 0.0, length - piece)]
        for start, seconds in wanted:
            first = round(start / record.period)
            rows = slice(first, first + round(seconds / record.period))
            position = record.position[rows]
            if np.isfinite(position).any(axis=0).all():
                cut = replace(record, position=position, force=record.force[rows])
                yield cut, found, noise
