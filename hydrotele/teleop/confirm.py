"""Linear predictions against the simulated two masses: what is felt, and what is stable."""

from dataclasses import dataclass

import numpy as np

from hydrotele.teleop.analysis import stability_map
from hydrotele.teleop.case import Case
from hydrotele.teleop.stability import unstable_held
from hydrotele.teleop.two_mass import grows, kicked, swept
from hydrotele.teleop.two_port import transmitted

SWEPT = 2.0 * np.pi * np.geomspace(0.1, 5.0, 9)  # rad/s, what a hand moves


@dataclass(frozen=True)
class Sweep:
    """Impedance felt in a simulated sine sweep.

    Attributes:
        structure: its name.
        delay_forward: from the master to the slave [s].
        delay_back: back [s].
        frequencies: (n,) [rad/s].
        expected: (n,) by the formula [N s/m].
        measured: (n,) in simulation [N s/m]; empty where a held master's slave is unstable, so that
            nothing can be measured.
    """

    structure: str
    delay_forward: float
    delay_back: float
    frequencies: np.ndarray
    expected: np.ndarray
    measured: np.ndarray

    @property
    def error(self) -> float | None:
        """Largest relative error [1], None where nothing could be measured."""
        if not len(self.measured):
            return None
        return float(np.max(np.abs(self.measured / self.expected - 1.0)))


@dataclass(frozen=True)
class Agreement:
    """Stability predicted and seen in simulation.

    Attributes:
        structure: its name.
        delays: (n,) each way [s].
        factors: (m,) on what comes back [1].
        predicted: (m, n) true where stable.
        seen: (m, n) the same in simulation.
    """

    structure: str
    delays: np.ndarray
    factors: np.ndarray
    predicted: np.ndarray
    seen: np.ndarray

    @property
    def share(self) -> float:
        """Share of the cells that agree [1]."""
        return float(np.mean(self.predicted == self.seen))


def sweep(case: Case, structure: str, frequencies: np.ndarray = SWEPT) -> Sweep:
    """Measure what is felt with imposed sines, and compute it.

    Args:
        case: the teleoperator with its task.
        structure: its name.
        frequencies: (n,) [rad/s].

    Returns:
        Both.
    """
    port = case.port(structure)
    expected = transmitted(port, 1j * frequencies, case.task)
    measured = []
    if unstable_held(port, case.task) == 0:
        measured = [swept(case, structure, float(w)) for w in frequencies]
    return Sweep(
        structure, case.delay_forward, case.delay_back, frequencies, expected, np.array(measured)
    )


def agreement(case: Case, structure: str, delays: np.ndarray, factors: np.ndarray) -> Agreement:
    """Simulate a kick in every cell of a map of stability.

    Args:
        case: the teleoperator with hand and task.
        structure: its name.
        delays: (n,) each way [s].
        factors: (m,) on what comes back [1].

    Returns:
        Prediction and simulation.
    """
    seen = [
        [not grows(kicked(case.with_delay(float(t)), structure, float(k))) for t in delays]
        for k in factors
    ]
    predicted = stability_map(case, structure, delays, factors)
    return Agreement(structure, delays, factors, predicted, np.array(seen))
