"""What a perfect model would score: the held-out run simulated with the sensors' noise."""

import numpy as np

from hydrotele.dynamics.integrate import simulate_rows
from hydrotele.dynamics.model import model_space, reduced_model, state_size
from hydrotele.gap.dataset import Dataset, RunData
from hydrotele.gap.residuals import rms
from hydrotele.gap.tracking import STEP, track_run
from hydrotele.machine import Machine

_SEED = 0  # any: the floor's scatter over seeds is 0.003


def clean_run(machine: Machine, data: Dataset, run: RunData, start: np.ndarray, seed: int):
    """The run as the machine itself would have produced it.

    Args:
        machine: the machine.
        data: the dataset, for channels and noise.
        run: the run whose commands and missing readings are taken over.
        start: (nz,) state at the first row.
        seed: of the noise.

    Returns:
        A run with simulated readings. The noise is uniform, as the sensors' errors are.
    """
    model = reduced_model(machine, data.channels)
    rows = len(run.command)
    shown, states = np.empty((rows, len(data.channels))), np.empty((rows, state_size(model)))
    simulate_rows(
        model, model_space(model), start.copy(), run.command, run.period,
        max(1, round(run.period / (0.5 * STEP))), shown, states,
    )  # fmt: skip
    noise = np.random.default_rng(seed).uniform(-1.0, 1.0, shown.shape) * np.sqrt(3.0) * data.noise
    reading = np.where(np.isnan(run.reading), np.nan, shown + noise)
    return RunData(
        run.name, run.start, run.period, run.command, run.command_known, reading, run.log
    )


def noise_floor(machine: Machine, data: Dataset) -> float:
    """RMS of the whitened errors of a perfect model on the held-out run."""
    first = track_run(machine, data, data.heldout).states[0]
    run = clean_run(machine, data, data.heldout, first, _SEED)
    return rms(track_run(machine, data, run).whitened)
