"""Bias that noise of the positions leaves in identified parameters, by repeating it."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hydrotele.identify.equations import Equations, build_equations, row_forces
from hydrotele.identify.motion import Processing, Resolution, joint_motion
from hydrotele.identify.record import Record
from hydrotele.identify.setup import Setup
from hydrotele.identify.smoothing import smooth


def motion_bias(
    runs: Sequence[tuple[Record, Resolution]], setup: Setup, processing: Processing,
    value: np.ndarray, estimated: Callable[[Sequence[Equations]], np.ndarray], pairs: int,
    seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Mean error of an estimate whose regressor comes from noisy positions.

    The optimal smoother's motion, or the mean cycle, is taken for the true one and the parameters
    found for the true ones. Forces that follow from both are estimated from again, with the
    positions' noise added anew. Every noise is used with both signs, so that only what does not
    average out remains.

    Args:
        runs: records and what their positions resolve.
        setup: what the regressor is built of.
        processing: how positions are differentiated.
        value: (m,) parameters found.
        estimated: equations of the runs -> base parameters (r,), linear in the forces.
        pairs: of noise and its negative [1].
        seed: of the noise [1].

    Returns:
        (r,) to be taken off the base parameters.

    Source: Efron and Tibshirani 1993, An introduction to the bootstrap, chapter 10; Cook and
    Stefanski 1994 (noise added to correct for noise).
    """
    generator, worlds = np.random.default_rng(seed), []
    for record, found in runs:
        if processing.method == "periodic":
            motion = joint_motion(record.position, record.period, found, processing)
        else:
            motion = smooth(record.position, record.period, found.noise)
        motions = np.stack([motion.value, motion.rate, motion.acceleration])
        force = row_forces(setup, motions, value)
        force[~np.isfinite(record.force)] = np.nan
        worlds.append((replace(record, position=motion.value, force=force), found))
    found_again = []
    for _ in range(pairs):
        noises = [
            found.noise * generator.standard_normal(record.position.shape)
            for record, found in worlds
        ]
        for sign in (1.0, -1.0):
            made = []
            for (record, found), noise in zip(worlds, noises, strict=True):
                moved = replace(record, position=record.position + sign * noise)
                made.append(build_equations(moved, setup, processing, found)[0])
            found_again.append(estimated(made))
    return np.mean(found_again, axis=0)
