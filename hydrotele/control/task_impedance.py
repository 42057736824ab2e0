"""Stiffness, damping and mass of the task, identified while the machine touches it."""

import numpy as np

from hydrotele.control.recursive import RecursiveLeastSquares
from hydrotele.control.state_filter import CHANGE, LAST, LOW, RATE, filter_step, filter_table

_TOUCHING = 500.0  # N: less is no task, but what is left of the estimate in free motion
# of stiffness [kN/m], damping [kN s/m], mass [t] and offset [kN] before any data
_SPREAD = (3e3, 3e3, 30.0, 30.0)
_FORGET = 0.99  # per sample: some two seconds at 50 Hz
_RESET = 8.0  # times the usual error


class TaskImpedance:
    """Recursive least squares of `F = -(K x + B v + M a + c)` along every task coordinate.

    Force, place, rate and acceleration go through the same filters, so that they are equally late.

    Attributes:
        stiffness: (k,) K [N/m], [N m/rad]; 0 while nothing is touched.
        damping: (k,) B [N s/m], [N m s/rad].
        mass: (k,) M [kg], [kg m^2].
    """

    def __init__(
        self, coordinates: int, period: float, bandwidths: tuple[float, ...], *, late: bool
    ) -> None:
        """Begin with a free task.

        Args:
            coordinates: their number, k.
            period: between two samples [s].
            bandwidths: of the filters, one after the other [Hz].
            late: whether the force comes through these filters already.
        """
        self.stiffness, self.damping = np.zeros(coordinates), np.zeros(coordinates)
        self.mass = np.zeros(coordinates)
        self._fits: list[RecursiveLeastSquares | None] = [None] * coordinates
        self._origin = np.zeros(coordinates)
        self._tables = [filter_table(bandwidth, period) for bandwidth in bandwidths]
        self._place = np.full((len(bandwidths), coordinates, 4), np.nan)
        self._force = None if late else self._place.copy()

    def update(self, force: np.ndarray, pose: np.ndarray) -> None:
        """Take in one sample.

        Args:
            force: (k,) of the environment on the tip [N], [N m].
            pose: (k,) of the tip [m], [rad]; a sample that is not finite is left out.

        Source: Zhu 1994, 3.73-3.76 (mass, damping, stiffness; forgetting and resetting).
        """
        if not (np.isfinite(force).all() and np.isfinite(pose).all()):
            return
        for c in range(len(force)):
            motion = self._filtered(self._place, c, pose[c])
            felt = force[c]
            if self._force is not None:
                felt = self._filtered(self._force, c, force[c])[0]
            self._fit(c, felt, *motion)

    def _filtered(self, states: np.ndarray, c: int, reading: float) -> tuple[float, float, float]:
        """The reading's low-pass with two derivatives; filters stand at the first one."""
        for table, state in zip(self._tables, states[:, c], strict=True):
            if np.isnan(state[LOW]):
                state[:] = 0.0
                state[LOW] = state[LAST] = reading
            filter_step(table, state, float(reading))
            reading, rate, change = state[LOW], state[RATE], state[CHANGE]
        return reading, rate, change

    def _fit(self, c: int, force: float, place: float, rate: float, change: float) -> None:
        """One equation of one coordinate."""
        if not abs(force) > _TOUCHING:
            self._fits[c] = None
            self.stiffness[c] = self.damping[c] = self.mass[c] = 0.0
            return
        fit = self._fits[c]
        if fit is None:
            self._origin[c] = place
            fit = self._fits[c] = RecursiveLeastSquares(
                np.zeros(4), np.array(_SPREAD), forgetting=_FORGET, reset=_RESET
            )
        fit.update(np.array([place - self._origin[c], rate, change, 1.0]), -force / 1e3)
        self.stiffness[c] = max(0.0, 1e3 * fit.value[0])
        self.damping[c] = max(0.0, 1e3 * fit.value[1])
        self.mass[c] = max(0.0, 1e3 * fit.value[2])
