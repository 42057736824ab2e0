"""Logs of one machine, made ready for the filter: one clock, one set of channels, gaps marked."""

from dataclasses import dataclass

import numpy as np

from hydrotele.log import Log
from hydrotele.machine import Machine


@dataclass(frozen=True)
class RunData:
    """One run on a uniform clock.

    Attributes:
        name: the run's name.
        start: time of the first row [s].
        period: time between rows [s].
        command: (n, nu) commands in actuator order, held from row to row [1], [V] or [N].
        command_known: (n,) whether the row was in the log; a missing row repeats the last command.
        reading: (n, c) sensor readings in the dataset's channels, NaN where missing [SI].
        log: the log as read, without truth.
    """

    name: str
    start: float
    period: float
    command: np.ndarray
    command_known: np.ndarray
    reading: np.ndarray
    log: Log


@dataclass(frozen=True)
class Dataset:
    """Logs of one machine.

    Attributes:
        machine: the model.
        axes: the nu axes in actuator order.
        channels: the c measured channels that any run has and the model predicts.
        noise: (c,) standard deviation of one reading from the machine's sensors [SI]; NaN where
            the machine states no accuracy.
        fit: the runs to learn from.
        heldout: the run to judge on.
        notes: what was left out or mended, one sentence each.
    """

    machine: Machine
    axes: tuple[str, ...]
    channels: tuple[str, ...]
    noise: np.ndarray
    fit: tuple[RunData, ...]
    heldout: RunData
    notes: tuple[str, ...]
