"""Comparison of the linear analysis with the time simulation: transmitted impedance and stability."""

from dataclasses import dataclass

import numpy as np

from hydrotele.teleop.case_file import TeleoperatorAxis
from hydrotele.teleop.linear_analysis import stability_map
from hydrotele.teleop.nyquist_criterion import count_unstable_poles_held
from hydrotele.teleop.time_simulation import is_growing, measure_sine_impedance, simulate_impulse_response
from hydrotele.teleop.two_port import transmitted_impedance

SWEEP_FREQUENCIES = 2.0 * np.pi * np.geomspace(0.1, 5.0, 9)  # rad/s, frequency range of hand motion


@dataclass(frozen=True)
class SineSweep:
    """Impedance that the operator feels at the master, from a formula and from simulated sines.

    Attributes:
        structure: name of the structure.
        delay_forward: delay from the master to the slave [s].
        delay_back: delay from the slave to the master [s].
        frequencies: (n,) [rad/s].
        expected: (n,) complex impedance predicted by the formula [N s/m].
        measured: (n,) complex impedance measured in simulation [N s/m]; empty if the slave is
            unstable while the master's motion is imposed, so that no measurement is possible.
    """

    structure: str
    delay_forward: float
    delay_back: float
    frequencies: np.ndarray
    expected: np.ndarray
    measured: np.ndarray

    @property
    def max_relative_error(self) -> float | None:
        """Largest difference of measured and predicted impedance, relative to the latter [1].

        None if no measurement is possible.
        """
        if not len(self.measured):
            return None
        return float(np.max(np.abs(self.measured / self.expected - 1.0)))


@dataclass(frozen=True)
class StabilityComparison:
    """Predicted and simulated stability on a grid of delays and factors on the return channels.

    Attributes:
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].
        predicted: (m, n) true where predicted stable.
        simulated: (m, n) true where stable in simulation.
    """

    structure: str
    delays: np.ndarray
    factors: np.ndarray
    predicted: np.ndarray
    simulated: np.ndarray

    @property
    def agreement_fraction(self) -> float:
        """Fraction of the grid cells in which linear prediction and simulation agree [1]."""
        return float(np.mean(self.predicted == self.simulated))


def run_sine_sweep(case: TeleoperatorAxis, structure: str, frequencies: np.ndarray = SWEEP_FREQUENCIES) -> SineSweep:
    """Compute the impedance transmitted to the operator, and measure it in simulation with sines.

    Args:
        case: teleoperator with its task.
        structure: name of the structure.
        frequencies: (n,) [rad/s].

    Returns:
        Predicted and measured impedances.
    """
    port = case.make_port(structure)
    expected = transmitted_impedance(port, 1j * frequencies, case.task)
    measured = []
    if count_unstable_poles_held(port, case.task) == 0:
        measured = [measure_sine_impedance(case, structure, float(w)) for w in frequencies]
    return SineSweep(structure, case.delay_forward, case.delay_back, frequencies, expected, np.array(measured))


def compare_stability(
    case: TeleoperatorAxis, structure: str, delays: np.ndarray, factors: np.ndarray
) -> StabilityComparison:
    """Predict stability linearly and by simulation, for all pairs of a delay and a return gain.

    Args:
        case: teleoperator with hand and task.
        structure: name of the structure.
        delays: (n,) delays in each direction [s].
        factors: (m,) factors on the return channels [1].

    Returns:
        Predicted and simulated stability.
    """
    seen = [
        [not is_growing(simulate_impulse_response(case.with_delay(float(t)), structure, float(k))) for t in delays]
        for k in factors
    ]
    predicted = stability_map(case, structure, delays, factors)
    return StabilityComparison(structure, delays, factors, predicted, np.array(seen))
