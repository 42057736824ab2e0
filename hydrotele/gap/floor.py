"""What a perfect model would score: runs simulated by the model with the sensors' noise."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from hydrotele.dynamics.integrate import simulate_rows
from hydrotele.dynamics.model import model_space, reduced_model, state_size
from hydrotele.estimate.track import STEP, Track, track_run
from hydrotele.logs.load import Dataset, RunData
from hydrotele.machine.machine import Machine

_SEED = 0  # of the first run; any: the floor's scatter over seeds is 0.003


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
    space = model_space(model)
    space.time[1] = run.start
    rows = len(run.command)
    shown, states = np.empty((rows, len(data.channels))), np.empty((rows, state_size(model)))
    simulate_rows(
        model, space, start.copy(), run.command, run.period,
        max(1, round(run.period / (0.5 * STEP))), shown, states,
    )  # fmt: skip
    noise = (
        np.random.default_rng(seed).uniform(-1.0, 1.0, shown.shape)
        * np.sqrt(3.0)
        * data.noise_of(run)
    )
    reading = np.where(np.isnan(run.reading), np.nan, shown + noise)
    return replace(run, reading=reading)


def perfect_tracks(
    machine: Machine, data: Dataset, tracks: Sequence[Track], each: Callable = map
) -> tuple[Track, ...]:
    """Tracks of a model on readings that it made itself.

    Args:
        machine: the model.
        data: the dataset.
        tracks: the model's tracks of the runs to take after.
        each: `map`, or that of a pool.

    Returns:
        One track per run, with gains of its own.
    """

    def one(k: int) -> Track:
        run = clean_run(machine, data, tracks[k].run, tracks[k].states[0], _SEED + k)
        return track_run(machine, data, run)

    return tuple(each(one, range(len(tracks))))
