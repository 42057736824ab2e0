"""Compute the open-loop prediction error of a machine from a known state and commands alone."""

import numpy as np

from hydrotele.estimate.reduced_model import (
    advance,
    model_space,
    place,
    read_channels,
    reduced_model,
    write_trail,
)
from hydrotele.estimate.track import STEP, steps_per_row, track_run
from hydrotele.logs.dataset import Dataset, RunData
from hydrotele.machine.machine import Machine

HORIZON = 5.0  # s


def open_loop_error(machine: Machine, data: Dataset, run: RunData, horizon: float = HORIZON) -> dict[str, float]:
    """RMS error of predictions over a horizon, by channel, in units of one reading's noise.

    Windows follow each other along the run; each starts from the state that the filter of the same
    machine has after its first row.

    Args:
        machine: the machine that predicts.
        data: the dataset of the run; its noise is the unit.
        run: the run.
        horizon: length of a window [s].

    Returns:
        Channel -> RMS error [standard deviations of a reading]; infinite where it diverges.
    """
    states = track_run(machine, data, run).states
    model = reduced_model(machine, data.channels)
    space = model_space(model)
    steps = steps_per_row(machine, run.period, STEP)
    rows, c = round(horizon / run.period), len(data.channels)
    errors, shown = [], np.zeros(c)
    for first in range(0, len(run.command) - rows + 1, rows):
        z, trail = states[first].copy(), np.zeros((rows * steps + 1, c))
        place(model, space, z)
        write_trail(model, space, z, trail[0])
        for row in range(rows):
            read_channels(model, space, z, row, steps, run.period / steps, trail, shown)
            errors.append(shown - run.reading[first + row])
            advance(model, space, z, run.command, first + row, run.period, steps,
                    trail[row * steps :])  # fmt: skip
    sizes = np.abs(np.array(errors)) / data.noise
    sizes[~np.isfinite(sizes) & np.isfinite(run.reading[: len(sizes)])] = np.inf
    return {name: float(np.sqrt(np.nanmean(sizes[:, k] ** 2))) for k, name in enumerate(data.channels)}
